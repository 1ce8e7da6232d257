"""The surface as a point cloud: one point per cell, written block by block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pyproj import CRS

from sattools.errors import extra
from sattools.export.products.colours import Palette
from sattools.export.products.maps import Maps
from sattools.progress import Progress
from sattools.scene.datums import compound_crs
from sattools.scene.files import write_with
from sattools.scene.validity import FILLED, LEVELLED, MEASURED, UNSEEN

UNCLASSIFIED, WATER_CLASS, FILLED_CLASS = 1, 9, 64  # of LAS: 64 and above are for users
SCALE = 0.001  # m
_ABOUT = {
    "confidence": ("f4", "of the matching, 0 to 1"),
    "height_std": ("f4", "of the height in m"),
    "validity": ("u1", "1 measured, 2 filled, 4 water"),
}
# what WKT 1, which LAS asks for, has in place of a three-dimensional CRS
_ELLIPSOID = (
    'VERT_CS["WGS 84 ellipsoidal height",VERT_DATUM["Ellipsoid",2002],'
    'UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Up",UP]]'
)


@dataclass(frozen=True)
class Points:
    """Points of a block.

    Attributes:
        place: ``[N, 3]`` float64 easting, northing, height [m].
        colour: ``[N, 3]`` uint8.
        more: ``[N]`` per point by name, see `_ABOUT`; those that are known.
    """

    place: np.ndarray
    colour: np.ndarray
    more: dict[str, np.ndarray]


def _points_of(maps: Maps, palette: Palette | None = None) -> Iterator[Points]:
    """All cells with a height, block by block, each at its centre.

    Args:
        maps: the DSM and what else is known of its cells.
        palette: of the albedo, None = without colours.
    """
    for rows, cols in maps.blocks():
        part = maps.grid.part(rows, cols)
        height = maps.read("dsm", rows, cols)[0]
        known = np.isfinite(height)
        x, y = np.meshgrid(part.x(), part.y())
        place = np.stack([x[known], y[known], height[known].astype(np.float64)], axis=1)
        colour = np.zeros((len(place), 3), np.uint8)
        if palette is not None and len(place):
            colour = palette.shown(maps.read("albedo", rows, cols))[known]
        sources = {"confidence": "prior_confidence", "height_std": "dsm_std", "validity": "validity"}
        more = {
            name: np.nan_to_num(maps.read(product, rows, cols)[0][known]).astype(_ABOUT[name][0])
            for name, product in sources.items()
            if product in maps.paths
        }
        yield Points(place, colour, more)


def write_laz(path: Path, maps: Maps, vertical: str | None, progress: Progress) -> int:
    """Write a LAZ file (LAS 1.4, point format 7) of the surface; the number of points.

    Cells that no images have measured have class 64, water that was laid level class 9, both the flag `synthetic`; all
    others are unclassified (1).

    Args:
        path: to write.
        maps: what is known of the cells.
        vertical: CRS of the heights, None = above the ellipsoid.
        progress: told the share done.
    """
    laspy = extra("laspy", "products")
    extra("lazrs", "products")
    header = laspy.LasHeader(point_format=7, version="1.4")
    west, south, _, _ = maps.grid.bounds
    header.scales, header.offsets = np.full(3, SCALE), np.array([np.floor(west), np.floor(south), 0.0])
    for name, product in (("confidence", "prior_confidence"), ("height_std", "dsm_std"), ("validity", "validity")):
        if product in maps.paths:
            kind, about = _ABOUT[name]
            header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=kind, description=about))
    header.generating_software = "sattools"
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(las_wkt(maps.grid.crs, vertical)))
    header.global_encoding.wkt = True
    palette = Palette.of(maps, "albedo") if "albedo" in maps.paths else None
    made = _Sums()
    total = sum(1 for _ in maps.blocks())

    def write(temporary: Path) -> None:
        with (
            open(temporary, "xb") as file,
            laspy.open(
                file, mode="w", header=header, do_compress=True, laz_backend=laspy.LazBackend.Lazrs, closefd=False
            ) as writer,
        ):
            for k, points in enumerate(_points_of(maps, palette)):
                progress(k / total, "LAZ")
                if len(points.place):
                    record = _record(laspy, header, points)
                    made.add(np.asarray(record["Z"]))
                    writer.write_points(record)

    def check(temporary: Path) -> None:
        found = _Sums()
        with laspy.open(temporary) as reader:
            for chunk in reader.chunk_iterator(1_000_000):
                found.add(np.asarray(chunk["Z"]))
        if found != made:
            raise OSError(5, "found other points than were written")

    write_with(path, write, check)
    return made.count


def las_wkt(crs: str, vertical: str | None) -> str:
    """The CRS of points as LAS wants it (WKT 1), with what their heights are above.

    Args:
        crs: horizontal.
        vertical: of the heights, None = above the ellipsoid.
    """
    if vertical:
        return str(compound_crs(crs, vertical).to_wkt("WKT1_GDAL"))
    plain = CRS.from_user_input(crs)
    return f'COMPD_CS["{plain.name} + ellipsoidal height",{plain.to_wkt("WKT1_GDAL")},{_ELLIPSOID}]'


def write_ply(path: Path, maps: Maps, datum: str, progress: Progress) -> int:
    """Write a binary PLY file of the surface; the number of points.

    Args:
        path: to write.
        maps: what is known of the cells.
        datum: what the heights are above, for a comment.
        progress: told the share done.
    """
    fields = [("x", "f8", "double"), ("y", "f8", "double"), ("z", "f8", "double")]
    if "albedo" in maps.paths:
        fields += [(name, "u1", "uchar") for name in ("red", "green", "blue")]
    for name, product in (("confidence", "prior_confidence"), ("height_std", "dsm_std"), ("validity", "validity")):
        if product in maps.paths:
            code = _ABOUT[name][0]
            fields.append((name, code, "uchar" if code == "u1" else "float"))
    palette = Palette.of(maps, "albedo") if "albedo" in maps.paths else None
    count = sum(int(np.isfinite(maps.read("dsm", *block)).sum()) for block in maps.blocks())
    lines = ["ply", "format binary_little_endian 1.0", f"comment crs {maps.grid.crs}", f"comment heights above {datum}"]
    lines += [f"element vertex {count}", *(f"property {word} {name}" for name, _, word in fields), "end_header"]
    head = ("\n".join(lines) + "\n").encode()
    kind = np.dtype([(name, f"<{code}") for name, code, _ in fields])
    total = sum(1 for _ in maps.blocks())

    def write(temporary: Path) -> None:
        with open(temporary, "xb") as file:
            file.write(head)
            for k, points in enumerate(_points_of(maps, palette)):
                progress(k / total, "PLY")
                _write_block(file, points, kind)

    def check(temporary: Path) -> None:
        if temporary.stat().st_size != len(head) + count * kind.itemsize:
            raise OSError(5, "found a truncated file after writing")

    write_with(path, write, check)
    return count


def _write_block(file: BinaryIO, points: Points, kind: np.dtype) -> None:
    block = np.zeros(len(points.place), kind)
    for k, name in enumerate("xyz"):
        block[name] = points.place[:, k]
    if "red" in (kind.names or ()):
        for k, name in enumerate(("red", "green", "blue")):
            block[name] = points.colour[:, k]
    for name, values in points.more.items():
        block[name] = values
    file.write(block.tobytes())


def _record(laspy: Any, header: Any, points: Points) -> Any:
    record = laspy.ScaleAwarePointRecord.zeros(len(points.place), header=header)
    record.x, record.y, record.z = points.place.T
    for k, name in enumerate(("red", "green", "blue")):
        record[name] = points.colour[:, k].astype(np.uint16) * 257  # LAS has 16 bits
    record["return_number"][:] = 1
    record["number_of_returns"][:] = 1
    validity = points.more.get("validity", np.full(len(points.place), MEASURED))
    filled = (validity == FILLED) | (validity == UNSEEN)
    water = validity == LEVELLED
    record["classification"] = np.select([filled, water], [FILLED_CLASS, WATER_CLASS], UNCLASSIFIED).astype(np.uint8)
    record["synthetic"][:] = filled | water
    for name, values in points.more.items():
        record[name] = values
    return record


@dataclass
class _Sums:
    """Enough of the points to know that all have been written as they are."""

    count: int = 0
    total: int = 0

    def add(self, z: np.ndarray) -> None:
        """Count more points by their raw heights."""
        self.count += len(z)
        self.total += int(z.astype(np.int64).sum())


__all__ = ["FILLED_CLASS", "Points", "las_wkt", "write_laz", "write_ply"]

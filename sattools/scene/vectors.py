"""Features of vector files: the one place where they are read and encoded."""

from __future__ import annotations

import functools
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sattools.errors import InputError
from sattools.scene.jsonio import as_utf8, read_bytes, read_json
from sattools.scene.kml import is_kml, read_kml
from sattools.scene.location import RemotePath, found_instead

log = logging.getLogger(__name__)
FORMATS = "GeoPackage, GeoJSON, shapefile, FlatGeobuf, KML or KMZ"
_MAGIC = (b"SQLite format 3\0", b"\0\0\x27\x0a", b"fgb\x03")  # GeoPackage, shapefile, FlatGeobuf
_LONGEST = 200  # characters of what GDAL says, which repeats coordinates by the page


@dataclass(frozen=True)
class Features:
    """What a layer holds.

    Attributes:
        geometries: shapely geometries, None = a feature without a place.
        columns: values of all features by the column's name.
        crs: as an authority's code or as WKT; None = the file names none.
    """

    geometries: Sequence[Any]
    columns: Mapping[str, NDArray[Any]]
    crs: str | None

    def __len__(self) -> int:
        return len(self.geometries)

    def rows(self) -> list[dict[str, Any]]:
        """The columns' values, feature by feature."""
        return [{name: values[k] for name, values in self.columns.items()} for k in range(len(self))]

    def numeric(self) -> list[str]:
        """Names of the columns that hold numbers."""
        return [name for name, values in self.columns.items() if np.issubdtype(values.dtype, np.number)]


def is_geojson(path: Path) -> bool:
    """Whether a file holds JSON, by its first character."""
    return _head(path).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


def is_vector(path: Path) -> bool:
    """Whether a file begins as one of `FORMATS`. Raises InputError where it cannot be read."""
    return is_geojson(path) or is_kml(_head(path)) or _head(path).startswith(_MAGIC)


def read_features(path: Path, expected: str) -> Features:
    """The features of a file's first layer; of KML, whose folders are none, all.

    Only files that begin as one of `FORMATS`: GDAL opens by content, and a VRT or WFS description under another name
    would make it read other files and hosts. For the same reason files on other machines or in archives are GeoJSON.

    Args:
        path: the file, which may be remote.
        expected: what it should hold, for messages.

    Raises:
        InputError: missing, of another format, or damaged.
    """
    if isinstance(path, RemotePath):
        return _read_layer(
            f"GeoJSON:{path}", f"{path}", f"{expected}: GeoJSON in UTF-8 (download files of other kinds)"
        )
    if is_kml(_head(path)):
        shapes, names = read_kml(path)
        return Features(shapes, {"name": np.array(names, object)}, "EPSG:4326")
    if is_geojson(path):
        read_json(path, "GeoJSON")  # its depth and numbers
        stored = read_bytes(path)
        if (text := as_utf8(stored)) is not stored:  # GDAL knows UTF-8 only
            return _read_layer(text, f"{path}", f"{expected}: {FORMATS}")
    elif not _head(path).startswith(_MAGIC):
        raise InputError(f"{path}: found another format, expected {expected}: {FORMATS}")
    return _read_layer(str(path), f"{path}", f"{expected}: {FORMATS}")


def _read_layer(name: str | bytes, path: str, expected: str) -> Features:
    """The features of the first layer of what GDAL calls by a name; see `read_features` for files.

    Args:
        name: as GDAL understands it, or what the file holds.
        path: what people call it, for messages.
        expected: what it should hold, for messages.

    Raises:
        InputError: GDAL cannot read it.
    """
    import shapely
    from pyogrio.raw import read

    try:
        with warnings.catch_warnings(record=True) as said:  # what GDAL repairs is missing afterwards, and that is told
            warnings.simplefilter("always")
            about, _, encoded, values = read(name)
            shapes = [None] * len(values[0] if values else ()) if encoded is None else shapely.from_wkb(encoded)
    except Exception as error:  # GDAL's drivers raise a dozen kinds
        text = " ".join(str(error).split())[:_LONGEST]
        raise InputError(f"{path}: cannot be read ({text}), expected {expected}") from None
    if any("More than one layer" in str(one.message) for one in said):
        from pyogrio import list_layers

        first, *others = (str(layer) for layer, _ in list_layers(name))
        _tell(f"{path}: found {1 + len(others)} layers, of which the first is read, {first!r}")
    return Features(list(shapes), dict(zip((str(field) for field in about["fields"]), values)), about["crs"])


@functools.lru_cache(maxsize=64)
def _tell(text: str) -> None:
    """Say something of a file once, however often it is read."""
    log.warning("%s", text)


def read_polygons(path: Path, crs: str) -> list[Any]:
    """`numbered_polygons` without their numbers."""
    return list(numbered_polygons(path, crs).values())


def numbered_polygons(path: Path, crs: str) -> dict[int, Any]:
    """The polygons of a vector file, in a CRS.

    Args:
        path: one of `FORMATS`; of those with layers the first is read.
        crs: projected ground CRS [m].

    Returns:
        Shapely polygons and multipolygons by their places in the file from 0, which points and empty features have too.

    Raises:
        InputError: missing, of another format, without a CRS, or without polygons.
    """
    import shapely

    found = read_features(path, "polygons")
    if found.crs is None:
        raise InputError(f"{path}: found no coordinate reference system, expected one")
    try:
        places = in_crs(found.geometries, found.crs, crs)
    except Exception as error:  # of pyproj, shapely and numpy
        text = " ".join(str(error).split())[:_LONGEST]
        raise InputError(f"{path}: cannot be brought to {crs[:80]} ({text}), expected polygons there") from None
    if lost := sum(not np.isfinite(shapely.get_coordinates(shape)).all() for shape in places):
        _tell(f"{path}: {lost} of its features left out, as far as their places cannot be brought to {crs[:80]}")
    areas = enumerate(map(polygons_in, places))
    shapes = {number: shape for number, shape in areas if shape is not None and not shape.is_empty}
    if not shapes:
        raise InputError(f"{path}: found no polygon, expected some")
    if others := sum(_is_other(shape) for shape in found.geometries):
        _tell(f"{path}: {others} of its features left out, as points and lines beside its polygons")
    return shapes


def _is_other(shape: Any) -> bool:
    """Whether a geometry is a point or a line."""
    return shape is not None and not shape.is_empty and shape.geom_type.endswith(("Point", "LineString", "LinearRing"))


def polygons_in(shape: Any) -> Any:
    """The polygons in a geometry, as one whose rings do not cross, with all parts of those that do; None without any.

    Parts whose places a CRS does not know, as that of a zone does not on the other side of the Earth, are left out.

    Args:
        shape: of shapely, or None.
    """
    import shapely

    if shape is not None and shape.geom_type == "GeometryCollection":  # a polygon with a label's point, of KML say
        shape = shapely.MultiPolygon(list(_collected(shape)))
    if shape is None or shape.geom_type not in ("Polygon", "MultiPolygon"):
        return None
    all_parts = shapely.get_parts(shape)
    known = [part for part in all_parts if np.isfinite(shapely.get_coordinates(part)).all()]
    if len(known) < len(all_parts):
        shape = shapely.MultiPolygon(known)
    if shape.is_valid:
        return shape
    parts = [
        _within(part.exterior).difference(shapely.union_all([_within(hole) for hole in part.interiors]))
        for part in shapely.get_parts(shape)
        if not part.is_empty
    ]
    return shapely.union_all(parts)


def _collected(shape: Any) -> Iterator[Any]:
    """All polygons in a geometry of any kind, whose parts may have parts."""
    import shapely

    if shape.geom_type == "Polygon":
        yield shape
    elif shape.geom_type in ("MultiPolygon", "GeometryCollection"):
        for part in shapely.get_parts(shape):
            yield from _collected(part)


def _within(ring: Any) -> Any:
    """All that a ring goes around, in whatever direction and how often ever.

    What one repair leaves out of it the other has: lobes that are gone around the other way, and those gone around
    twice.
    """
    import shapely

    area = shapely.Polygon(ring)
    whole = [part for part in shapely.get_parts(shapely.make_valid(area)) if part.area > 0]
    return shapely.union_all([area.buffer(0), *whole])


def in_crs(geometries: Sequence[Any], source: str, crs: str) -> list[Any]:
    """Geometries, without heights, brought from one CRS to another.

    Args:
        geometries: shapely ones; None stays None.
        source: the CRS they are in.
        crs: the CRS wanted.

    Raises:
        pyproj.exceptions.ProjError: one of the two is none.
    """
    import shapely
    from pyproj import Transformer

    transformer = Transformer.from_crs(source, crs, always_xy=True)
    places = np.array([*geometries, None], object)[:-1]  # an array of objects, also of one kind or of none
    return list(shapely.transform(places, lambda xy: np.column_stack(transformer.transform(xy[:, 0], xy[:, 1]))))


def geopackage(features: Features, layer: str, kind: str, about: str = "") -> bytes:
    """The bytes of a GeoPackage.

    Args:
        features: what it holds.
        layer: name of the layer.
        kind: of its geometries, such as ``MultiPolygon``.
        about: description of the layer.
    """
    import io

    import shapely
    from pyogrio.raw import write

    encoded = shapely.to_wkb(np.array([*features.geometries, None], object)[:-1])
    made = io.BytesIO()  # in memory: on a full disk SQLite leaves half a database without an error
    write(
        made, encoded, list(features.columns.values()), list(features.columns), layer=layer, driver="GPKG",
        geometry_type=kind, crs=features.crs, layer_options={"DESCRIPTION": about} if about else None,
    )  # fmt: skip
    return made.getvalue()


def _head(path: Path) -> bytes:
    try:
        with open(path, "rb") as file:
            return as_utf8(file.read(512))
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path}: found {found_instead(path, error)}, expected a readable {FORMATS}") from None


__all__ = [
    "FORMATS",
    "Features",
    "geopackage",
    "in_crs",
    "is_geojson",
    "is_vector",
    "numbered_polygons",
    "polygons_in",
    "read_features",
    "read_polygons",
]

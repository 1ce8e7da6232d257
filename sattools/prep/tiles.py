"""Products that vendors cut into several files: where in the whole, whose camera lies beside them, a file begins."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sattools.camera import RPC
from sattools.errors import InputError
from sattools.scene.sidecars import tile_of
from sattools.scene.xmlio import find_all


@dataclass(frozen=True)
class Tiles:
    """The files of a product: of one size in rows and columns (Airbus), or each with its corner (DigitalGlobe)."""

    size: tuple[int, int] | None = None  # columns, rows [px]
    corners: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # column, row by name in lower case

    def corner(self, image: Path) -> tuple[float, float] | None:
        """Column and row of a file's first pixel in the whole; None where that is not known.

        Args:
            image: the file.
        """
        tile = tile_of(image.stem)
        if tile is None:
            return None
        if self.size is not None:
            return float((tile[1] - 1) * self.size[0]), float((tile[0] - 1) * self.size[1])
        return self.corners.get(image.stem.lower())


def tiles_of_dimap(root: Any) -> Tiles | None:
    """Tiles of an Airbus product (DIM_*.XML), None where it does not tell, or where they overlap.

    Args:
        root: element of the XML.
    """
    overlaps = [(e.text or "").strip() for name in ("OVERLAP_ROW", "OVERLAP_COL") for e in find_all(root, name)]
    if any(overlap.strip("0.") for overlap in overlaps):  # where they begin then is not documented
        return None
    for element in find_all(root, "NTILES_SIZE"):
        cols, rows = (str(element.get(name, "")).strip() for name in ("ncols", "nrows"))
        if cols.isdigit() and rows.isdigit():
            return Tiles(size=(int(cols), int(rows)))
    return None


def tiles_of_til(text: str) -> Tiles | None:
    """Tiles of a DigitalGlobe product (.TIL), None where it does not tell.

    Args:
        text: of the file.
    """
    corners: dict[str, tuple[float, float]] = {}
    for group in re.split(r"(?im)^\s*BEGIN_GROUP\s*=", text):
        values = {m[1].lower(): m[2].strip().strip('"') for m in re.finditer(r"(\w+)\s*=\s*([^;\n]+)", group)}
        _add(corners, values.get("filename"), values.get("ulcoloffset"), values.get("ulrowoffset"))
    return Tiles(corners=corners) if corners else None


def tiles_of_isd(root: Any) -> Tiles | None:
    """The same of the product's XML.

    Args:
        root: element of the XML.
    """
    corners: dict[str, tuple[float, float]] = {}
    for tile in find_all(root, "TILE"):
        values = {str(e.tag).rsplit("}", 1)[-1].upper(): (e.text or "").strip() for e in tile.iter()}
        _add(corners, values.get("FILENAME"), values.get("ULCOLOFFSET"), values.get("ULROWOFFSET"))
    return Tiles(corners=corners) if corners else None


def _add(corners: dict[str, tuple[float, float]], name: str | None, col: str | None, row: str | None) -> None:
    try:
        place = float(col or ""), float(row or "")
    except ValueError:
        return
    if name:
        corners[Path(name.replace("\\", "/")).stem.lower()] = place


def camera_of_tile(image: Path, rpc: RPC, source: str, tiles: Tiles | None) -> RPC:
    """The camera of a file that is part of a product, from a metadata file's that may be that of the whole.

    Args:
        image: the file.
        rpc: the camera in the metadata file.
        source: path of the metadata file.
        tiles: of the product, where known.

    Raises: InputError where it is not known where the file begins.
    """
    tile = tile_of(image.stem)
    if tile is None or re.search(r"(?i)_r\d+c\d+(?![0-9a-z])", Path(source).stem):
        return rpc  # whole, or metadata of this very tile
    corner = tiles.corner(image) if tiles is not None else None
    if corner is not None:
        return rpc.cropped(*corner)
    if tile == (1, 1):
        return rpc
    raise InputError(
        f"{image}: found row {tile[0]}, column {tile[1]} of a product in tiles whose sizes are not known, expected "
        f"DIM_*.XML (Airbus) or a .TIL file (DigitalGlobe) beside {source}"
    )


__all__ = ["Tiles", "camera_of_tile", "tiles_of_dimap", "tiles_of_isd", "tiles_of_til"]

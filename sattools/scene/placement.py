"""How a raster lies on the ground: its CRS, its grid, and which of its rows is the northernmost."""

from __future__ import annotations

from pathlib import Path

from affine import Affine
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.errors import InputError
from sattools.scene.datums import horizontal
from sattools.scene.globe import whole_turn
from sattools.scene.grid import Grid
from sattools.scene.opening import opened


def crs_of(data: DatasetReader, path: Path) -> str:
    """The horizontal CRS of an open file; InputError, naming it, where it has none of a place on Earth."""
    if data.crs is None:
        raise InputError(f"{path}: found no coordinate reference system, expected a georeferenced raster")
    if not (data.crs.is_projected or data.crs.is_geographic):
        name = " ".join(data.crs.to_wkt().split())[:60]
        raise InputError(f"{path}: found a coordinate reference system of no place on Earth ({name}), expected a map's")
    return horizontal(data.crs)


def grid_of(data: DatasetReader, path: Path) -> Grid:
    """The grid of an open file, whichever of its rows is stored first.

    Args:
        data: the file.
        path: its name, for messages.

    Raises:
        InputError: no CRS, turned, or cells that are not square.
    """
    crs, transform = crs_of(data, path), data.transform
    if not _is_square(data):
        raise InputError(f"{path}: found a rotated or non-square grid, expected square cells along the axes")
    top = transform.f + max(transform.e, 0.0) * data.height
    return Grid(crs, transform.c, top, transform.a, data.width, data.height)


def has_grid(path: Path) -> bool:
    """Whether the cells of a raster are square and not turned, as those of a grid are; raises as `crs_of` does."""
    with opened(path) as data:
        crs_of(data, path)
        return _is_square(data)


def bounds_of_file(data: DatasetReader) -> tuple[float, float, float, float]:
    """(west, south, east, north) of an open file in its CRS, however its cells are turned.

    Args:
        data: the file.
    """
    to = data.transform
    corners = [(col, row) for col in (0, data.width) for row in (0, data.height)]
    xs = [to.a * col + to.b * row + to.c for col, row in corners]
    ys = [to.d * col + to.e * row + to.f for col, row in corners]
    return min(xs), min(ys), max(xs), max(ys)


def place_at(data: DatasetReader, bounds: tuple[float, float, float, float]) -> Affine:
    """From (column, row) of an open file's corners to its CRS, in degrees by whole turns so that it lies on the bounds.

    Args:
        data: the file.
        bounds: (west, south, east, north) of something in its CRS, as `sattools.scene.regrid.bounds_of` gives them.
    """
    place = data.transform
    if not data.crs.is_geographic:
        return place
    own = bounds_of_file(data)
    turn = whole_turn((own[0], own[2]), (bounds[0], bounds[2]))
    return Affine(place.a, place.b, place.c + turn, place.d, place.e, place.f)


def is_south_up(data: DatasetReader) -> bool:
    """Whether the first row that is stored is the southernmost one."""
    return bool(data.transform.e > 0)


def stored_window(data: DatasetReader, rows: slice, cols: slice) -> Window:
    """Where an open file has these rows, counted from the north, and columns."""
    if is_south_up(data):
        rows = slice(data.height - rows.stop, data.height - rows.start)
    return Window.from_slices(rows, cols)


def _is_square(data: DatasetReader) -> bool:
    """Columns from west to east, rows along the parallels, in either direction."""
    to = data.transform
    return abs(to.b) <= 1e-9 and abs(to.d) <= 1e-9 and to.a > 0 and abs(to.a - abs(to.e)) <= 1e-6 * to.a


__all__ = ["bounds_of_file", "crs_of", "grid_of", "has_grid", "is_south_up", "place_at", "stored_window"]

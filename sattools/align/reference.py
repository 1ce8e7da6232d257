"""What a scene is moved onto, read from files: heights around it, control points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.errors import RasterioError
from rasterio.warp import transform as transform_points

from sattools.align.estimate import ControlPoint
from sattools.align.means import LEAST_PARTS
from sattools.camera.ground import from_geographic
from sattools.compare.doubts import check_heights
from sattools.compare.truth import warped_heights
from sattools.errors import InputError
from sattools.scene.grid import Grid
from sattools.scene.memory import check_memory
from sattools.scene.opening import opened
from sattools.scene.placement import crs_of, has_grid
from sattools.scene.raster import raster_grid
from sattools.scene.stored import PIECE_CELLS, pieces
from sattools.scene.tables import read_table
from sattools.scene.vectors import in_crs, is_vector, read_features

COLUMNS = ("z", "item", "column", "row")
TEXTS = ("name", "item")
SPARE_CELLS = 4  # of the reference around what is asked for


def check_reference(path: Path, crs: str) -> None:
    """Raise InputError where a reference can be told to be none without a look for its place.

    Args:
        path: raster of heights, or control points.
        crs: the scene's.
    """
    if holds_points(path):
        read_control_points(path, crs)
        return
    with opened(path) as data:
        crs_of(data, path)
    check_heights(path, one_band=False)


def heights_around(path: Path, grid: Grid, reach: float, step: int = 1) -> tuple[np.ndarray, Grid]:
    """The heights of a raster around a grid, in its CRS, on square cells about as large as the raster's own.

    Only that part is read. Rasters in degrees, as of most free elevation models, and with cells that are not square
    are taken, too.

    Args:
        path: raster in any CRS; its first band are heights, metres unless it says feet.
        grid: of the surface.
        reach: how far around it [m].
        step: cells of the surface that are looked at as one, along an axis: the reference is looked at likewise, unless
            its cells are large anyway.

    Returns:
        ``[H, W]`` float32 [m], NaN = unknown, and its grid.

    Raises:
        InputError: unreadable, without a CRS, or elsewhere.
    """
    own = around = _part(path, grid, reach)
    if step > 1 and own.cell_size < LEAST_PARTS * step * grid.cell_size:
        around = Grid.from_bounds(grid.crs, own.bounds, step * max(own.cell_size, grid.cell_size))
    check_memory(8.0 * around.width * around.height, f"{path}: {around.width} x {around.height} cells", "crop")
    heights = np.empty(around.shape, np.float32)
    cells = around.width * (around.cell_size / own.cell_size) ** 2  # of the raster in a row
    for rows in pieces(around.shape, max(1, int(PIECE_CELLS / cells))):
        heights[rows] = warped_heights(path, around.part(rows, slice(0, around.width)), means=True)
    if not np.isfinite(heights).any():
        raise InputError(f"{path}: found no heights within {reach:g} m of the scene, expected a reference of its place")
    return heights, around


def read_control_points(path: Path, crs: str) -> list[ControlPoint]:
    """Control points of a CSV or a vector file; see `AlignOptions.to` for the columns.

    Args:
        path: the file.
        crs: of ``x`` and ``y``; ``lon``, ``lat`` and the places of vector files are brought to it.

    Raises:
        InputError: unreadable, a column is missing, or a number is none.
    """
    rows = _csv_rows(path, crs) if path.suffix.lower() == ".csv" else _vector_rows(path, crs)
    points = [_point(path, number, row) for number, row in enumerate(rows, 1)]
    if not points:
        raise InputError(f"{path}: found no control point, expected some")
    return points


def holds_points(path: Path) -> bool:
    """Whether a file is a table or a vector file, and no raster."""
    return path.suffix.lower() == ".csv" or (path.is_file() and is_vector(path))


def _part(path: Path, grid: Grid, reach: float) -> Grid:
    """The part of a raster around a grid, of its own cells where these are square and of the same CRS."""
    with opened(path) as data:
        crs, to = crs_of(data, path), data.transform
    west, south, east, north = grid.bounds
    if crs == grid.crs and has_grid(path):
        own = raster_grid(path)
        reach += SPARE_CELLS * own.cell_size
        rows = [round((own.top - side) / own.cell_size) for side in (north + reach, south - reach)]
        columns = [round((side - own.left) / own.cell_size) for side in (west - reach, east + reach)]
        return own.part(slice(*rows), slice(*columns))
    steps = ((0.0, 0.0), (to.a, to.d), (to.b, to.e))  # to the next column and row
    try:
        (x,), (y,) = transform_points(grid.crs, crs, [(west + east) / 2], [(south + north) / 2])
        xs, ys = transform_points(crs, grid.crs, *zip(*((x + e, y + n) for e, n in steps), strict=True))
    except RasterioError as error:
        text = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: cannot be read around the scene ({text}), expected heights there") from None
    # the square of the area that a cell has there
    cell = float(np.sqrt(np.hypot(xs[1] - xs[0], ys[1] - ys[0]) * np.hypot(xs[2] - xs[0], ys[2] - ys[0])))
    reach += SPARE_CELLS * cell
    return Grid.from_bounds(grid.crs, (west - reach, south - reach, east + reach, north + reach), cell)


def _csv_rows(path: Path, crs: str) -> Sequence[Mapping[str, Any]]:
    return [_on_ground(row, crs) for row in read_table(path, "control points", TEXTS)]


def _on_ground(row: Mapping[str, Any], crs: str) -> Mapping[str, Any]:
    """A row with x and y; what is no place stays as it is, to be told of."""
    if row.get("x"):
        return row
    try:
        x, y = (float(v) for v in from_geographic(crs, float(row["lon"]), float(row["lat"])))
    except (KeyError, TypeError, ValueError):
        return {**row, "x": row.get("lon"), "y": row.get("lat")}
    return {**row, "x": x, "y": y}


def _vector_rows(path: Path, crs: str) -> Sequence[Mapping[str, Any]]:
    found = read_features(path, "control points")
    if found.crs is None:
        raise InputError(f"{path}: found no coordinate reference system, expected one")
    wrong = [shape for shape in found.geometries if shape is None or shape.geom_type != "Point" or shape.is_empty]
    if wrong:
        kind = "no place" if wrong[0] is None else wrong[0].geom_type
        raise InputError(f"{path}: found {kind}, expected points")
    rows = []
    places = in_crs(found.geometries, found.crs, crs)
    for own, place, values in zip(found.geometries, places, found.rows(), strict=True):
        height = {"z": own.z} if own.has_z else {}
        told = {name.lower(): value for name, value in values.items() if not _empty(value)}
        rows.append({**height, **told, "x": place.x, "y": place.y})
    return rows


def _empty(value: Any) -> bool:
    """Whether a cell of an attribute table has no value, in any of the ways that formats say so."""
    return value is None or value == "" or (isinstance(value, float) and np.isnan(value))


def _point(path: Path, number: int, row: Mapping[str, Any]) -> ControlPoint:
    missing = [name for name in ("x", "y", *COLUMNS) if row.get(name) in (None, "")]
    if missing:
        wanted = "x, y or lon, lat (or points of a vector file), " + ", ".join(COLUMNS)
        raise InputError(f"{path}: found no {missing[0]} in row {number}, expected {wanted}")
    try:
        x, y, z, column, line = (float(row[name]) for name in ("x", "y", "z", "column", "row"))
    except (TypeError, ValueError):
        raise InputError(f"{path}: found a place that is no number in row {number}, expected numbers") from None
    if not np.isfinite([x, y, z, column, line]).all():
        raise InputError(f"{path}: found a place that is not finite in row {number}, expected numbers")
    return ControlPoint(str(row.get("name") or number), x, y, z, str(row["item"]), column, line)


__all__ = ["check_reference", "heights_around", "holds_points", "read_control_points"]

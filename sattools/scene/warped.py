"""Georeferenced rasters of any cells, in degrees, oblong or turned, on a grid."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from affine import Affine
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.errors import InputError
from sattools.scene.globe import columns_of_turn
from sattools.scene.grid import Grid
from sattools.scene.opening import opened
from sattools.scene.placement import bounds_of_file, crs_of, place_at
from sattools.scene.raster import read_window
from sattools.scene.regrid import bounds_in, bounds_of, warp_map

_SPARE_CELLS = 4  # around a part, in which interpolation looks


def read_warped(
    path: Path,
    target: Grid,
    known: Callable[[np.ndarray], np.ndarray] | None = None,
    *,
    nearest: bool = False,
    means: bool = False,
) -> np.ndarray:
    """A raster ``[B, h, w]`` float32 on a grid, of which only the part that lies there is read.

    As `sattools.scene.raster.read_on`, for rasters that have no grid of the suite's.

    Args:
        path: the file.
        target: the grid; NaN where the raster is not.
        known: makes NaN of what are no numbers, before anything is interpolated.
        nearest: take the nearest cell instead of interpolating.
        means: see `sattools.scene.regrid.reproject_map`.

    Raises:
        InputError: unreadable, or without a CRS.
        SceneError: no transformation between the two CRS is known.
    """
    with opened(path) as data:
        crs = crs_of(data, path)
        west, south, east, north = bounds_in(crs, target.widened(_SPARE_CELLS))
        place = place_at(data, (west, south, east, north))
        corners = [_mapped(~place, x, y) for x in (west, east) for y in (south, north)]
        cols, rows = zip(*corners, strict=True)
        left, top, bottom = 0, 0, 0
        pieces: list[tuple[int, int]] = []
        if all(math.isfinite(number) for number in (*cols, *rows)):
            top = max(0, math.floor(min(rows)) - _SPARE_CELLS)
            bottom = min(data.height, math.ceil(max(rows)) + _SPARE_CELLS)
            wanted = math.floor(min(cols)) - _SPARE_CELLS, math.ceil(max(cols)) + _SPARE_CELLS
            left, pieces = _columns(data, wanted)
        if not pieces or top >= bottom:
            return np.full((data.count, *target.shape), np.nan, np.float32)
        windows = [Window(first, top, last - first, bottom - top) for first, last in pieces]
        read = [read_window(data, path, window) for window in windows]
        array = read[0] if len(read) == 1 else np.concatenate(read, axis=2)
        array = array.astype(np.float32) if known is None else known(array)
        first = _mapped(place, left, top)
        transform = Affine(place.a, place.b, first[0], place.d, place.e, first[1])
        return warp_map(array, crs, transform, target, nearest=nearest, means=means)


def _columns(data: DatasetReader, wanted: tuple[int, int]) -> tuple[int, list[tuple[int, int]]]:
    """The first of the columns wanted, and where a file has them: of one around the globe beyond its edges, too.

    Args:
        data: the file.
        wanted: the first column and the one after the last; those of files around the globe go on beyond their edges.

    Returns:
        The number of the first, and pieces from west to east.
    """
    to = data.transform
    turn = columns_of_turn(data.width, to.a) if data.crs.is_geographic and to.b == to.d == 0 else None
    if turn is None:
        left, right = max(0, wanted[0]), min(data.width, wanted[1])
        return left, [(left, right)] if left < right else []
    pieces, column, last = [], wanted[0], min(wanted[1], wanted[0] + turn)
    while column < last:
        first = column % turn
        count = min(turn - first, last - column)
        pieces.append((first, first + count))
        column += count
    return wanted[0], pieces


def ground_grid(path: Path, crs_at: Callable[[float, float], str]) -> Grid:
    """A grid of square cells over all of a raster, which have about the area of its own.

    Args:
        path: the file.
        crs_at: gives a projected CRS [m] for the longitude and latitude of its middle.

    Raises:
        InputError: unreadable, without a CRS, or of no place in that CRS.
        SceneError: no transformation between the two CRS is known.
    """
    with opened(path) as data:
        own, around, shape = crs_of(data, path), bounds_of_file(data), data.shape
        cell_area = abs(data.transform.determinant)
        if data.crs.is_geographic and columns_of_turn(data.width, data.transform.a):
            raise InputError(f"{path}: found a raster around the globe, expected one of its place (crop it)")
    west, south, east, north = bounds_of("EPSG:4326", own, around)
    if not all(math.isfinite(edge) for edge in (west, south, east, north)):
        raise InputError(f"{path}: found coordinates that its CRS, {own}, does not reach, expected those of its place")
    crs = crs_at((west + east) / 2, (south + north) / 2)
    box = bounds_of(crs, own, around)
    if not (all(math.isfinite(edge) for edge in box) and box[0] < box[2] and box[1] < box[3]):
        raise InputError(f"{path}: found a raster that does not lie within {crs}, expected one of its place")
    covered = (box[2] - box[0]) * (box[3] - box[1])
    own_box = (around[2] - around[0]) * (around[3] - around[1])
    # a raster that is turned leaves the corners of its box empty
    share = cell_area * shape[0] * shape[1] / own_box
    if share < 1 - 1e-6:
        covered *= share
    cell = math.sqrt(covered / (shape[0] * shape[1]))
    return Grid.from_bounds(crs, box, cell)


def _mapped(to: Affine, x: float, y: float) -> tuple[float, float]:
    return to.a * x + to.b * y + to.c, to.d * x + to.e * y + to.f


__all__ = ["ground_grid", "read_warped"]

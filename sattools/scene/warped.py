"""Georeferenced rasters of any cells, in degrees, oblong or turned, on a grid."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from affine import Affine
from rasterio.windows import Window

from sattools.errors import InputError
from sattools.scene.grid import Grid
from sattools.scene.opening import opened
from sattools.scene.placement import crs_of, place_at
from sattools.scene.raster import read_window
from sattools.scene.regrid import bounds_in, bounds_of, warp_map

_SPARE_CELLS = 4  # around a part, in which interpolation looks


def read_warped(
    path: Path, target: Grid, known: Callable[[np.ndarray], np.ndarray] | None = None, *, nearest: bool = False
) -> np.ndarray:
    """A raster ``[B, h, w]`` float32 on a grid, of which only the part that lies there is read.

    As `sattools.scene.raster.read_on`, for rasters that have no grid of the suite's.

    Args:
        path: the file.
        target: the grid; NaN where the raster is not.
        known: makes NaN of what are no numbers, before anything is interpolated.
        nearest: take the nearest cell instead of interpolating.

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
        window = None
        if all(math.isfinite(number) for number in (*cols, *rows)):
            left, top = max(0, math.floor(min(cols)) - _SPARE_CELLS), max(0, math.floor(min(rows)) - _SPARE_CELLS)
            right = min(data.width, math.ceil(max(cols)) + _SPARE_CELLS)
            bottom = min(data.height, math.ceil(max(rows)) + _SPARE_CELLS)
            window = Window(left, top, right - left, bottom - top) if left < right and top < bottom else None
        if window is None:
            return np.full((data.count, *target.shape), np.nan, np.float32)
        array = read_window(data, path, window)
        array = array.astype(np.float32) if known is None else known(array)
        first = _mapped(place, left, top)
        transform = Affine(place.a, place.b, first[0], place.d, place.e, first[1])
        return warp_map(array, crs, transform, target, nearest=nearest)


def ground_grid(path: Path, crs_at: Callable[[float, float], str]) -> Grid:
    """A grid of square cells over all of a raster, about as large as its own.

    Args:
        path: the file.
        crs_at: gives a projected CRS [m] for the longitude and latitude of its middle.

    Raises:
        InputError: unreadable, without a CRS, or of no place in that CRS.
        SceneError: no transformation between the two CRS is known.
    """
    with opened(path) as data:
        own, shape = crs_of(data, path), data.shape
        corners = [_mapped(data.transform, col, row) for col in (0, data.width) for row in (0, data.height)]
    xs, ys = zip(*corners, strict=True)
    around = min(xs), min(ys), max(xs), max(ys)
    west, south, east, north = bounds_of("EPSG:4326", own, around)
    crs = crs_at((west + east) / 2, (south + north) / 2)
    box = bounds_of(crs, own, around)
    if not (all(math.isfinite(edge) for edge in box) and box[0] < box[2] and box[1] < box[3]):
        raise InputError(f"{path}: found a raster that does not lie within {crs}, expected one of its place")
    cell = math.sqrt((box[2] - box[0]) * (box[3] - box[1]) / (shape[0] * shape[1]))
    return Grid.from_bounds(crs, box, cell)


def _mapped(to: Affine, x: float, y: float) -> tuple[float, float]:
    return to.a * x + to.b * y + to.c, to.d * x + to.e * y + to.f


__all__ = ["ground_grid", "read_warped"]

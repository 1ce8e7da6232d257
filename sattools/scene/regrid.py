"""Maps of one ground grid on another: the one place where cells change their size or their lattice."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache

import numpy as np
from affine import Affine

from sattools.errors import SceneError
from sattools.scene.globe import columns_of_turn, whole_turn
from sattools.scene.grid import Grid

_SPARE_CELLS = 4  # around a part, in which interpolation looks
_FINER = 0.95  # times as wide as a target's cells, below which GDAL widens its bilinear kernel


def reproject_map(
    array: np.ndarray, source: Grid, target: Grid, *, nearest: bool = False, means: bool = False
) -> np.ndarray:
    """A map on a grid of any CRS and lattice; NaN = no value, also outside.

    Bilinear; onto larger cells by GDAL's widened kernel, which reaches over the neighbouring ones, too. A cell is NaN
    where the nearest source cell is, so that interpolation neither shrinks holes nor grows them.

    Args:
        array: ``[H, W]`` or ``[B, H, W]``.
        source: its grid.
        target: grid to resample to.
        nearest: take the nearest cell instead of interpolating.
        means: take the mean over each of ``target``'s cells where they are larger. That is what a bilinear value is
            over cells of one size, and leaves walls where they are.

    Returns:
        ``[h, w]`` or ``[B, h, w]`` float32.

    Raises:
        SceneError: no transformation between the two CRS is known.
    """
    if source == target:
        return array.astype(np.float32)
    return warp_map(array, source.crs, source.transform, target, nearest=nearest, means=means)


def warp_map(
    array: np.ndarray, crs: str, transform: Affine, target: Grid, *, nearest: bool = False, means: bool = False
) -> np.ndarray:
    """`reproject_map` of a map with cells of any shape.

    Args:
        array: ``[H, W]`` or ``[B, H, W]``.
        crs: its CRS.
        transform: from (column, row) of cells' corners to that CRS.
        target: grid to resample to.
        nearest: take the nearest cell instead of interpolating.
        means: take the mean over each of ``target``'s cells where they are larger. That is what a bilinear value is
            over cells of one size, and leaves walls where they are.

    Returns:
        ``[h, w]`` or ``[B, h, w]`` float32.

    Raises:
        SceneError: no transformation between the two CRS is known.
    """
    from rasterio.enums import Resampling
    from rasterio.warp import reproject

    turned = bool(transform.b or transform.d)
    wide, high = _cell_on(array, crs, transform, target) if turned or means else (1.0, 1.0)
    # of maps that are turned GDAL takes the box for the size, and would blur what has the target's cells
    scales = {"XSCALE": wide, "YSCALE": high} if turned else {}

    def warp(method: Resampling) -> np.ndarray:
        result = np.full((*array.shape[:-2], *target.shape), np.nan, dtype=np.float32)
        with _ways(crs, target.crs):
            reproject(
                array.astype(np.float32),
                result,
                src_transform=transform,
                src_crs=crs,
                src_nodata=np.nan,
                dst_transform=target.transform,
                dst_crs=target.crs,
                dst_nodata=np.nan,
                resampling=method,
                **scales,
            )
        return result

    near = warp(Resampling.nearest)
    if nearest:
        return near
    smooth = Resampling.average if means and max(wide, high) < _FINER else Resampling.bilinear
    return np.where(np.isfinite(near), warp(smooth), np.float32(np.nan))


def _cell_on(array: np.ndarray, crs: str, transform: Affine, target: Grid) -> tuple[float, float]:
    """Width and height of a cell in the middle of a map, in cells of a grid; 1 where the grid's CRS does not reach."""
    from rasterio.warp import transform as in_other

    rows, cols = array.shape[-2] / 2, array.shape[-1] / 2
    corners = [(cols, rows), (cols + 1, rows), (cols, rows + 1)]
    xs = [transform.a * col + transform.b * row + transform.c for col, row in corners]
    ys = [transform.d * col + transform.e * row + transform.f for col, row in corners]
    with _ways(crs, target.crs):
        xs, ys = in_other(crs, target.crs, xs, ys)
    wide, high = (math.hypot(xs[k] - xs[0], ys[k] - ys[0]) / target.cell_size for k in (1, 2))
    return (wide, high) if math.isfinite(wide + high) else (1.0, 1.0)


@contextmanager
def _ways(source: str, target: str) -> Iterator[None]:
    """What GDAL says where it cannot get from one CRS to another, as a SceneError."""
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import RasterioError

    try:
        yield
    except (RasterioError, CPLE_BaseError) as error:
        text = " ".join(str(error).split())[:120]
        raise SceneError(
            f"grid: found no way from {source[:80]} to {target[:80]} ({text}), expected CRS of one place"
        ) from None


def bounds_in(crs: str, grid: Grid) -> tuple[float, float, float, float]:
    """(west, south, east, north) of a grid in another CRS; infinite where it does not lie in its reach.

    Args:
        crs: the other one.
        grid: in any CRS.

    Raises:
        SceneError: no transformation between the two CRS is known.
    """
    return bounds_of(crs, grid.crs, grid.bounds)


def bounds_of(crs: str, own: str, bounds: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """`bounds_in` of (west, south, east, north) in a CRS of their own; in degrees, east goes on beyond 180."""
    if own == crs:
        return bounds
    from rasterio.warp import transform_bounds

    with _ways(own, crs):
        west, south, east, north = transform_bounds(own, crs, *bounds)
    return west, south, east + (360.0 if east < west else 0.0), north  # which is how PROJ tells of the antimeridian


def window_around(grid: Grid, target: Grid) -> tuple[slice, slice] | None:
    """Rows and columns of a grid that lie on another one, and a few more for interpolation; None where none do.

    Args:
        grid: its cells are meant.
        target: grid in any CRS.

    Raises:
        SceneError: no transformation between the two CRS is known.
    """
    box = _around(grid, target)
    return None if box is None else _within(grid, box)


def windows_around(grid: Grid, target: Grid) -> list[tuple[float, tuple[slice, slice]]]:
    """`window_around` in pieces from west to east, which meet where a grid around the globe begins; none where none do.

    Args:
        grid: its cells are meant.
        target: grid in any CRS.

    Returns:
        By how many degrees to move the grid, so that the pieces lie side by side, and rows and columns of it.

    Raises:
        SceneError: no transformation between the two CRS is known.
    """
    box = _around(grid, target)
    if box is None:
        return []
    turn = columns_of_turn(grid.width, grid.cell_size) if _in_degrees(grid.crs) else None
    if turn is None:
        found = _within(grid, box)
        return [] if found is None else [(0.0, found)]
    once = replace(grid, width=turn)
    pieces = [(by, _within(once.moved(by, 0.0), box)) for by in (-360.0, 0.0, 360.0)]
    return [(by, found) for by, found in pieces if found is not None]


def _around(grid: Grid, target: Grid) -> tuple[float, float, float, float] | None:
    """The part of a grid's CRS that lies on another grid, and a little more; None where it is out of reach."""
    west, south, east, north = bounds_in(grid.crs, target)
    if _in_degrees(grid.crs):
        turn = whole_turn((west, east), (grid.bounds[0], grid.bounds[2]))
        west, east = west + turn, east + turn
    # cells of a CRS in degrees are no lengths of the other's
    spare = _SPARE_CELLS * max(grid.cell_size, (east - west) / target.width)
    box = (west - spare, south - spare, east + spare, north + spare)
    return box if all(math.isfinite(edge) for edge in box) else None


def _within(grid: Grid, box: tuple[float, float, float, float]) -> tuple[slice, slice] | None:
    try:
        return grid.window(Grid.from_bounds(grid.crs, box, grid.cell_size))
    except SceneError:
        return None


@lru_cache(maxsize=32)
def _in_degrees(crs: str) -> bool:
    from rasterio.crs import CRS

    return bool(CRS.from_user_input(crs).is_geographic)


def resize_map(array: np.ndarray, source: Grid, target: Grid) -> np.ndarray:
    """A map on a grid with the same upper left corner: the mean over coarser cells, bilinear on finer ones.

    NaN = unknown; a cell is known where more than half of what it is made of is.

    Args:
        array: ``[H, W]``.
        source: its grid.
        target: grid to resample to; its cells beyond the source continue the border.

    Returns:
        ``[h, w]`` float32.
    """
    import cv2

    factor = target.cell_size / source.cell_size
    size = [math.ceil(n * factor - 1e-6) for n in target.shape]  # what cells of another size cover of the source
    edge = [(0, max(0, wanted - found)) for wanted, found in zip(size, array.shape, strict=True)]
    whole = np.pad(array, edge, mode="edge")[: size[0], : size[1]].astype(np.float32)
    known = np.isfinite(whole)
    layers = (np.where(known, whole, np.float32(0)), known.astype(np.float32))
    if factor > 1:
        value, weight = (_means(layer, factor, target.shape) for layer in layers)
    elif any(abs(n * factor - covered) > 1e-6 for n, covered in zip(target.shape, size, strict=True)):
        value, weight = (_between(layer, factor, target.shape) for layer in layers)  # OpenCV would stretch the map
    else:
        value, weight = (cv2.resize(layer, target.shape[::-1], interpolation=cv2.INTER_LINEAR) for layer in layers)
    mean: np.ndarray = value / np.maximum(weight, np.float32(1e-6))
    return np.where(weight > 0.5, mean, np.float32(np.nan))


def _means(values: np.ndarray, factor: float, shape: tuple[int, ...]) -> np.ndarray:
    """Means over cells ``factor`` times as wide, also where that is no whole number."""
    for axis, count in enumerate(shape):
        whole = np.moveaxis(values, axis, 0).astype(np.float64)
        total = np.concatenate([np.zeros((1, *whole.shape[1:])), np.cumsum(whole, axis=0)])
        edges = np.minimum(np.arange(count + 1) * factor, len(whole))
        before = np.minimum(np.floor(edges + 1e-9).astype(int), len(whole) - 1)
        share = np.clip(edges - before, 0, 1)[:, None]
        upto = total[before] + share * (total[before + 1] - total[before])
        values = np.moveaxis(np.diff(upto, axis=0) / factor, 0, axis)
    return values.astype(np.float32)


def _between(values: np.ndarray, factor: float, shape: tuple[int, ...]) -> np.ndarray:
    """Bilinear values at the centres of cells ``factor`` times as wide; beyond the last centres, theirs."""
    for axis, count in enumerate(shape):
        whole = np.moveaxis(values, axis, -1)
        at = np.clip((np.arange(count) + 0.5) * factor - 0.5, 0, whole.shape[-1] - 1)
        before = np.minimum(at.astype(int), max(0, whole.shape[-1] - 2))
        share = (at - before).astype(np.float32)
        after = np.minimum(before + 1, whole.shape[-1] - 1)
        values = np.moveaxis(whole[..., before] * (1 - share) + whole[..., after] * share, -1, axis)
    return values


def nearest_cells(array: np.ndarray, source: Grid, target: Grid) -> np.ndarray:
    """Values of the cells that lie at the centres of the cells of a grid with the same upper left corner.

    Args:
        array: ``[H, W]``.
        source: its grid.
        target: grid to resample to; its cells beyond the source continue the border.

    Returns:
        ``[h, w]`` of the same type.
    """
    factor = target.cell_size / source.cell_size
    # just below the middle, so that halves of cells are not decided by rounding
    rows, cols = (
        np.minimum(((np.arange(n) + 0.5) * factor - 1e-6).astype(int), most - 1)
        for n, most in zip(target.shape, array.shape, strict=True)
    )
    return array[np.ix_(rows, cols)]


def sample_map(array: np.ndarray, source: Grid, target: Grid, outside: float | None = None) -> np.ndarray:
    """A map without gaps at the centres of another grid's cells in the same CRS, bilinear.

    Args:
        array: ``[H, W]`` or ``[H, W, C]``.
        source: its grid.
        target: grid to resample to.
        outside: value beyond the source; None = that of its border.

    Returns:
        ``[h, w]`` or ``[h, w, C]`` float32.
    """
    from scipy.ndimage import map_coordinates

    col = (target.x() - source.left) / source.cell_size - 0.5
    row = (source.top - target.y()) / source.cell_size - 0.5
    where = np.meshgrid(row, col, indexing="ij")
    layers = array[..., None] if array.ndim == 2 else array
    sampled = np.stack(
        [
            map_coordinates(layers[..., k].astype(np.float64), where, order=1, mode="nearest")
            for k in range(layers.shape[2])
        ],
        axis=-1,
    ).astype(np.float32)
    if outside is not None:
        rows = (row < -0.5) | (row > source.height - 0.5)
        cols = (col < -0.5) | (col > source.width - 0.5)
        sampled[rows[:, None] | cols[None, :]] = outside
    return sampled[..., 0] if array.ndim == 2 else sampled


def split_cells(array: np.ndarray) -> np.ndarray:
    """A map ``[..., H, W]`` on cells of half the size, ``[..., 2 H, 2 W]``: every cell as four equal ones."""
    return array.repeat(2, axis=-2).repeat(2, axis=-1)


__all__ = [
    "bounds_in",
    "bounds_of",
    "nearest_cells",
    "reproject_map",
    "resize_map",
    "sample_map",
    "split_cells",
    "warp_map",
    "window_around",
    "windows_around",
]

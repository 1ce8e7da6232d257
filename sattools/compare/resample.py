"""Carry a raster onto another grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sattools.scene.grid import Grid


def resampled(array: np.ndarray, grid: Grid, target: Grid, nearest: bool = False) -> np.ndarray:
    """`array` [H, W] or [B, H, W] on `grid`, as float32 on `target`; NaN = no value, also outside.

    Bilinear (averaging where `target` is coarser). A cell is NaN where the nearest source cell is, so that
    interpolation neither shrinks holes nor grows them.

    Args:
        array: see above.
        grid: of the array.
        target: grid to resample to.
        nearest: take the nearest cell instead of interpolating.
    """
    if grid == target:
        return array.astype(np.float32)
    from rasterio.enums import Resampling
    from rasterio.warp import reproject

    def warp(source: np.ndarray, method: Resampling) -> np.ndarray:
        result = np.full((*source.shape[:-2], *target.shape), np.nan, dtype=np.float32)
        reproject(
            source.astype(np.float32),
            result,
            src_transform=grid.transform,
            src_crs=grid.crs,
            src_nodata=np.nan,
            dst_transform=target.transform,
            dst_crs=target.crs,
            dst_nodata=np.nan,
            resampling=method,
        )
        return result

    near = warp(array, Resampling.nearest)
    if nearest:
        return near
    return np.where(np.isfinite(near), warp(array, Resampling.bilinear), np.float32(np.nan))


def padded(grid: Grid, cells: int) -> Grid:
    """`grid` with `cells` more cells on every side."""
    reach = cells * grid.cell_size
    return replace(
        grid,
        left=grid.left - reach,
        top=grid.top + reach,
        width=grid.width + 2 * cells,
        height=grid.height + 2 * cells,
    )


def moved(grid: Grid, east_m: float, north_m: float) -> Grid:
    """`grid` moved by metres.

    Args:
        grid: to move.
        east_m: eastwards [m].
        north_m: northwards [m].
    """
    return replace(grid, left=grid.left + east_m, top=grid.top + north_m)

"""The surface as an image sees it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sattools.camera.ground import ground_rays, project
from sattools.camera.rpc import RPC
from sattools.scene.grid import Grid

SKIP = 8  # pixels between lines of sight that are worked out; between them they are interpolated


def seen_by(
    rpc: RPC,
    shape: tuple[int, int],
    grid: Grid,
    height: np.ndarray,
    layers: Sequence[np.ndarray],
    z_range: tuple[float, float],
) -> tuple[np.ndarray, list[np.ndarray]]:
    """March every pixel's line of sight down to the surface.

    Args:
        rpc: the image's camera.
        shape: (rows, columns) of the image.
        grid: grid of the surface.
        height: ``[H, W]`` metres; NaN = unknown, which nothing meets.
        layers: further maps ``[H, W]`` to read where the line of sight ends.
        z_range: heights between which the surface lies [m].

    Returns:
        Height of the surface seen by each pixel ``[rows, columns]`` float32, and each layer there; NaN where a line of
        sight meets no known part of the surface.
    """
    rows, cols = _window(rpc, shape, grid, z_range)
    part = rows.stop - rows.start, cols.stop - cols.start
    if part == shape:
        return _seen_by(rpc, shape, grid, height, layers, z_range)
    whole = [np.full(shape, np.nan, np.float32) for _ in range(1 + len(layers))]
    if min(part) > 0:
        seen, values = _seen_by(rpc.cropped(cols.start, rows.start), part, grid, height, layers, z_range)
        for full, found in zip(whole, [seen, *values], strict=True):
            full[rows, cols] = found
    return whole[0], whole[1:]


def _window(rpc: RPC, shape: tuple[int, int], grid: Grid, z_range: tuple[float, float]) -> tuple[slice, slice]:
    """Rows and columns of an image that may show a grid, none or all of them."""
    west, south, east, north = grid.bounds
    x, y, z = np.meshgrid(np.linspace(west, east, 5), np.linspace(south, north, 5), z_range)
    places = project(rpc, grid.crs, x.ravel(), y.ravel(), z.ravel())
    if not np.isfinite(places).all():
        return slice(0, shape[0]), slice(0, shape[1])
    (first_col, last_col), (first_row, last_row) = ((np.floor(p.min()) - SKIP, np.ceil(p.max()) + SKIP) for p in places)
    rows, cols = (np.clip([a, b], 0, n) for a, b, n in zip((first_row, first_col), (last_row, last_col), shape))
    return slice(int(rows[0]), int(rows[1])), slice(int(cols[0]), int(cols[1]))


def _seen_by(
    rpc: RPC,
    shape: tuple[int, int],
    grid: Grid,
    height: np.ndarray,
    layers: Sequence[np.ndarray],
    z_range: tuple[float, float],
) -> tuple[np.ndarray, list[np.ndarray]]:
    """`seen_by` of all pixels."""
    import cv2

    from sattools.prior.visibility.kernels import descend

    low, high = z_range
    rows, cols = shape
    r = np.arange(0, rows + SKIP, SKIP, dtype=np.float64)
    c = np.arange(0, cols + SKIP, SKIP, dtype=np.float64)
    grid_c, grid_r = np.meshgrid(c, r)
    ends = ground_rays(rpc, grid.crs, grid_c, grid_r, low, high)
    map_c, map_r = np.meshgrid(np.arange(cols, dtype=np.float32) / SKIP, np.arange(rows, dtype=np.float32) / SKIP)

    def cells(points: np.ndarray) -> np.ndarray:
        """Grid (row, column) of all pixels' points, ``[rows, columns, 2]`` float32."""
        positions = (grid.top - points[..., 1], points[..., 0] - grid.left)
        return np.stack(
            [
                cv2.remap((p / grid.cell_size - 0.5).astype(np.float32), map_c, map_r, cv2.INTER_LINEAR)
                for p in positions
            ],
            axis=-1,
        )

    bottom, top = (cells(end) for end in ends)
    surface = np.where(np.isfinite(height), height, -np.inf).astype(np.float32)
    depth = np.empty(shape, np.float32)
    where = np.empty((*shape, 2), np.int64)
    descend(surface, bottom, top, low, high, depth, where)
    hit = np.isfinite(depth)
    values = [np.where(hit, layer[where[..., 0], where[..., 1]], np.nan).astype(np.float32) for layer in layers]
    return depth, values


__all__ = ["seen_by"]

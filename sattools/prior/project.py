"""The surface as an image sees it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sattools.camera.ground import crop_window, ground_rays
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
    import cv2

    from sattools.prior.visibility.kernels import descend

    found = [np.full(shape, np.nan, np.float32) for _ in range(1 + len(layers))]
    left, upper, cols, rows = crop_window(rpc, grid.crs, grid.bounds, z_range, shape, SKIP)
    if min(rows, cols) == 0:
        return found[0], found[1:]
    own, camera = (slice(upper, upper + rows), slice(left, left + cols)), rpc.cropped(left, upper)
    low, high = z_range
    r = np.arange(0, rows + SKIP, SKIP, dtype=np.float64)
    c = np.arange(0, cols + SKIP, SKIP, dtype=np.float64)
    grid_c, grid_r = np.meshgrid(c, r)
    ends = ground_rays(camera, grid.crs, grid_c, grid_r, low, high)
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
    depth = np.empty((rows, cols), np.float32)
    where = np.empty((rows, cols, 2), np.int64)
    descend(surface, bottom, top, low, high, depth, where)
    hit = np.isfinite(depth)
    found[0][own] = depth
    for whole, layer in zip(found[1:], layers, strict=True):
        whole[own] = np.where(hit, layer[where[..., 0], where[..., 1]], np.nan)
    return found[0], found[1:]


__all__ = ["seen_by"]

"""Where the cells of a grid are in an image: the RPC at some of them, and what lies between."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sattools.camera.ground import project, to_geographic
from sattools.camera.rpc import RPC
from sattools.scene.grid import Grid

STEP = 32  # cells between those at which the RPC is evaluated

Array = NDArray[np.float64]


def project_cells(rpc: RPC, grid: Grid, height: NDArray[np.float32]) -> tuple[Array, Array]:
    """Columns and rows ``[H, W]`` [px] of an image at which the cells' middles are seen.

    The RPC is evaluated at every 32nd cell and three heights; bilinear between the cells and quadratic in height, which
    is right to some thousandths of a pixel.

    Args:
        rpc: camera of the image.
        grid: of the cells.
        height: ``[H, W]`` [m above the ellipsoid], none unknown.
    """
    low, high = float(height.min()), float(height.max())
    half = max((high - low) / 2, 1.0)
    middle = (low + high) / 2
    rows, cols = _nodes(grid.height), _nodes(grid.width)
    x, y = np.meshgrid(grid.x()[0] + cols * grid.cell_size, grid.y()[0] - rows * grid.cell_size)
    lon, lat = to_geographic(grid.crs, x, y)
    seen = [rpc.projection(lon, lat, np.full(lon.shape, middle + t * half)) for t in (-1.0, 0.0, 1.0)]
    t = (height.astype(np.float64) - middle) / half
    found = []
    for below, at, above in zip(*seen, strict=True):
        linear, curved = (above - below) / 2, (above + below) / 2 - at
        a, b, c = (_between(part, grid.shape) for part in (at, linear, curved))
        found.append(a + t * (b + t * c))
    return found[0], found[1]


def project_plane(rpc: RPC, grid: Grid, z: float) -> tuple[Array, Array]:
    """Columns and rows ``[H, W]`` [px] of an image at which the cells' middles are seen, all at height ``z`` [m].

    The RPC is evaluated at every 32nd cell and bilinear between these: a map projection and two cubics for every cell
    took a tenth of the matching's time.

    Args:
        rpc: camera of the image.
        grid: of the cells.
        z: height above the ellipsoid [m].
    """
    rows, cols = _nodes(grid.height), _nodes(grid.width)
    x, y = np.meshgrid(grid.x()[0] + cols * grid.cell_size, grid.y()[0] - rows * grid.cell_size)
    col, row = (_between(part, grid.shape) for part in project(rpc, grid.crs, x, y, z))
    return col, row


def _nodes(count: int) -> Array:
    """Numbers of the cells along an axis at which the RPC is evaluated; the last one may lie beyond."""
    return np.arange(0, count + STEP, STEP, dtype=np.float64)


def _between(values: Array, shape: tuple[int, int]) -> Array:
    """Bilinear values ``[H, W]`` of those at nodes, in the same unit."""
    row, down = np.divmod(np.arange(shape[0]), STEP)
    col, across = np.divmod(np.arange(shape[1]), STEP)
    u, v = down[:, None] / STEP, across / STEP
    lines = values[row] * (1 - u) + values[row + 1] * u
    return np.asarray(lines[:, col] * (1 - v) + lines[:, col + 1] * v)


__all__ = ["project_cells", "project_plane"]

"""Ground that alignment is tried on."""

from __future__ import annotations

from typing import Any

import numpy as np

from sattools.scene.grid import Grid

CRS = "EPSG:32617"
GRID = Grid(crs=CRS, left=436000.0, top=3355400.0, cell_size=1.0, width=400, height=400)


def relief(x: Any, y: Any) -> Any:
    """Hills of 8 to 30 m, smooth, so that heights between cells are known [m]."""
    hills = 12 * np.sin(x / 35.0) * np.cos(y / 28.0) + 8 * np.sin(x / 71.0 + 1) + 4 * np.cos((x + y) / 19.0)
    return hills.astype(np.float32)


def surface(grid: Grid, moved: tuple[float, float, float] = (0.0, 0.0, 0.0), fine: int = 1) -> Any:
    """Means of the relief over the cells of a grid, as if it stood elsewhere."""
    small = Grid(grid.crs, grid.left, grid.top, grid.cell_size / fine, grid.width * fine, grid.height * fine)
    x, y = np.meshgrid(small.x() - 436000.0 - moved[0], small.y() - 3355000.0 - moved[1])
    heights = relief(x, y) + np.float32(moved[2])
    return heights.reshape(grid.height, fine, grid.width, fine).mean(axis=(1, 3))


def tilted(height: Any, grid: Grid, along: tuple[float, float]) -> Any:
    x, y = np.meshgrid(grid.x() - 436200.0, grid.y() - 3355200.0)
    return (height + along[0] * x + along[1] * y).astype(np.float32)

"""What stands around an area shades parts of it, and hides parts of it from cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sattools.errors import InputError
from sattools.render.shadows import light_from
from sattools.scene import Grid, Scene
from sattools.scene.files import written
from sattools.scene.raster import read_raster
from sattools.scene.regrid import reproject_map

PRODUCT = "prior_surroundings"
_SPARE_CELLS = 2  # slopes of the cells at the border
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Around:
    """The ground around an area.

    Attributes:
        layers: heights ``[H, W]`` [m], NaN = unknown, and their grids, which may reach over the area, too; a later one
            counts where several are known.
        area: its grid; what is further away than its longest edge casts no shadow into it.
    """

    layers: tuple[tuple[NDArray[np.float32], Grid], ...]
    area: Grid

    def light_from(self, height: NDArray[np.float32], cell_size: float, direction: Vector) -> NDArray[np.float32]:
        """Share ``[H, W]`` of the light from a direction that reaches the area's cells past all around them.

        Args:
            height: ``[H, W]`` of the area [m].
            cell_size: edge of a cell [m].
            direction: unit vector (east, north, up) from the ground.
        """
        east, north, up = direction
        across = math.hypot(east, north)
        if up <= 0 or across < 1e-6 * up:
            return light_from(height, cell_size, direction)
        # only what lies towards the light can stand in its way
        reach = min(self.fall(height) * across / up, self.area.cell_size * max(self.area.shape)) / across
        wide, rows, cols = self.widened(height, cell_size, (east * reach, north * reach))
        return np.ascontiguousarray(light_from(wide, cell_size, direction)[rows, cols])

    def fall(self, height: NDArray[np.float32]) -> float:
        """From the highest around to the lowest of all [m]; 0 where all around is lower."""
        return max(0.0, max(float(np.nanmax(values)) for values, _ in self.layers) - self._bottom(height))

    def _bottom(self, height: NDArray[np.float32]) -> float:
        return min(float(np.nanmin(values)) for values in (height, *(values for values, _ in self.layers)))

    def widened(
        self, height: NDArray[np.float32], cell_size: float, *reaches: tuple[float, float]
    ) -> tuple[NDArray[np.float32], slice, slice]:
        """The area's heights with those around, and the rows and columns of its own.

        What is unknown is as low as the lowest of all.

        Args:
            height: ``[H, W]`` of the area [m].
            cell_size: edge of a cell [m].
            reaches: (east, north) to where it is looked for [m]; no further than anything is known.
        """
        rows, cols = height.shape
        own = Grid(self.area.crs, self.area.left, self.area.top, cell_size, cols, rows)
        cells = []
        for side, sign in enumerate((-1, -1, 1, 1)):  # west, south, east, north
            wanted = max(0.0, *(sign * reach[side % 2] for reach in reaches)) + _SPARE_CELLS * cell_size
            known = max(sign * (grid.bounds[side] - own.bounds[side]) for _, grid in self.layers)
            cells.append(math.ceil(max(0.0, min(wanted, known)) / cell_size - 1e-6))
        left, down, right, up = cells
        grid = own.part(slice(-up, rows + down), slice(-left, cols + right))
        bottom = self._bottom(height)
        wide = np.full(grid.shape, bottom, np.float32)
        for values, its in self.layers:
            there = reproject_map(values, its, grid)
            wide = np.where(np.isfinite(there), there, wide)
        inside = slice(up, up + rows), slice(left, left + cols)
        wide[inside] = np.where(np.isfinite(height), height, np.float32(bottom))
        return wide, *inside


def read_around(scene: Scene) -> Around | None:
    """The ground around a scene's area as its prior has found it; None where nothing of it is known.

    Raises:
        InputError: a file that cannot be read, or holds no heights.
    """
    if PRODUCT not in scene.products:
        return None
    path = scene.path(scene.products[PRODUCT])
    height, grid = read_raster(written(path))
    if height.shape[0] != 1 or not np.isfinite(height).any():
        raise InputError(f"{path}: found {height.shape[0]} bands, or no data, expected one of heights around the area")
    return Around(((height[0], grid),), scene.require_grid())


__all__ = ["PRODUCT", "Around", "read_around"]

"""A made-up piece of ground: heights, slopes, classes and colours on fine square cells, turned against the grid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sattools.scene.grid import Grid

GROUND, TREES, BUILDING, WATER = 2, 5, 6, 9  # codes of class maps


@dataclass
class World:
    """Height field of small tilted plates; steps between neighbours are vertical walls.

    Within cell (row, column) the surface is the plane z = height + slope_x * dx + slope_y * dy with dx, dy in metres
    from the cell's centre along columns and rows. All rasters are [H, W] or [H, W, 3], row 0 at the northern end.

    Attributes:
        centre: easting and northing of the middle of the raster.
        rotation_deg: by how much columns and rows are turned from east and south, anticlockwise.
        cell_size: metres.
        height, slope_x, slope_y: metres, metres per metre.
        classes: uint8 codes (2 ground, 5 trees, 6 building, 9 water).
        albedo: reflectance of the upper faces, red green blue.
        wall_albedo: reflectance of walls that end at the top of this cell.
        windows: uint8, 1 where those walls have rows of windows.
        streets: where cars may drive; None = nowhere.
        ground: ``[H, W]`` height of the bare ground, under trees and buildings too [m]; None = not known.
    """

    centre: tuple[float, float]
    rotation_deg: float
    cell_size: float
    height: np.ndarray
    slope_x: np.ndarray
    slope_y: np.ndarray
    classes: np.ndarray
    albedo: np.ndarray
    wall_albedo: np.ndarray
    windows: np.ndarray
    streets: np.ndarray | None = None
    ground: np.ndarray | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = self.height.shape
        return rows, columns

    @property
    def top(self) -> np.ndarray:
        """Heights of what is seen from above ``[H, W]`` [m]."""
        return self.height

    @property
    def level_reflectance(self) -> np.ndarray:
        """Reflectance ``[H, W, 3]`` of level ground of what every cell is made of, as seen from above."""
        return self.albedo

    @property
    def turn(self) -> np.ndarray:
        """[2, 2] matrix from (east, north) to (along columns, along rows), both in metres."""
        c, s = math.cos(math.radians(self.rotation_deg)), math.sin(math.radians(self.rotation_deg))
        return np.array([[c, s], [s, -c]])

    def cells(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Continuous (column, row) of ground points; cell (0, 0) spans 0 to 1 in both."""
        rows, columns = self.shape
        turn = self.turn / self.cell_size
        de, dn = east - self.centre[0], north - self.centre[1]
        return turn[0, 0] * de + turn[0, 1] * dn + columns / 2, turn[1, 0] * de + turn[1, 1] * dn + rows / 2

    def surface(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Height of the surface at ground points [m]."""
        x, y = self.cells(east, north)
        column, row = self._index(x, y)
        dx, dy = (x - column - 0.5) * self.cell_size, (y - row - 0.5) * self.cell_size
        plane = self.height[row, column] + self.slope_x[row, column] * dx + self.slope_y[row, column] * dy
        return np.asarray(plane)

    def on_grid(self, raster: np.ndarray, grid: Grid) -> np.ndarray:
        """`raster` [H, W] or [H, W, 3] of this world at the cell centres of `grid`."""
        column, row = self._index(*self.cells(*np.meshgrid(grid.x(), grid.y())))
        return np.asarray(raster[row, column])

    def _index(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = self.shape
        column = np.clip(np.floor(x).astype(int), 0, columns - 1)
        return column, np.clip(np.floor(y).astype(int), 0, rows - 1)

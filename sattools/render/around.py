"""What stands around an area shades parts of it, and hides parts of it from cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sattools.errors import InputError, counted
from sattools.render.shadows import light_from
from sattools.scene import Grid, Scene
from sattools.scene.files import written
from sattools.scene.grid import SURROUNDINGS_M
from sattools.scene.raster import raster_bands, raster_grid, read_raster
from sattools.scene.regrid import reproject_map, window_around
from sattools.scene.stored import cut

PRODUCT = "prior_surroundings"
_SPARE_CELLS = 2  # slopes of the cells at the border
_KEPT_CELLS = 1 << 20  # on other grids: a small area is lit from the same directions many times
_EDGE = 512  # cells of a file that are looked at at a time: most of a large area's hold nothing
Vector = tuple[float, float, float]
Layer = tuple[NDArray[np.float32], Grid]


@dataclass(frozen=True)
class Around:
    """The ground around an area.

    Attributes:
        layers: heights ``[H, W]`` [m], NaN = unknown, and their grids, which may reach over the area, too; a later one
            counts where several are known.
        area: its grid; what is further away than its longest edge neither shades nor hides parts of it.
    """

    layers: tuple[Layer, ...]
    area: Grid
    _kept: dict[tuple[int, Grid], NDArray[np.float32]] = field(default_factory=dict, compare=False, repr=False)

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
        low, _ = self.range(height)
        high = max(float(np.nanmax(values)) for values, _ in self.layers)
        reach = max(0.0, high - low) / up
        wide, rows, cols = self.widened(height, cell_size, (east * reach, north * reach))
        return np.ascontiguousarray(light_from(wide, cell_size, direction)[rows, cols])

    def range(self, height: NDArray[np.float32]) -> tuple[float, float]:
        """Lowest and highest of the area and all around [m]."""
        known = (height, *(values for values, _ in self.layers))
        return min(float(np.nanmin(values)) for values in known), max(float(np.nanmax(values)) for values in known)

    def of(self, area: Grid) -> Around | None:
        """The same of a part of the area, with what is near that; None where nothing is."""
        near = _near(area)
        layers = tuple(layer for layer in self.layers if _meet(layer[1], near))
        return Around(layers, area) if layers else None

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
        longest = self.area.cell_size * max(self.area.shape)
        cells = []
        for side, sign in enumerate((-1, -1, 1, 1)):  # west, south, east, north
            wanted = min(longest, max(0.0, *(sign * reach[side % 2] for reach in reaches))) + _SPARE_CELLS * cell_size
            known = max(sign * (grid.bounds[side] - own.bounds[side]) for _, grid in self.layers)
            cells.append(math.ceil(max(0.0, min(wanted, known)) / cell_size - 1e-6))
        left, down, right, up = cells
        grid = own.part(slice(-up, rows + down), slice(-left, cols + right))
        bottom, _ = self.range(height)
        wide = np.full(grid.shape, bottom, np.float32)
        for number, (_, its) in enumerate(self.layers):
            part = window_around(grid, its)
            if part is not None:
                there = self._on(number, grid.part(*part))
                wide[part] = np.where(np.isfinite(there), there, wide[part])
        inside = slice(up, up + rows), slice(left, left + cols)
        wide[inside] = np.where(np.isfinite(height), height, np.float32(bottom))
        return wide, *inside

    def _on(self, number: int, target: Grid) -> NDArray[np.float32]:
        """Heights ``[H, W]`` of a layer on another grid [m], not to be changed; those of small grids are kept."""
        found = self._kept.get((number, target))
        if found is None:
            found = reproject_map(*self.layers[number], target)
            if found.size + sum(kept.size for kept in list(self._kept.values())) <= _KEPT_CELLS:
                self._kept[number, target] = found
        return found


def _near(area: Grid) -> Grid:
    """An area and what is near enough to shade or hide parts of it, and what is known around small ones."""
    reach = max(SURROUNDINGS_M, area.cell_size * max(area.shape))
    return area.widened(math.ceil(reach / area.cell_size) + _SPARE_CELLS)


def _meet(one: Grid, other: Grid) -> bool:
    (west, south, east, north), (left, bottom, right, top) = one.bounds, other.bounds
    return west < right and left < east and south < top and bottom < north


def read_around(scene: Scene) -> Around | None:
    """The ground around a scene's area as its prior has found it; None where nothing of it is known.

    Of a large area only parts of the file that hold something are kept in memory.

    Raises:
        InputError: a file that cannot be read, or holds no heights.
    """
    if PRODUCT not in scene.products:
        return None
    path = written(scene.path(scene.products[PRODUCT]))
    area, bands, whole = scene.require_grid(), raster_bands(path), raster_grid(path)
    near, everything = _near(area), True
    layers: list[Layer] = []
    for rows, cols in cut(whole.shape, _EDGE):
        # with cells of the next part, for interpolation
        rows = slice(max(0, rows.start - _SPARE_CELLS), min(whole.height, rows.stop + _SPARE_CELLS))
        cols = slice(max(0, cols.start - _SPARE_CELLS), min(whole.width, cols.stop + _SPARE_CELLS))
        part = whole.part(rows, cols)
        if not _meet(part, near):
            everything = False
            continue
        height, _ = read_raster(path, within=part)
        if np.isfinite(height).any():
            layers.append((height[0], part))
    if bands != 1 or (everything and not layers):
        raise InputError(
            f"{path}: found {counted(bands, 'bands')}, or no data, expected one of heights around the area"
        )
    return Around(tuple(layers), area) if layers else None


__all__ = ["PRODUCT", "Around", "read_around"]

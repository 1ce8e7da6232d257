"""A map in blocks, and how much of what lies around a block matters to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sattools.render.around import Around
from sattools.render.shadows import light_from
from sattools.scene import Grid

EDGE = 512  # cells; as much as is held of a small map that is one block
AT_ONCE = 1_500_000  # cells up to which a map is one block
_POOL = 64  # cells of which the highest is kept
_SPARE = 8  # cells around a block: slopes of its border cells, and the end of a ray

Direction = tuple[float, float, float]


@dataclass(frozen=True)
class Block:
    """Some cells of a grid.

    Attributes:
        rows, cols: of the whole.
        grid: the same as a grid.
    """

    rows: slice
    cols: slice
    grid: Grid


def blocks(grid: Grid, at_once: bool = False, edge: int | None = None) -> list[Block]:
    """A grid cut into blocks of so many cells along an edge, row by row; one if it is small or ``at_once``."""
    if at_once or grid.width * grid.height <= AT_ONCE:
        return [Block(slice(0, grid.height), slice(0, grid.width), grid)]
    edge = edge or EDGE
    cut = []
    for row in range(0, grid.height, edge):
        for col in range(0, grid.width, edge):
            rows, cols = slice(row, min(row + edge, grid.height)), slice(col, min(col + edge, grid.width))
            cut.append(Block(rows, cols, grid.part(rows, cols)))
    return cut


class Surroundings:
    """Heights of a map, and what stands in the way of rays that leave it.

    Args:
        grid: of the map.
        read: heights ``[h, w]`` of some rows and columns [m], NaN = unknown.
        around: the ground around the map; None = nothing is known of it.
    """

    def __init__(
        self, grid: Grid, read: Callable[[slice, slice], NDArray[np.float32]], around: Around | None = None
    ) -> None:
        self.grid, self.read, self.beyond = grid, read, around
        shape = (math.ceil(n / _POOL) for n in grid.shape)
        self._top = np.full(tuple(shape), -np.inf, np.float32)
        self.low = np.inf
        for rows, heights in self._strips():
            known = np.where(np.isfinite(heights), heights, np.float32(-np.inf))
            pooled = np.maximum.reduceat(known, np.arange(0, known.shape[1], _POOL), axis=1)
            pooled = np.maximum.reduceat(pooled, np.arange(0, len(pooled), _POOL), axis=0)
            first = rows.start // _POOL
            self._top[first : first + len(pooled)] = pooled
            if np.isfinite(heights).any():
                self.low = min(self.low, float(np.nanmin(heights)))
        self.high = float(self._top.max())
        if around is not None:
            self.high = max(self.high, *(float(np.nanmax(values)) for values, _ in around.layers))

    def _strips(self) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        grid = self.grid
        for row in range(0, grid.height, 4 * _POOL):
            rows = slice(row, min(row + 4 * _POOL, grid.height))
            yield rows, self.read(rows, slice(0, grid.width))

    def level(self, height: NDArray[np.float32]) -> NDArray[np.float32]:
        """Heights [m] with the lowest one of all in the place of unknown ones."""
        return np.where(np.isfinite(height), height, np.float32(self.low if np.isfinite(self.low) else 0.0))

    def lit(self, block: Block, direction: Direction) -> NDArray[np.float32]:
        """Share ``[h, w]`` of the light from a direction (unit vector east, north, up) that reaches a block's cells.

        Unknown heights are the lowest of all.
        """
        rows, cols = self._around(block, direction)
        height, cell = self.level(self.read(rows, cols)), self.grid.cell_size
        beyond = self.beyond.of(self.grid.part(rows, cols)) if self.beyond and self._at_border(rows, cols) else None
        lit = beyond.light_from(height, cell, direction) if beyond else light_from(height, cell, direction)
        up, left = block.rows.start - rows.start, block.cols.start - cols.start
        return np.ascontiguousarray(lit[up : up + block.grid.height, left : left + block.grid.width])

    def _at_border(self, *parts: slice) -> bool:
        """Whether rows or columns reach the border of the map."""
        return any(part.start <= 0 or part.stop >= n for part, n in zip(parts, self.grid.shape, strict=True))

    def _around(self, block: Block, direction: Direction) -> tuple[slice, slice]:
        """The block and as much towards the direction as rays from its lowest cell may pass below something."""
        whole = self.grid
        if block.grid == whole:
            return block.rows, block.cols
        east, north, up = direction
        across = math.hypot(east, north)
        rows, cols = _widened(block, 0.0, 0.0, whole)
        if up <= 0 or across < 1e-6 * up:
            return rows, cols
        height = self.read(block.rows, block.cols)
        low = float(np.nanmin(self.level(height)))
        top = self.high
        for _ in range(6):  # less reach, lower tops within it, less reach
            reach = max(0.0, top - low) * across / up / whole.cell_size
            rows, cols = _widened(block, reach * east / across, -reach * north / across, whole)
            within = tuple(slice(part.start // _POOL, -(-part.stop // _POOL)) for part in (rows, cols))
            highest = float(self._top[within].max())
            if self.beyond is not None and self._at_border(rows, cols):
                highest = self.high
            if highest >= top:
                break
            top = highest
        return rows, cols


def _widened(block: Block, right: float, down: float, whole: Grid) -> tuple[slice, slice]:
    """Rows and columns of a block and so many cells more to the right (or left) and below (or above)."""
    first_row = block.rows.start - _SPARE - math.ceil(max(0.0, -down))
    last_row = block.rows.stop + _SPARE + math.ceil(max(0.0, down))
    first_col = block.cols.start - _SPARE - math.ceil(max(0.0, -right))
    last_col = block.cols.stop + _SPARE + math.ceil(max(0.0, right))
    rows = slice(max(0, first_row), min(whole.height, last_row))
    return rows, slice(max(0, first_col), min(whole.width, last_col))


__all__ = ["EDGE", "Block", "Surroundings", "blocks"]

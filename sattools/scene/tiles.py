"""A grid cut into overlapping tiles, and the weights by which their maps are joined again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from sattools.errors import SceneError
from sattools.scene.grid import AROUND_TILE_M, SURROUNDINGS_M, Grid

LEAST_STEPS = 16  # along a tile's edge
RAMP = (0.25, 0.75)  # of the band that two tiles share: between these its weight moves from one to the other


@dataclass(frozen=True)
class Tile:
    """A rectangle of cells of a grid.

    Attributes:
        name: such as ``r0c1``.
        rows, cols: cells of the whole grid, those shared with the neighbours included.
        grid: the same as a grid.
        shared: cells shared with the neighbours (above, below, left, right); 0 at the border of the whole.
    """

    name: str
    rows: slice
    cols: slice
    grid: Grid
    shared: tuple[int, int, int, int]

    def weights(self, shape: tuple[int, int], cell: float) -> np.ndarray:
        """Weights ``[H, W]`` float32 of a map of that shape and cell [m]; those of all tiles add up to 1 everywhere.

        They fall linearly over the middle half of what two tiles share, so that the cells next to a tile's border,
        which nothing beyond it supports, do not count.
        """
        above, below, left, right = self.shared
        ratio = cell / self.grid.cell_size
        rows = _ramp(shape[0], ratio, self.grid.height, above, below)
        cols = _ramp(shape[1], ratio, self.grid.width, left, right)
        return (rows[:, None] * cols[None, :]).astype(np.float32)

    def place(self, whole: Grid, shape: tuple[int, int]) -> tuple[slice, slice]:
        """Rows and columns that a map of that shape over the tile takes on another grid of the same area."""
        row = round((whole.top - self.grid.top) / whole.cell_size)
        col = round((self.grid.left - whole.left) / whole.cell_size)
        return slice(row, min(row + shape[0], whole.height)), slice(col, min(col + shape[1], whole.width))


def common_cell(cells: Sequence[float]) -> float:
    """The smallest cell that is a whole multiple of all cells [m]."""
    fractions = [Fraction(cell).limit_denominator(10_000) for cell in cells]
    return float(Fraction(math.lcm(*(f.numerator for f in fractions)), math.gcd(*(f.denominator for f in fractions))))


def make_tiles(grid: Grid, tile_m: float | tuple[float, float], overlap_m: float, step_m: float) -> list[Tile]:
    """Tiles that cover a grid, row by row.

    Args:
        grid: what is cut.
        tile_m: longest edge of a tile without its overlap [m], or that from north to south and that from west to east;
            all tiles have it but those at the grid's border, which have at least half of it.
        overlap_m: by which a tile reaches into its neighbours [m]; two share twice as much.
        step_m: multiple of the grid's cell on which all edges lie [m].

    Raises:
        SceneError: an overlap of half a tile or more, or tiles of fewer than `LEAST_STEPS` steps.
    """
    edges = tile_m if isinstance(tile_m, tuple) else (tile_m, tile_m)
    least = min(edges)
    if 2 * overlap_m >= least:
        raise SceneError(f"--overlap: found {overlap_m:g} m, expected less than half of --tile {least:g} m")
    if least < LEAST_STEPS * step_m:
        raise SceneError(
            f"--tile: found {least:g} m, expected at least {LEAST_STEPS * step_m:g} m ({LEAST_STEPS} x {step_m:g} m, "
            "the distance at which edges of all cells, the grid's, the prior's and the fit's, come together)"
        )
    step = round(step_m / grid.cell_size)
    margin = math.ceil(overlap_m / step_m - 1e-9) * step
    height, width = (edge / grid.cell_size for edge in edges)
    return [
        Tile(f"r{r}c{c}", rows, cols, grid.part(rows, cols), (*across, *along))
        for r, (rows, across) in enumerate(_spans(grid.height, height, margin, step))
        for c, (cols, along) in enumerate(_spans(grid.width, width, margin, step))
    ]


def reach_beyond(overlap_m: float) -> float | None:
    """How far beyond its border a tile is matched [m]; None = as any area, whose images may end there.

    What hides and shades parts of a tile stands beyond a narrow overlap.

    Args:
        overlap_m: by which the tile reaches into its neighbours [m].
    """
    reach = AROUND_TILE_M - overlap_m
    return reach if reach > SURROUNDINGS_M else None


def widest_part(edge: float, longest: float, margin: float) -> float:
    """Length of the longest part, with what it shares, of an edge cut as `make_tiles` does it; all in one unit.

    Args:
        edge: what is cut.
        longest: part without what it shares.
        margin: by which a part reaches into its neighbours.
    """
    if edge <= longest:
        return edge
    return longest + 2 * margin if edge > 2 * longest else edge / 2 + margin


def _spans(cells: int, longest: float, margin: int, step: int) -> list[tuple[slice, tuple[int, int]]]:
    """Ranges of cells along one axis with the cells shared with the one before and after.

    All between the first and the last are as long as they may be, and these two share what is left, so that neither is
    shorter than half of that. Parts of equal length would need the same work, but be shorter the fewer they are: the
    memory of a tile would grow with the area.
    """
    full = math.floor(longest / step + 1e-9) * step
    count = 1 if cells <= longest + 1e-9 else math.ceil(cells / full)
    first = round((cells - (count - 2) * full) / (2 * step)) * step
    edges = [0, *(first + k * full for k in range(count - 1)), cells]
    starts = [max(0, edge - margin) for edge in edges[:-1]]
    stops = [min(cells, edge + margin) for edge in edges[1:]]
    return [
        (
            slice(starts[k], stops[k]),
            (stops[k - 1] - starts[k] if k else 0, stops[k] - starts[k + 1] if k + 1 < count else 0),
        )
        for k in range(count)
    ]


def _ramp(count: int, ratio: float, cells: int, before: int, after: int) -> np.ndarray:
    """Weights ``[count]`` of map cells, each ``ratio`` cells of the grid wide, along an axis of ``cells`` of them."""
    at = (np.arange(count) + 0.5) * ratio
    weight = np.ones(count)
    for shared, into in ((before, at), (after, cells - at)):
        if shared:
            weight *= np.clip((into / shared - RAMP[0]) / (RAMP[1] - RAMP[0]), 0.0, 1.0)
    return weight


__all__ = ["LEAST_STEPS", "Tile", "common_cell", "make_tiles", "reach_beyond", "widest_part"]

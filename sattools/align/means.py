"""A surface's means over the large cells of a reference, wherever these lie: what such a reference has measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sattools.align.shift import Shift
from sattools.errors import InputError, counted
from sattools.scene.grid import Grid
from sattools.scene.regrid import resize_map

STEPS = 60  # at most: weights change with every step
CONVERGED = 1e-3  # of a large cell
MOST_CELLS = 16_000_000  # of the surface, which takes 16 bytes each; larger ones are averaged to larger cells first
LEAST_PARTS = 8  # cells of the surface along a large cell that are left then
LEAST_KNOWN = 0.5  # of a large cell
LEAST_ERROR_M, LARGEST_ERROR_M = 0.1, 20.0  # of a cell; unknown ones have the largest
TUNE = 2.0  # times the spread, at which a residual counts half
LEAST_SPREAD = 1e-3  # times the errors
WORSE = 1.1  # times the spread at the start: steps that end there have led away


class CellMeans:
    """Means of maps over square cells anywhere, exact to the parts of cells, by their integrals from one corner.

    Args:
        maps: ``[H, W]`` each, of one grid; NaN = unknown.
        grid: of them.
    """

    def __init__(self, maps: Sequence[np.ndarray], grid: Grid) -> None:
        self.grid = grid
        self.levels, self.integrals = [], []
        for values in maps:
            known = np.isfinite(values)
            # about their mean, so that sums over large areas keep their digits
            level = float(values[known].mean(dtype=np.float64)) if known.any() else 0.0
            self.levels.append(level)
            self.integrals.append([_integral(layer) for layer in (np.where(known, values - level, 0.0), known)])

    def over(self, target: Grid, east: float, north: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """The means over a grid's cells after the maps have moved, and the share of each cell that is known.

        Args:
            target: whose cells the means are over, of the same CRS.
            east: by which the maps move [m].
            north: likewise.

        Returns:
            For each map ``[h, w]`` means, NaN where nothing is known, and ``[h, w]`` shares.
        """
        own = self.grid
        edges_x = target.left + np.arange(target.width + 1) * target.cell_size
        edges_y = target.top - np.arange(target.height + 1) * target.cell_size
        columns = (edges_x - east - own.left) / own.cell_size
        rows = (own.top + north - edges_y) / own.cell_size
        area = (target.cell_size / own.cell_size) ** 2
        found = []
        for level, layers in zip(self.levels, self.integrals, strict=True):
            total, count = (_sums(layer, rows, columns) for layer in layers)
            known = count > 1e-6 * area
            mean = np.where(known, total / np.where(known, count, 1.0) + level, np.nan)
            found.append((mean, np.clip(count / area, 0.0, 1.0)))
        return found


def shift_by_means(
    height: np.ndarray,
    grid: Grid,
    onto: np.ndarray,
    target: Grid,
    start: Shift,
    *,
    tilt: bool,
    error: np.ndarray | None,
) -> Shift:
    """Steps of least squares towards a reference of larger cells, on its own cells.

    What is compared is what both are there: means over the same squares of ground, so that walls and whatever else
    large cells cannot show lead nowhere. Cells count by the surface's own errors, and less the further they are off.

    Args:
        height: ``[H, W]`` of the surface [m]; NaN = unknown.
        grid: of the surface.
        onto: ``[h, w]`` of the reference [m]; NaN = unknown.
        target: its grid, of the same CRS.
        start: shift to begin with, within a cell or two.
        tilt: a tilt as well.
        error: ``[H, W]`` how far the surface's cells may be off [m]; None = all alike.

    Returns:
        The shift; `before`, `after` and `count` are those of ``start``.

    Raises:
        InputError: too few cells, or the steps led away.
    """
    height, doubt, grid = _fine_enough(height, np.ones_like(height) if error is None else error, grid, target)
    doubt = np.where(np.isfinite(height) & np.isfinite(doubt), doubt, LARGEST_ERROR_M)
    means = CellMeans([height, np.clip(doubt, LEAST_ERROR_M, LARGEST_ERROR_M)], grid)
    reach = max(target.width, target.height) * target.cell_size / 2  # makes the unknowns alike
    shift, first, spread, even = start, np.inf, np.inf, True
    for step in range(STEPS):
        left, design, doubts = _equations(means, onto, target, shift, reach)
        design = design[:, : 5 if tilt else 3]
        if len(left) < 2 * design.shape[1]:
            raise InputError(
                f"reference: found {counted(len(left), 'cells')} in common, expected {2 * design.shape[1]} or more"
            )
        units = left / doubts
        spread = max(1.4826 * float(np.median(np.abs(units - np.median(units)))), LEAST_SPREAD)
        first = spread if step == 0 else first
        # all alike at first: where most cells are flat, walls that are out of place are what does not fit
        root = 1 / doubts if even else 1 / (doubts * np.sqrt(1 + (units / (TUNE * spread)) ** 2))
        solved = np.linalg.lstsq(root[:, None] * design, root * left, rcond=None)[0].tolist()
        east, north, up, along_x, along_y = solved if tilt else [*solved, 0.0, 0.0]
        shift = replace(
            shift, east=shift.east + east, north=shift.north + north, up=shift.up + up,
            tilt_east=shift.tilt_east + along_x / reach, tilt_north=shift.tilt_north + along_y / reach,
        )  # fmt: skip
        if max(np.hypot(east, north), np.hypot(along_x, along_y)) < CONVERGED * target.cell_size:
            if not even:
                break
            even = False
        even = even and step < STEPS // 3
    if not spread <= WORSE * first:
        raise InputError(
            f"reference: found that steps lead away from it (spread {spread:.2f} times the surface's errors, at first "
            f"{first:.2f}), expected a reference of the same ground"
        )
    return shift


def _equations(
    means: CellMeans, onto: np.ndarray, target: Grid, shift: Shift, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What is left ``[N]`` [m] in the cells both know, what changes it ``[N, 5]``, and the surface's errors ``[N]``.

    The changes are those by a metre east, north and up, and by a tilt of a metre over ``reach`` east and north.
    """

    def surface(east: float, north: float) -> tuple[np.ndarray, np.ndarray]:
        (mean, share), (doubts, _) = means.over(target, shift.east + east, shift.north + north)
        return np.where(share >= LEAST_KNOWN, mean, np.nan), doubts

    half = max(means.grid.cell_size, target.cell_size / 20)
    slope_x, slope_y = (
        (surface(half * a, half * b)[0] - surface(-half * a, -half * b)[0]) / (2 * half) for a, b in ((1, 0), (0, 1))
    )
    here, doubts = surface(0.0, 0.0)
    x, y = np.meshgrid(target.x() - shift.east - shift.x, target.y() - shift.north - shift.y)
    left = onto - here - shift.up - shift.tilt_east * x - shift.tilt_north * y
    known = np.isfinite(left) & np.isfinite(slope_x) & np.isfinite(slope_y)
    columns = [slope_x[known], slope_y[known], np.ones(int(known.sum())), x[known] / reach, y[known] / reach]
    return left[known], np.stack(columns, axis=1), doubts[known]


def _fine_enough(
    height: np.ndarray, error: np.ndarray, grid: Grid, target: Grid
) -> tuple[np.ndarray, np.ndarray, Grid]:
    """A surface and its errors on cells that fit into memory, still much smaller than those of the reference."""
    while height.size > MOST_CELLS and 2 * LEAST_PARTS * grid.cell_size <= target.cell_size:
        large = grid.resized(2 * grid.cell_size)
        height, error, grid = resize_map(height, grid, large), resize_map(error, grid, large), large
    return height, error, grid


def _integral(values: np.ndarray) -> np.ndarray:
    """Sums ``[H + 1, W + 1]`` of all that lies above and to the left of the cells' corners."""
    return np.pad(np.cumsum(np.cumsum(values, axis=0, dtype=np.float64), axis=1), ((1, 0), (1, 0)))


def _sums(integral: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Sums ``[h, w]`` between the edges ``[h + 1]`` and ``[w + 1]`` of cells, in cells of the integral."""
    along = integral
    for axis, edges in enumerate((rows, columns)):
        edges = np.clip(edges, 0, integral.shape[axis] - 1)
        before = np.minimum(edges.astype(int), integral.shape[axis] - 2)
        part = (edges - before).reshape(-1, 1) if axis == 0 else edges - before
        low, high = np.take(along, before, axis), np.take(along, before + 1, axis)
        along = np.diff(low + part * (high - low), axis=axis)
    return along


__all__ = ["LEAST_KNOWN", "LEAST_PARTS", "CellMeans", "shift_by_means"]

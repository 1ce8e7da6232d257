"""Shifts that are larger than what registration looks at: where on a wide reference a surface may lie."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from sattools.align.estimate import RELIEF_M, UNLIKE, Method, shift_to_dem
from sattools.align.shift import Shift
from sattools.compare.metrics import nmad
from sattools.compare.registration import search_margin
from sattools.errors import InputError
from sattools.progress import Progress, silent, subprogress
from sattools.scene.grid import Grid
from sattools.scene.regrid import reproject_map

CELLS_ACROSS = 64  # of the surface's smaller side, in which it is looked for
MOST_SIDES = 8  # of the surface, beyond which nothing is looked for: that would take gigabytes
LEAST_COMMON = 0.25  # of the surface: less of it may resemble anything
ALIKE = 0.5  # at most left of the relief: a fifth on the same ground, and there are thousands of other places


def shift_within(
    height: np.ndarray,
    grid: Grid,
    reference: np.ndarray,
    reference_grid: Grid,
    method: Method = "auto",
    *,
    tilt: bool = False,
    error: np.ndarray | None = None,
    reach: float = 0.0,
    progress: Progress = silent,
) -> Shift:
    """`shift_to_dem`, which looks a few cells of a small map around; where it finds nothing, as far as ``reach``.

    Args:
        height: ``[H, W]`` [m]; NaN = unknown.
        grid: of the surface.
        reference: ``[h, w]`` [m]; NaN = unknown.
        reference_grid: of the reference.
        method: as of `shift_to_dem`.
        tilt: likewise.
        error: ``[H, W]`` likewise.
        reach: largest shift that is looked for [m].
        progress: told the share done and what is being done.

    Raises:
        InputError: as `shift_to_dem`, where looking further does not help.
    """
    found, wrong = None, None
    try:
        near = subprogress(progress, 0.0, 0.5)
        found = shift_to_dem(height, grid, reference, reference_grid, method, tilt=tilt, error=error, progress=near)
        if method == "z" or found.left <= UNLIKE:
            return found
    except InputError as reason:
        wrong = reason
    known = height[np.isfinite(height)]
    if method != "z" and known.size and np.abs(known - np.median(known)).mean() >= RELIEF_M:
        progress(0.5, f"looking further off, to {reach:g} m")
        there = _place(height, grid, reference, reference_grid, reach)
        if there is not None:
            last = subprogress(progress, 0.6, 1.0)
            onto = (reference, reference_grid)
            far = _from(there, height, grid, onto, method, tilt=tilt, error=error, progress=last)
            if far is not None and far.left <= ALIKE:
                return far
            if found is None:
                raise InputError(f"{wrong}; nor is anything like it further off, to {reach:g} m (--max-shift)")
    if found is not None:
        return found
    assert wrong is not None
    raise wrong


def _from(
    there: tuple[float, float],
    height: np.ndarray,
    grid: Grid,
    onto: tuple[np.ndarray, Grid],
    method: Method,
    *,
    tilt: bool,
    error: np.ndarray | None,
    progress: Progress,
) -> Shift | None:
    """The shift of a surface that is begun with elsewhere, (east, north) [m]; None where it does not fit there."""
    try:
        found = shift_to_dem(height, grid.moved(*there), *onto, method, tilt=tilt, error=error, progress=progress)
    except InputError:
        return None
    apart = reproject_map(*onto, grid) - height
    apart = apart[np.isfinite(apart)]
    return replace(
        found, east=found.east + there[0], north=found.north + there[1], x=found.x - there[0], y=found.y - there[1],
        before=nmad(apart) if apart.size else found.after,
    )  # fmt: skip


def _place(
    height: np.ndarray, grid: Grid, reference: np.ndarray, reference_grid: Grid, reach: float
) -> tuple[float, float] | None:
    """Where around it a surface correlates best with a reference, (east, north) to a cell or two of `CELLS_ACROSS` [m].

    None where ``reach`` is no further than what registration has looked at, or the two are in different CRS.
    """
    side = min(grid.shape) * grid.cell_size
    cell = max(side / CELLS_ACROSS, grid.cell_size, reference_grid.cell_size)
    most = int(min(reach, MOST_SIDES * side) / cell)
    looked_at = search_margin(grid.shape) * grid.cell_size
    if reference_grid.crs != grid.crs or most * cell <= looked_at:
        return None
    small = grid.resized(cell)
    here = reproject_map(height, grid, small, means=True)
    around = reproject_map(reference, reference_grid, small.widened(most), means=True)
    correlation = _correlations(around, here)
    rows, columns = np.mgrid[-most : most + 1, -most : most + 1]
    correlation[np.hypot(rows, columns) * cell > reach] = -1.0
    best = np.unravel_index(int(correlation.argmax()), correlation.shape)
    row, column = int(best[0]) - most, int(best[1]) - most
    return column * cell, -row * cell


def _correlations(around: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Correlation of a map ``[h, w]`` with all places of its size in a wider one ``[H, W]``; NaN = unknown.

    Padfield (2012), doi:10.1109/TIP.2011.2181402: unknown cells of either do not count.

    Returns:
        ``[H - h + 1, W - w + 1]``, -1 where less than a quarter of the map is known in both.
    """
    known_there, known_here = np.isfinite(around), np.isfinite(part)
    there = np.where(known_there, around - np.nanmean(around) if known_there.any() else 0.0, 0.0).astype(np.float64)
    here = np.where(known_here, part - np.nanmean(part) if known_here.any() else 0.0, 0.0).astype(np.float64)

    # places where the part would go round the edge are cut off, so that the period may be as short as the wide map
    rows, cols = (a - b + 1 for a, b in zip(around.shape, part.shape, strict=True))
    period = [next_fast_len(size, real=True) for size in around.shape]

    def sums(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        a, b = (rfft2(values.astype(np.float64), period) for values in (a, b))
        return np.asarray(irfft2(a * b.conj(), period)[:rows, :cols])

    count = np.maximum(sums(known_there, known_here), 1.0)
    mean_there, mean_here = sums(there, known_here) / count, sums(known_there, here) / count
    both = sums(there, here) / count - mean_there * mean_here
    spread_there = sums(there**2, known_here) / count - mean_there**2
    spread_here = sums(known_there, here**2) / count - mean_here**2
    least = 1e-6 * max(float((there**2).mean()), math.ulp(1.0))  # of rounding, where one is level
    usable = (count >= LEAST_COMMON * known_here.sum()) & (spread_there > least) & (spread_here > least)
    product = np.where(usable, spread_there * spread_here, 1.0)
    return np.where(usable, both / np.sqrt(product), -1.0)


__all__ = ["LEAST_COMMON", "shift_within"]

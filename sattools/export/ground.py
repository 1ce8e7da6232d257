"""Bare ground under trees and buildings, from a surface model: pure functions of arrays.

What stands on the ground is narrower than some width and steeper around than the ground is. So the surface is opened
(eroded, then dilated) with wider and wider squares, and what an opening takes away by more than the ground's own slope
explains stands on it: the progressive morphological filter of Zhang et al. (2003, IEEE TGRS 41, 872) in the simple
form of Pingel et al. (2013, ISPRS J. 77, 21), with the slope taken from the surface around every cell instead of given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAST_M = 0.6  # what is lower is no object: noise of matching, kerbs
GROWTH = 1.4  # from one half width to the next
SLOPE_FACTOR = 2.2  # a ridge is this much steeper than most of the ground around it may be
SLOPE_SHARE = 0.35  # of the slopes around that are smaller than the one that is taken for the ground's
SLOPE_CELL_M, SLOPE_REACH_M = 2.0, 30.0  # over which slopes are measured, and looked at
LEAST_SLOPE = 0.02
PIT_SHARE = 0.04  # of the cells of a square that may be too low
SQUARE_CELLS = 4  # least half width of a square that is looked at on coarser cells [of these]
ALIGNED = 64  # cells: parts that begin on multiples of it are treated as the whole is
SMEARED_M = 1.0  # beside objects matching is neither on them nor on the ground
PITS_M = ((1.0, 6.0), (2.0, 12.0))  # depth from which a hole is an error that is narrower than the second
ROUNDS = 2  # in the second one, what leans on something wide that has been taken away is seen to stand by itself

Map = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class BareGround:
    """The ground under a surface.

    Attributes:
        height: ``[H, W]`` [m]; NaN where nothing is known at all.
        seen: ``[H, W]`` bool, the surface is the ground there; elsewhere it is interpolated.
    """

    height: Map
    seen: Mask


def bare_ground(surface: Map, trusted: Mask, cell: float, widest: float) -> BareGround:
    """The ground under what stands on it.

    Args:
        surface: ``[H, W]`` heights [m], NaN = unknown.
        trusted: ``[H, W]`` bool, heights that are worth taking for the ground's.
        cell: edge of a cell [m].
        widest: width of the widest building [m], across where it is narrowest.
    """
    known = np.isfinite(surface)
    trusted = trusted & known
    if not trusted.any():
        trusted = known
    if not known.any():
        return BareGround(surface.copy(), known)
    slope = typical_slope(surface, cell)
    ground, level = trusted, np.where(known, surface, np.float32(np.nan))
    for _ in range(ROUNDS):
        objects = standing(level, slope, cell, widest) | ~trusted
        remaining = ground & ~_widened(objects & ground, round(SMEARED_M / cell))
        ground = _or_else(remaining, ground)
        ground = _or_else(ground & ~pits(interpolated(surface, ground), slope, cell), ground)
        level = interpolated(surface, ground)
    return BareGround(level, ground)


def _or_else(mask: Mask, other: Mask) -> Mask:
    """The mask, or another one where nothing is left of it."""
    return mask if mask.any() else other


def typical_slope(surface: Map, cell: float) -> Map:
    """Slope ``[H, W]`` [m/m] that the ground has around a cell: of most of what is there, walls and eaves are not."""
    from scipy.ndimage import percentile_filter

    pool = 2 ** max(0, round(math.log2(SLOPE_CELL_M / cell)))
    coarse = _pooled(surface, pool)
    down, right = np.gradient(coarse, pool * cell) if min(coarse.shape) > 1 else (np.zeros_like(coarse),) * 2
    steep = _pooled(np.hypot(down, right), 2, 100 * SLOPE_SHARE)
    reach = 2 * max(1, round(SLOPE_REACH_M / (2 * pool * cell))) + 1
    found = percentile_filter(np.nan_to_num(steep), 100 * SLOPE_SHARE, min(reach, 15), mode="nearest")
    fine = found.repeat(2 * pool, axis=0).repeat(2 * pool, axis=1)[: surface.shape[0], : surface.shape[1]]
    return np.maximum(fine, LEAST_SLOPE).astype(np.float32)


def standing(surface: Map, slope: Map, cell: float, widest: float) -> Mask:
    """What stands on the ground ``[H, W]`` bool.

    Args:
        surface: ``[H, W]`` heights [m], NaN = unknown.
        slope: of the ground [m/m].
        cell: edge of a cell [m].
        widest: see `bare_ground`.
    """
    objects = np.zeros(surface.shape, bool)
    half = 1
    while True:
        low = opened(surface, half)
        objects |= np.isfinite(low) & (surface - low > LEAST_M + SLOPE_FACTOR * slope * (half * cell))
        if 2 * half * cell >= widest:
            return objects
        half = min(max(half + 1, round(half * GROWTH)), math.ceil(widest / 2 / cell))


def opened(surface: Map, half: int) -> Map:
    """Heights ``[H, W]`` [m] opened with a square: the highest of the lowest that squares over a cell have.

    "Lowest" leaves out `PIT_SHARE` of a square's cells, which matching may have put too low. Squares of many cells are
    looked at on coarser ones, each the median of what is known in it.

    Args:
        surface: heights [m], NaN = unknown; a cell without any known one around it has -inf.
        half: half width of the square [cells].
    """
    from scipy.ndimage import maximum_filter, percentile_filter

    # powers of two, so that a part of a map has the coarse cells of the whole
    pool = 2 ** max(0, int(math.log2(half / SQUARE_CELLS))) if half > SQUARE_CELLS else 1
    coarse = _pooled(surface, pool)
    size = 2 * max(1, round(half / pool)) + 1
    # unknown cells count as high ones: a percentile of those that remain would need a sort of each square
    high = np.where(np.isfinite(coarse), coarse, np.inf)
    least = percentile_filter(high, 100 * PIT_SHARE, size, mode="constant", cval=np.inf)
    least = np.where(np.isfinite(least), least, -np.inf)
    low = maximum_filter(least, size, mode="constant", cval=-np.inf)
    return low.repeat(pool, axis=0).repeat(pool, axis=1)[: surface.shape[0], : surface.shape[1]]


def pits(ground: Map, slope: Map, cell: float) -> Mask:
    """Holes in the ground ``[H, W]`` bool that are too narrow for their depth: errors of matching.

    Args:
        ground: ``[H, W]`` heights [m].
        slope: of the ground [m/m].
        cell: edge of a cell [m].
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    found = np.zeros(ground.shape, bool)
    for depth, width in PITS_M:
        size = 2 * max(1, round(width / 2 / cell)) + 1
        closed = minimum_filter(maximum_filter(ground, size, mode="nearest"), size, mode="nearest")
        found |= closed - ground > depth + SLOPE_FACTOR * slope * width / 2
    return found


def interpolated(values: Map, known: Mask, sweeps: int = 12) -> Map:
    """Values ``[H, W]`` with the smooth membrane through the known ones in the place of all others.

    Means of two by two known cells, the same of these, and so on; on the way back each level begins with the coarser
    one, and every unknown cell becomes the mean of its neighbours some times (cascadic multigrid).

    Args:
        values: of any unit.
        known: ``[H, W]`` bool, at least one.
        sweeps: see above, on every level.
    """
    if known.all() or min(values.shape) < 2:
        level = values[known].mean() if known.any() else np.nan
        return np.where(known, values, level).astype(np.float32)
    rows, cols = values.shape
    even = ((0, rows % 2), (0, cols % 2))
    count = _paired(np.pad(known.astype(np.float32), even))
    total = _paired(np.pad(np.where(known, values, 0).astype(np.float32), even))
    coarse = interpolated((total / np.maximum(count, 1)).astype(np.float32), count > 0, sweeps)
    found = _doubled(coarse)[:rows, :cols]
    found = np.where(known, values, found).astype(np.float32)
    for _ in range(sweeps):
        around = np.pad(found, 1, mode="edge")
        mean = (around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]) / 4
        np.copyto(found, mean, where=~known)
    return found


def _paired(array: Map) -> Map:
    return array[::2, ::2] + array[1::2, ::2] + array[::2, 1::2] + array[1::2, 1::2]


def _doubled(coarse: Map) -> Map:
    """Twice the cells, bilinear between the centres of the coarse ones."""
    for axis in range(2):
        last = coarse.shape[axis] - 1
        before = np.take(coarse, np.maximum(np.arange(last + 1) - 1, 0), axis=axis)
        after = np.take(coarse, np.minimum(np.arange(last + 1) + 1, last), axis=axis)
        pair = np.stack([0.75 * coarse + 0.25 * before, 0.75 * coarse + 0.25 * after], axis=axis + 1)
        shape = list(coarse.shape)
        shape[axis] *= 2
        coarse = pair.reshape(shape)
    return coarse


def _pooled(values: Map, size: int, percentile: float = 50.0) -> Map:
    """A percentile of what is known in square blocks of cells, NaN where nothing is; blocks at the end are narrower."""
    if size == 1:
        return values
    rows, cols = (-n % size for n in values.shape)
    whole = np.pad(values, ((0, rows), (0, cols)), constant_values=np.nan)
    height, width = (n // size for n in whole.shape)
    parts = np.sort(whole.reshape(height, size, width, size).transpose(0, 2, 1, 3).reshape(height, width, -1), axis=-1)
    count = np.isfinite(parts).sum(axis=-1)  # NaN are sorted to the end
    order = np.minimum((percentile / 100 * count).astype(np.intp), np.maximum(count - 1, 0))
    return np.asarray(np.take_along_axis(parts, order[..., None], axis=-1)[..., 0])


def _widened(mask: Mask, cells: int) -> Mask:
    from scipy.ndimage import maximum_filter

    return np.asarray(maximum_filter(mask, 2 * cells + 1)) if cells else mask


__all__ = ["ALIGNED", "BareGround", "bare_ground", "interpolated", "standing", "typical_slope"]

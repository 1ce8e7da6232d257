"""Walls where the images' brightness changes: what matching puts on the wrong side of an edge changes sides."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import maximum_filter, median_filter, minimum_filter

from sattools.compiled import njit, prange
from sattools.prior.frame import Frame

NEAR = 3  # cells from a height step within which a cell may change sides: the matching window and its blur
REACH = 5  # cells around it that tell how high either side is
FALL = 3.0  # cells over which their weight falls
LOOK = 10  # cells around it that tell what either side looks like, of which every second is asked
LOOK_FALL = 5.0
STEP_M = 2.0  # smallest height step that is a wall
FLAT_M = 1.5  # height range of 3 x 3 cells that are surely off the step
SAME_M = 1.0  # heights this near belong to the same side
CAP = 9.0  # squared standard deviations at which a stray pixel stops counting
BIAS = 1.0  # by how much the other side has to be more likely (log-likelihood ratio, mean over the views)
FEWEST_VIEWS = 2
MOST = 0.75  # share of the views that can tell which have to agree


def snap_edges(
    frame: Frame, first_hit_height: np.ndarray, height: np.ndarray, tolerance: float, noise: float
) -> np.ndarray:
    """Move height steps to where the images change.

    A window on the rim of a roof sees the roof's edge, which agrees in all views, and so matching makes everything
    high one window too wide, most of all where a dark strip of shaded ground follows. But the strip does not look like
    the roof: near a step every cell is assigned to the side, high or low, whose cells at that height it resembles
    more (a Gaussian likelihood per view, from the cells surely on that side). Only views that can judge both sides
    count, and three in four of them have to agree: one date's facade, glare or shadow moves no wall.

    Args:
        frame: the views.
        first_hit_height: ``[V, Hf, Wf]`` heights at which rays first meet the surface [m].
        height: ``[H, W]`` float32 [m].
        tolerance: depth below the visible surface that still counts as seen [m].
        noise: standard deviation of brightness on one material.

    Returns:
        ``[H, W]`` float32 heights [m].
    """
    off_step = maximum_filter(height, 3, mode="nearest") - minimum_filter(height, 3, mode="nearest") < FLAT_M
    off_step = minimum_filter(off_step, 3, mode="nearest")
    moved = np.empty_like(height)
    choose_sides(
        height,
        off_step,
        frame.images,
        frame.masks,
        frame.slopes,
        frame.z_ref,
        frame.margin,
        first_hit_height,
        tolerance,
        noise,
        moved,
    )
    return median_filter(moved, 3, mode="nearest")


@njit(cache=True)
def _level(height, off_step, row, col, low, high):
    """Weighted mean of the sure heights in [low, high) around a cell, NaN if there are too few."""
    rows, cols = height.shape
    total = 0.0
    weight = 0.0
    for i in range(max(0, row - REACH), min(rows, row + REACH + 1)):
        for j in range(max(0, col - REACH), min(cols, col + REACH + 1)):
            z = height[i, j]
            if off_step[i, j] and low <= z < high:
                w = math.exp(-((i - row) ** 2 + (j - col) ** 2) / (2 * FALL * FALL))
                total += w * z
                weight += w
    return total / weight if weight > FEWEST_VIEWS - 0.5 else np.nan


@njit(cache=True)
def _misfit(height, off_step, image, mask, hit, row, col, z, at_row, at_col, limit, noise):
    """Minus twice the log-likelihood (up to a constant) that a pixel belongs to its neighbours at height z in a view.

    at_row, at_col: frame position of the cell at that height; limit: highest first hit at which a point is seen.
    Negative where the view cannot tell.
    """
    rows, cols = height.shape
    a, b = round(at_row), round(at_col)
    if hit[a, b] > limit or mask[a, b] == 0:
        return -1.0
    total = 0.0
    squares = 0.0
    weight = 0.0
    for i in range(row - LOOK, row + LOOK + 1, 2):
        for j in range(col - LOOK, col + LOOK + 1, 2):
            if not (0 <= i < rows and 0 <= j < cols) or not off_step[i, j] or abs(height[i, j] - z) > SAME_M:
                continue
            r, c = round(at_row + i - row), round(at_col + j - col)
            if hit[r, c] > limit:
                continue
            w = math.exp(-((i - row) ** 2 + (j - col) ** 2) / (2 * LOOK_FALL * LOOK_FALL))
            x = image[r, c]
            total += w * x
            squares += w * x * x
            weight += w
    if weight < 1:
        return -1.0
    mean = total / weight
    variance = max(squares / weight - mean * mean, 0.0) + noise * noise
    apart = image[a, b] - mean
    return min(apart * apart / variance, CAP) + math.log(variance / (noise * noise))


@njit(parallel=True, cache=True)
def choose_sides(height, off_step, images, masks, slopes, z_ref, margin, first_hit_height, tolerance, noise, moved):
    """See `snap_edges`; ``off_step`` is ``[H, W]`` bool, ``moved`` ``[H, W]`` float32 is filled."""
    rows, cols = height.shape
    views = images.shape[0]
    for row in prange(rows):
        for col in range(cols):
            here = height[row, col]
            moved[row, col] = here
            low, high = here, here
            for i in range(max(0, row - NEAR), min(rows, row + NEAR + 1)):
                for j in range(max(0, col - NEAR), min(cols, col + NEAR + 1)):
                    low, high = min(low, height[i, j]), max(high, height[i, j])
            if high - low < STEP_M:
                continue
            middle = 0.5 * (low + high)
            below = _level(height, off_step, row, col, -np.inf, middle)
            above = _level(height, off_step, row, col, middle, np.inf)
            if not above - below >= STEP_M:
                continue
            # views that can judge both sides: others would compare different images
            gain = 0.0
            count = votes = 0
            low_dz, high_dz = below - z_ref, above - z_ref
            for v in range(views):
                r, c = row + margin + slopes[v, 0] * low_dz, col + margin + slopes[v, 1] * low_dz
                misfit_low = _misfit(
                    height,
                    off_step,
                    images[v],
                    masks[v],
                    first_hit_height[v],
                    row,
                    col,
                    below,
                    r,
                    c,
                    below + tolerance,
                    noise,
                )
                if misfit_low < 0:
                    continue
                r, c = row + margin + slopes[v, 0] * high_dz, col + margin + slopes[v, 1] * high_dz
                misfit_high = _misfit(
                    height,
                    off_step,
                    images[v],
                    masks[v],
                    first_hit_height[v],
                    row,
                    col,
                    above,
                    r,
                    c,
                    above + tolerance,
                    noise,
                )
                if misfit_high >= 0:
                    gain += misfit_high - misfit_low
                    votes += 1 if misfit_high > misfit_low else 0
                    count += 1
            if count < FEWEST_VIEWS:
                continue
            gain /= count
            if here >= middle and gain > BIAS and votes >= MOST * count:
                moved[row, col] = below
            elif here < middle and -gain > BIAS and count - votes >= MOST * count:
                moved[row, col] = above


__all__ = ["choose_sides", "snap_edges"]

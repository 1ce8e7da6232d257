"""Walls where the images' brightness changes: what matching puts on the wrong side of an edge changes sides."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, median_filter, minimum_filter

from sattools.compiled import njit, prange
from sattools.prior.frame import Frame

NEAR = 3  # cells from a height step within which a cell may change sides: the matching window and its blur
REACH = 5  # cells around it that tell how high either side is
FALL = 3.0  # cells over which their weight falls
LOOK = 9  # cells around it that tell what either side looks like, of which every second is asked
HIGH_FALL = 4.0
LOW_FALL = 3.0  # what lies beyond an edge changes sooner than what lies on a roof
STEP_M = 2.0  # smallest height step that is a wall
FLAT_M = 1.5  # height range of 3 x 3 cells that are surely off the step
SAME_M = 1.0  # heights this near belong to the same side
FEWEST_CELLS = 1.5  # weight of the cells that make a level
FEWEST_LOOKS = 0.3  # weight of the cells that make an appearance
FEWEST_VIEWS = 2
CAP = 2.0  # log-likelihood ratio at which a view is sure: one date's facade, glare or shadow moves no wall
CONTRAST = 0.5  # standard deviations by which the sides have to differ in a view that can tell them apart
LOWER = -0.2  # certainty (-1 ... 1) that a cell is not on the high side, for it to be lowered
GROUND = -0.05  # and that views from outside see the ground there
RAISE = 0.3  # certainty that a cell is on the high side, for it to be raised
SLOPE_SCALE = 2.0  # cells over which the direction of a wall is averaged
OUTSIDE = 0.2  # cosine between the way down a wall and that towards a view which sees the foot of the wall
STEEP = 0.05  # tangent of the angle from the vertical below which a view sees the foot of every wall


def sharpen(frame: Frame, hits: np.ndarray, height: np.ndarray, tolerance: float, noise: float) -> np.ndarray:
    """Move height steps to where the images change.

    A window on the rim of a roof sees the roof's edge, which agrees in all views, and so matching makes everything
    high one window too wide, most of all where a dark strip of shaded ground follows. But the strip does not look like
    the roof: shifted to the roof's height, every view shows the roof on one side of the edge and something else on
    the other, be it facade, shadow or ground far behind. So near a step a cell is asked twice, at the height of
    either side, whether it looks like the cells surely on the high side or like those surely on the low side as this
    view shows them *at that height*. At the upper height all views can tell, whatever hides the ground. At the lower
    height only views from outside the wall can. A cell is lowered if it does not look like the roof and does look
    like the ground: where it looks like neither (slanted or overhanging walls, blurred rims) matching is left alone.

    Args:
        frame: the views.
        hits: ``[V, Hf, Wf]`` heights at which rays first meet the surface [m].
        height: ``[H, W]`` float32 [m].
        tolerance: depth below the visible surface that still counts as seen [m].
        noise: standard deviation of brightness on one material.

    Returns:
        ``[H, W]`` float32 heights [m].
    """
    sure = maximum_filter(height, 3, mode="nearest") - minimum_filter(height, 3, mode="nearest") < FLAT_M
    sure = minimum_filter(sure, 3, mode="nearest")
    uphill = np.stack([gaussian_filter(height, SLOPE_SCALE, order=order, mode="nearest") for order in ((1, 0), (0, 1))])
    uphill /= np.maximum(np.hypot(*uphill), 1e-6)
    tangent = np.hypot(*frame.slopes.T) * frame.cell
    # on its way up to the view a ray moves against the slope; views from straight above are outside of every wall
    outward = frame.slopes * frame.cell / np.maximum(tangent, STEEP)[:, None]
    outward[tangent < STEEP] = np.nan
    moved = np.empty_like(height)
    choose_sides(
        height, sure, uphill, frame.images, frame.masks, frame.slopes, outward, frame.z_ref, frame.margin, hits,
        tolerance, noise, moved,
    )  # fmt: skip
    return median_filter(moved, 3, mode="nearest")


@njit(cache=True)
def _level(height, sure, row, col, low, high):
    """Weighted mean of the sure heights in [low, high) around a cell, NaN if there are too few."""
    rows, cols = height.shape
    total = 0.0
    weight = 0.0
    for i in range(max(0, row - REACH), min(rows, row + REACH + 1)):
        for j in range(max(0, col - REACH), min(cols, col + REACH + 1)):
            z = height[i, j]
            if sure[i, j] and low <= z < high:
                w = math.exp(-((i - row) ** 2 + (j - col) ** 2) / (2 * FALL * FALL))
                total += w * z
                weight += w
    return total / weight if weight > FEWEST_CELLS else np.nan


@njit(cache=True)
def _gather(height, sure, row, col, below, above, where, side, weight):
    """Note the sure cells of either side around a cell: offsets, side (1 = high), weight; returns their number."""
    rows, cols = height.shape
    count = 0
    for i in range(-LOOK, LOOK + 1):
        for j in range(-LOOK + (i + LOOK) % 2, LOOK + 1, 2):
            r, c = row + i, col + j
            if not (0 <= r < rows and 0 <= c < cols) or not sure[r, c]:
                continue
            high = abs(height[r, c] - above) <= SAME_M
            if not high and abs(height[r, c] - below) > SAME_M:
                continue
            fall = HIGH_FALL if high else LOW_FALL
            where[count, 0], where[count, 1] = i, j
            side[count] = 1 if high else 0
            weight[count] = math.exp(-(i * i + j * j) / (2 * fall * fall))
            count += 1
    return count


@njit(cache=True)
def _likeness(image, mask, hit, limit, r, c, where, side, weight, count, noise):
    """How surely a pixel belongs to the high side in one view, -1 ... 1; NaN where the view cannot tell.

    r, c: frame position of the cell at the height in question; limit: highest first hit at which it is seen.
    The two sides get one spread, so that a pixel that mixes them belongs to the one that has more of it.
    """
    a, b = round(r), round(c)
    if hit[a, b] > limit or mask[a, b] == 0:
        return np.nan
    low = low_squares = low_weight = 0.0
    high = high_squares = high_weight = 0.0
    for n in range(count):
        x = image[a + where[n, 0], b + where[n, 1]]
        w = weight[n]
        if side[n]:
            high += w * x
            high_squares += w * x * x
            high_weight += w
        else:
            low += w * x
            low_squares += w * x * x
            low_weight += w
    if low_weight < FEWEST_LOOKS or high_weight < FEWEST_LOOKS:
        return np.nan
    low /= low_weight
    high /= high_weight
    spread = max(low_squares / low_weight - low * low, 0.0) + max(high_squares / high_weight - high * high, 0.0)
    variance = noise * noise + 0.5 * spread
    if (high - low) ** 2 < CONTRAST * CONTRAST * variance:
        return np.nan
    iy, ix = math.floor(r), math.floor(c)
    fy, fx = r - iy, c - ix
    upper = image[iy, ix] + fx * (image[iy, ix + 1] - image[iy, ix])
    lower = image[iy + 1, ix] + fx * (image[iy + 1, ix + 1] - image[iy + 1, ix])
    ratio = (high - low) * (upper + fy * (lower - upper) - 0.5 * (high + low)) / variance
    return min(max(ratio / CAP, -1.0), 1.0)


@njit(parallel=True, cache=True)
def choose_sides(
    height, sure, uphill, images, masks, slopes, outward, z_ref, margin, hits, tolerance, noise, moved
):  # fmt: skip
    """See `sharpen`; ``sure`` is ``[H, W]`` bool, ``moved`` ``[H, W]`` float32 is filled."""
    rows, cols = height.shape
    views = images.shape[0]
    most = (2 * LOOK + 1) * (LOOK + 1)
    for row in prange(rows):
        where = np.empty((most, 2), np.int64)
        side = np.empty(most, np.int64)
        weight = np.empty(most)
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
            below = _level(height, sure, row, col, -np.inf, middle)
            above = _level(height, sure, row, col, middle, np.inf)
            if not above - below >= STEP_M:
                continue
            cells = _gather(height, sure, row, col, below, above, where, side, weight)
            roof = ground = 0.0
            roof_views = ground_views = 0
            for v in range(views):
                r, c = row + margin + slopes[v, 0] * (above - z_ref), col + margin + slopes[v, 1] * (above - z_ref)
                like = _likeness(
                    images[v], masks[v], hits[v], above + tolerance, r, c, where, side, weight, cells, noise
                )
                if like == like:
                    roof += like
                    roof_views += 1
                outside = outward[v, 0] * uphill[0, row, col] + outward[v, 1] * uphill[1, row, col]
                if outside <= OUTSIDE:
                    continue
                r, c = row + margin + slopes[v, 0] * (below - z_ref), col + margin + slopes[v, 1] * (below - z_ref)
                like = _likeness(
                    images[v], masks[v], hits[v], below + tolerance, r, c, where, side, weight, cells, noise
                )
                if like == like:
                    ground += like
                    ground_views += 1
            if roof_views < FEWEST_VIEWS:
                continue
            if here < middle and roof > RAISE * roof_views:
                moved[row, col] = above
            elif here >= middle and roof < LOWER * roof_views and ground < GROUND * ground_views:
                moved[row, col] = below


__all__ = ["choose_sides", "sharpen"]

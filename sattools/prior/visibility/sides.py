"""What the views show on either side of a wall."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sattools.compiled import njit, spread

STEP_M = 2.0  # smallest height step that is a wall
SAME_M = 1.0  # heights this near belong to the same side
FEWEST_VIEWS = 2
CAP = 2.0  # log-likelihood ratio at which a view is sure: one date's facade, glare or shadow moves no wall
CONTRAST = 0.5  # standard deviations by which the sides have to differ in a view that can tell them apart
OUTSIDE = 0.2  # cosine between the way down a wall and that towards a view, or a sun, which sees the foot of the wall


class Surroundings(NamedTuple):
    """How far around a cell what either side of a wall is like is looked for, in cells.

    Attributes:
        near: from a height step within which a cell may change sides: the matching window and its blur.
        reach: around it that tell how high either side is.
        fall: over which their weight falls.
        look: around it that tell what either side looks like, of which every second is asked.
        high_fall: over which the weight of those on the high side falls.
        low_fall: of those on the low side: what lies beyond an edge changes sooner than what lies on a roof.
        fewest_cells: weight of the cells that make a level.
        fewest_looks: weight of the cells that make an appearance.
    """

    near: int = 3
    reach: int = 5
    fall: float = 3.0
    look: int = 9
    high_fall: float = 4.0
    low_fall: float = 3.0
    fewest_cells: float = 1.5
    fewest_looks: float = 0.3

    def times(self, factor: float) -> Surroundings:
        """The same distances for cells that are smaller by a factor."""
        cells = (max(1, round(factor * n)) for n in (self.near, self.reach, self.look))
        near, reach, look = cells
        falls = (factor * n for n in (self.fall, self.high_fall, self.low_fall))
        fall, high_fall, low_fall = falls
        weights = (factor * factor * n for n in (self.fewest_cells, self.fewest_looks))
        return Surroundings(near, reach, fall, look, high_fall, low_fall, *weights)


@njit(cache=True)
def bell(reach, fall):
    """Weights ``[2 reach + 1, 2 reach + 1]`` that fall with the distance from the middle."""
    weights = np.empty((2 * reach + 1, 2 * reach + 1))
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            weights[i + reach, j + reach] = math.exp(-(i * i + j * j) / (2 * fall * fall))
    return weights


@njit(cache=True)
def _levels(height, off_step, row, col, middle, weights, fewest):
    """Weighted means of the sure heights below and above around a cell, NaN if there are too few."""
    rows, cols = height.shape
    reach = len(weights) // 2
    low = high = low_weight = high_weight = 0.0
    for i in range(max(0, row - reach), min(rows, row + reach + 1)):
        for j in range(max(0, col - reach), min(cols, col + reach + 1)):
            z = height[i, j]
            w = weights[i - row + reach, j - col + reach] if off_step[i, j] else 0.0
            if z < middle:
                low += w * z
                low_weight += w
            else:
                high += w * z
                high_weight += w
    return low / low_weight if low_weight > fewest else np.nan, high / high_weight if high_weight > fewest else np.nan


@njit(cache=True)
def gather(height, off_step, row, col, below, above, stride, falls, where, weight, count, total):
    """Note the sure cells of either side (0 = low, 1 = high) around a cell.

    where: ``[2, N]`` offsets in a flat image with rows of ``stride`` pixels; weight: ``[2, N]``; count, total: ``[2]``
    their numbers and sums of weights. falls: ``[2, n, n]`` weights of either side around the cell.
    """
    rows, cols = height.shape
    look = falls.shape[1] // 2
    count[:] = 0
    total[:] = 0.0
    for i in range(-look, look + 1):
        for j in range(-look + (i + look) % 2, look + 1, 2):
            r, c = row + i, col + j
            if not (0 <= r < rows and 0 <= c < cols) or not off_step[r, c]:
                continue
            high = abs(height[r, c] - above) <= SAME_M
            if not high and abs(height[r, c] - below) > SAME_M:
                continue
            side = 1 if high else 0
            where[side, count[side]] = i * stride + j
            weight[side, count[side]] = falls[side, i + look, j + look]
            total[side] += falls[side, i + look, j + look]
            count[side] += 1


@njit(cache=True)
def _appearance(pixels, at, where, weight, count, total):
    """Mean and variance of the pixels of one side; the second sums of odd ones keep the processor busy."""
    mean = squares = odd_mean = odd_squares = 0.0
    for n in range(0, count - 1, 2):
        x, y = pixels[np.uint64(at + where[n])], pixels[np.uint64(at + where[n + 1])]
        one, other = weight[n] * x, weight[n + 1] * y
        mean += one
        squares += one * x
        odd_mean += other
        odd_squares += other * y
    if count % 2:
        x = pixels[np.uint64(at + where[count - 1])]
        mean += weight[count - 1] * x
        squares += weight[count - 1] * x * x
    mean = (mean + odd_mean) / total
    return mean, max((squares + odd_squares) / total - mean * mean, 0.0)


@njit(cache=True)
def likeness_of(image, r, c, low, low_spread, high, high_spread, noise):
    """How surely the brightness at a place of an image is that of the high side, -1 ... 1; NaN where sides are alike.

    The two sides get one spread, so that a pixel that mixes them belongs to the one that has more of it.
    """
    variance = noise * noise + 0.5 * (low_spread + high_spread)
    if (high - low) ** 2 < CONTRAST * CONTRAST * variance:
        return np.nan
    iy, ix = math.floor(r), math.floor(c)
    fy, fx = r - iy, c - ix
    upper = image[iy, ix] + fx * (image[iy, ix + 1] - image[iy, ix])
    lower = image[iy + 1, ix] + fx * (image[iy + 1, ix + 1] - image[iy + 1, ix])
    ratio = (high - low) * (upper + fy * (lower - upper) - 0.5 * (high + low)) / variance
    return min(max(ratio / CAP, -1.0), 1.0)


@njit(cache=True)
def _likeness(image, mask, hit, parallax, z, z_ref, row, col, tolerance, where, weight, count, total, noise):
    """How surely a pixel belongs to the high side in one view, -1 ... 1; NaN where the view cannot tell.

    row, col: frame position of the cell at z_ref; z: the height in question; tolerance: depth at which it still shows.
    """
    r, c = row + parallax[0] * (z - z_ref), col + parallax[1] * (z - z_ref)
    a, b = round(r), round(c)
    if hit[a, b] > z + tolerance or mask[a, b] == 0:
        return np.nan
    pixels, at = image.reshape(-1), a * image.shape[1] + b
    low, low_spread = _appearance(pixels, at, where[0], weight[0], count[0], total[0])
    high, high_spread = _appearance(pixels, at, where[1], weight[1], count[1], total[1])
    return likeness_of(image, r, c, low, low_spread, high, high_spread, noise)


@spread(lambda height, *_: len(height))
@njit(cache=True, nogil=True)
def compare_sides(
    height, off_step, uphill, images, masks, parallax, outward, sunlight, z_ref, margin, first_hit_height, tolerance,
    noise, around, below, above, roof, told, foot, lit_foot, first_row, end_row,
):  # fmt: skip
    """What either side of a wall looks like, for every cell near one.

    Args:
        height: ``[H, W]`` float32 [m].
        off_step: ``[H, W]`` bool, surely on one side.
        uphill: ``[2, H, W]`` float32 unit vector (rows, columns) up the wall.
        images: ``[V, Hf, Wf]`` float32, see `Frame`.
        masks: ``[V, Hf, Wf]`` uint8, 1 = valid.
        parallax: ``[V, 2]`` float64 (row, column) cells per metre of height.
        outward: ``[V, 2]`` unit vector from the view to the ground; NaN = from straight above, which shows nothing
            else at the foot than at the roof.
        sunlight: ``[V, 2]`` that from its sun; NaN = from straight above, or unknown.
        z_ref: reference height of the frame [m].
        margin: cells between the border of the frame and that of the grid.
        first_hit_height: ``[V, Hf, Wf]`` float32 [m].
        tolerance: depth below the visible surface that still counts as seen [m].
        noise: standard deviation of brightness on one material.
        around: how far around a cell to look.
        below: ``[H, W]`` float32, filled with the height of the low side [m]; NaN = not near a wall.
        above: the same of the high side.
        roof: ``[H, W]`` float32, filled with the mean likeness to the high side (-1 ... 1) at its height; 0 = unknown.
        told: ``[H, W]`` float32, filled with the number of views that tell it.
        foot: ``[2, H, W]`` float32, filled with that at the height of the low side, NaN = no view from outside; and
            with the number of views from there.
        lit_foot: ``[2, H, W]`` float32, the same of the views with the sun outside, too.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    rows, cols = height.shape
    views = images.shape[0]
    most = (2 * around.look + 1) * (around.look + 1)
    nearby = bell(around.reach, around.fall)
    falls = np.stack((bell(around.look, around.low_fall), bell(around.look, around.high_fall)))
    for row in range(first_row, end_row):
        where, weight = np.empty((2, most), np.int64), np.empty((2, most))
        count, total = np.empty(2, np.int64), np.empty(2)
        for col in range(cols):
            below[row, col] = above[row, col] = foot[0, row, col] = lit_foot[0, row, col] = np.nan
            roof[row, col] = told[row, col] = foot[1, row, col] = lit_foot[1, row, col] = 0.0
            low = high = height[row, col]
            for i in range(max(0, row - around.near), min(rows, row + around.near + 1)):
                for j in range(max(0, col - around.near), min(cols, col + around.near + 1)):
                    low, high = min(low, height[i, j]), max(high, height[i, j])
            if high - low < STEP_M:
                continue
            middle = 0.5 * (low + high)
            bottom, top = _levels(height, off_step, row, col, middle, nearby, around.fewest_cells)
            if not top - bottom >= STEP_M:
                continue
            below[row, col], above[row, col] = bottom, top
            gather(height, off_step, row, col, bottom, top, images.shape[2], falls, where, weight, count, total)
            if total.min() < around.fewest_looks:
                continue
            up_row, up_col = uphill[0, row, col], uphill[1, row, col]
            at_roof = at_foot = at_lit_foot = 0.0
            roof_views = foot_views = lit_views = 0
            for v in range(views):
                like = _likeness(
                    images[v], masks[v], first_hit_height[v], parallax[v], top, z_ref, row + margin, col + margin,
                    tolerance, where, weight, count, total, noise,
                )  # fmt: skip
                if like == like:
                    at_roof += like
                    roof_views += 1
                if not outward[v, 0] * up_row + outward[v, 1] * up_col > OUTSIDE:
                    continue
                like = _likeness(
                    images[v], masks[v], first_hit_height[v], parallax[v], bottom, z_ref, row + margin, col + margin,
                    tolerance, where, weight, count, total, noise,
                )  # fmt: skip
                if like == like:
                    at_foot += like
                    foot_views += 1
                    if not sunlight[v, 0] * up_row + sunlight[v, 1] * up_col <= OUTSIDE:  # not so if unknown
                        at_lit_foot += like
                        lit_views += 1
            if roof_views >= FEWEST_VIEWS:
                roof[row, col] = at_roof / roof_views
                told[row, col] = roof_views
            if foot_views:
                foot[0, row, col] = at_foot / foot_views
                foot[1, row, col] = foot_views
            if lit_views:
                lit_foot[0, row, col] = at_lit_foot / lit_views
                lit_foot[1, row, col] = lit_views


__all__ = [
    "FEWEST_VIEWS",
    "OUTSIDE",
    "SAME_M",
    "STEP_M",
    "Surroundings",
    "bell",
    "compare_sides",
    "gather",
    "likeness_of",
]

"""Walls where the images' brightness changes: what matching puts on the wrong side of an edge changes sides."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, median_filter, minimum_filter

from sattools.compiled import njit, spread
from sattools.prior.frame import Frame
from sattools.prior.neighbours import blurred_walls, doubtful_walls, mean_around

STEP_M = 2.0  # smallest height step that is a wall
FLAT_M = 1.5  # height range of 3 x 3 cells that are surely off the step
SAME_M = 1.0  # heights this near belong to the same side
FEWEST_VIEWS = 2
CAP = 2.0  # log-likelihood ratio at which a view is sure: one date's facade, glare or shadow moves no wall
CONTRAST = 0.5  # standard deviations by which the sides have to differ in a view that can tell them apart
PULL = 0.3  # likeness (-1 ... 1) that it takes to change sides, a cell of the result from the matching's step
FAR = 3.0  # cells of it from which on it takes no more
RIM = -0.2  # likeness to the high side below which a cell of it is a doubtful rim
# mean likeness to it at the foot of such rims: at the first walls are upright, at the second not
FOOT = (-0.3, -0.1)
LIT_FOOT = (-0.2, 0.0)  # the same in the views alone in which it is lit
FOOT_SCALE_M = 20.0  # distance over which it is averaged
OUTWARD = 0.8  # likeness by which walls that are not upright start outside the edge of their roof
SLOPE_SCALE = 2.0  # cells over which the direction of a wall is averaged
OUTSIDE = 0.2  # cosine between the way down a wall and that towards a view, or a sun, which sees the foot of the wall
STEEP = 0.05  # tangent of the angle from the vertical below which a view or a sun sees the foot of every wall


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


class Snapped(NamedTuple):
    """Heights with their steps where the images change.

    Attributes:
        height: ``[H, W]`` float32 [m].
        doubt: ``[H, W]`` how doubtful the walls around are, see `doubtful_walls`.
        blur: how blurred those of the whole area, see `blurred_walls`.
        side: ``[H, W]`` float32 which side of a wall cells beside it belong to, 1 = surely high, -1 = surely low; the
            wall is where it is 0 between their centres. NaN = not beside a wall.
    """

    height: np.ndarray
    doubt: np.ndarray
    blur: float
    side: np.ndarray


def snap_edges(
    frame: Frame,
    first_hit_height: np.ndarray,
    height: np.ndarray,
    tolerance: float,
    noise: float,
    finer: float = 1.0,
    *,
    few: bool = False,
) -> Snapped:
    """Move height steps to where the images change, and say how sure the images are of it.

    A window on the rim of a roof sees the roof's edge, which agrees in all views, and so matching makes everything
    high one window too wide, most of all where a dark strip of shaded ground follows. But the strip does not look like
    the roof: shifted to the roof's height, every view shows the roof on one side of the edge and something else on
    the other, be it facade, shadow or ground far behind. So near a step every cell is asked whether it looks like the
    cells surely on the high side or like those surely on the low side, as this view shows either *at the roof's
    height*: all views can tell, whatever hides the ground.

    Where the matching has its step and where the likeness changes are two measurements of a wall, whose errors have
    little in common. So the further from the matching's step, the more likeness it takes to change sides: the wall
    comes to lie between both.

    Where walls are upright, the roof's edge is the wall. Where they lean, or lidar and eaves make them wider, there is
    a strip which looks like neither roof nor ground: at the height of the ground, views from outside show something
    else than ground in place of the rims. There matching, which puts the step on the outer side of the strip, is
    believed more than the edge. So must those in which the sun stands outside, too: in the shadow of a wall, the ground
    at its foot never looks like the ground around. But they are fewer, so that both have to say so.

    Args:
        frame: the views.
        first_hit_height: ``[V, Hf, Wf]`` heights at which rays first meet the surface [m].
        height: ``[H, W]`` float32 [m].
        tolerance: depth below the visible surface that still counts as seen [m].
        noise: standard deviation of brightness on one material.
        finer: number of the frame's cells along a cell of the result.
        few: whether views are too few to be asked about lit ground by itself.
    """
    off_step = maximum_filter(height, 3, mode="nearest") - minimum_filter(height, 3, mode="nearest") < FLAT_M
    off_step = minimum_filter(off_step, 3, mode="nearest")
    uphill = np.stack(
        [gaussian_filter(height, SLOPE_SCALE * finer, order=order, mode="nearest") for order in ((1, 0), (0, 1))]
    )
    uphill /= np.maximum(np.hypot(*uphill), 1e-6)
    # on its way up to the view a ray moves against the parallax, and to the sun against its light
    outward = _outward(frame.parallax * frame.cell)
    unknown = (np.nan, np.nan, 1.0)
    suns = np.array([unknown if sun is None else sun for sun in frame.suns])
    sunlight = _outward(np.stack([suns[:, 1], -suns[:, 0]], axis=1) / np.maximum(suns[:, 2:], STEEP))
    below, above, roof, foot, lit_foot = (np.empty_like(height) for _ in range(5))
    compare_sides(
        height, off_step, uphill, frame.images, frame.masks, frame.parallax, outward, sunlight, frame.z_ref,
        frame.margin, first_hit_height, tolerance, noise, Surroundings().times(finer), below, above, roof, foot,
        lit_foot,
    )  # fmt: skip
    beside_wall = np.isfinite(below)
    doubt = doubtful_walls(roof, beside_wall, frame.cell)
    blur = blurred_walls(roof, beside_wall)
    if not beside_wall.any():
        return Snapped(median_filter(height, 3, mode="nearest"), doubt, blur, np.full_like(height, np.nan))
    side = np.where(height >= 0.5 * (below + above), 1.0, -1.0)
    rims, scale = beside_wall & (side > 0) & (roof < RIM), FOOT_SCALE_M / frame.cell
    lean = leaning(rims, foot, scale, FOOT)
    if not few:
        np.minimum(lean, leaning(rims, lit_foot, scale, LIT_FOOT), out=lean)
    stay = PULL * np.clip(_depth(beside_wall, side, FAR * finer) / finer, -FAR, FAR)
    high = roof + (1 - lean) * stay + lean * side + OUTWARD * lean
    high += lean * (_mean_within(high, beside_wall, 1.0) - high)
    moved = np.where(beside_wall & (side > 0) & (high <= 0), below, height)
    moved = np.where(beside_wall & (side < 0) & (high > 0), above, moved)
    sure = np.where(beside_wall, np.clip(high, -1, 1), np.nan).astype(np.float32)
    return Snapped(median_filter(moved, 3, mode="nearest"), doubt, blur, sure)


def _outward(tangent: np.ndarray) -> np.ndarray:
    """Unit vectors of ``[V, 2]`` tangents; NaN = from straight above, which is outside of every wall, or unknown."""
    length = np.hypot(*tangent.T)[:, None]
    return np.where(length < STEEP, np.nan, tangent / np.maximum(length, STEEP))


def leaning(rims: np.ndarray, foot: np.ndarray, scale: float, limits: tuple[float, float]) -> np.ndarray:
    """How little upright the walls around every cell are, 0 ... 1; 0 where no foot tells.

    Args:
        rims: ``[H, W]`` bool cells that do not look like their roof.
        foot: ``[H, W]`` how much they look like the high side at the ground's height, -1 ... 1; NaN = unknown.
        scale: standard deviation of the mean around [cells].
        limits: means up to which walls are upright, and from which on they are not.
    """
    known = rims & np.isfinite(foot)
    if not known.any():
        return np.zeros(foot.shape)
    mean = mean_around(foot, known, scale)
    upright, not_upright = limits
    return np.clip((mean - upright) / (not_upright - upright), 0.0, 1.0)


def _depth(beside_wall: np.ndarray, side: np.ndarray, reach: float) -> np.ndarray:
    """Cells from the step between the sides, positive on the high one, where they are less than ``reach``.

    Args:
        beside_wall: ``[H, W]`` bool.
        side: ``[H, W]`` 1 = high, -1 = low; where cells are beside a wall.
        reach: beyond it, and where there is one side alone, any number beyond it.
    """
    import cv2

    def from_other(high: bool) -> np.ndarray:
        other = beside_wall & ((side < 0) if high else (side > 0))
        if not other.any():
            return np.full(side.shape, reach + 1, np.float32)
        return np.asarray(cv2.distanceTransform((~other).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)) - 0.5

    return np.where(side > 0, from_other(True), -from_other(False))


def _mean_within(values: np.ndarray, region: np.ndarray, scale: float) -> np.ndarray:
    """Gaussian mean over the cells of a region."""
    weight = gaussian_filter(region.astype(np.float64), scale)
    return gaussian_filter(np.where(region, values, 0.0), scale) / np.maximum(weight, 1e-6)


@njit(cache=True)
def _bell(reach, fall):
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
def _gather(height, off_step, row, col, below, above, stride, falls, where, weight, count, total):
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
def _likeness(image, mask, hit, parallax, z, z_ref, row, col, tolerance, where, weight, count, total, noise):
    """How surely a pixel belongs to the high side in one view, -1 ... 1; NaN where the view cannot tell.

    row, col: frame position of the cell at z_ref; z: the height in question; tolerance: depth at which it still shows.
    The two sides get one spread, so that a pixel that mixes them belongs to the one that has more of it.
    """
    r, c = row + parallax[0] * (z - z_ref), col + parallax[1] * (z - z_ref)
    a, b = round(r), round(c)
    if hit[a, b] > z + tolerance or mask[a, b] == 0:
        return np.nan
    pixels, at = image.reshape(-1), a * image.shape[1] + b
    low, low_spread = _appearance(pixels, at, where[0], weight[0], count[0], total[0])
    high, high_spread = _appearance(pixels, at, where[1], weight[1], count[1], total[1])
    variance = noise * noise + 0.5 * (low_spread + high_spread)
    if (high - low) ** 2 < CONTRAST * CONTRAST * variance:
        return np.nan
    iy, ix = math.floor(r), math.floor(c)
    fy, fx = r - iy, c - ix
    upper = image[iy, ix] + fx * (image[iy, ix + 1] - image[iy, ix])
    lower = image[iy + 1, ix] + fx * (image[iy + 1, ix + 1] - image[iy + 1, ix])
    ratio = (high - low) * (upper + fy * (lower - upper) - 0.5 * (high + low)) / variance
    return min(max(ratio / CAP, -1.0), 1.0)


@spread(lambda height, *_: len(height))
@njit(cache=True, nogil=True)
def compare_sides(
    height, off_step, uphill, images, masks, parallax, outward, sunlight, z_ref, margin, first_hit_height, tolerance,
    noise, around, below, above, roof, foot, lit_foot, first_row, end_row,
):  # fmt: skip
    """What either side of a wall looks like, for every cell near one.

    Args:
        height: ``[H, W]`` float32 [m].
        off_step: ``[H, W]`` bool, surely on one side.
        uphill: ``[2, H, W]`` float32 unit vector (rows, columns) up the wall.
        images: ``[V, Hf, Wf]`` float32, see `Frame`.
        masks: ``[V, Hf, Wf]`` uint8, 1 = valid.
        parallax: ``[V, 2]`` float64 (row, column) cells per metre of height.
        outward: ``[V, 2]`` unit vector from the view to the ground; NaN = from straight above.
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
        foot: ``[H, W]`` float32, filled with that at the height of the low side; NaN = no view from outside.
        lit_foot: ``[H, W]`` float32, the same of the views with the sun outside, too.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    rows, cols = height.shape
    views = images.shape[0]
    most = (2 * around.look + 1) * (around.look + 1)
    nearby = _bell(around.reach, around.fall)
    falls = np.stack((_bell(around.look, around.low_fall), _bell(around.look, around.high_fall)))
    for row in range(first_row, end_row):
        where, weight = np.empty((2, most), np.int64), np.empty((2, most))
        count, total = np.empty(2, np.int64), np.empty(2)
        for col in range(cols):
            below[row, col] = above[row, col] = foot[row, col] = lit_foot[row, col] = np.nan
            roof[row, col] = 0.0
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
            _gather(height, off_step, row, col, bottom, top, images.shape[2], falls, where, weight, count, total)
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
                if outward[v, 0] * up_row + outward[v, 1] * up_col <= OUTSIDE:
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
            if foot_views:
                foot[row, col] = at_foot / foot_views
            if lit_views:
                lit_foot[row, col] = at_lit_foot / lit_views


__all__ = ["Snapped", "compare_sides", "leaning", "snap_edges"]

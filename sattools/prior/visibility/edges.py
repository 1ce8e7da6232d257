"""Walls where the images' brightness changes: what matching puts on the wrong side of an edge changes sides."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, median_filter, minimum_filter

from sattools.prior.frame import Frame
from sattools.prior.neighbours import blurred_walls, doubtful_walls, mean_around
from sattools.prior.visibility.cast import shadow_sides
from sattools.prior.visibility.sides import Surroundings, compare_sides

FLAT_M = 1.5  # height range of 3 x 3 cells that are surely off the step
PULL = 0.3  # likeness (-1 ... 1) that it takes to change sides, a cell of the result from the matching's step
FAR = 3.0  # cells of it from which on it takes no more
RIM = -0.2  # likeness to the high side below which a cell of it is a doubtful rim
# mean likeness to it at the foot of such rims: at the first walls are upright, at the second not
FOOT = (-0.3, -0.1)
LIT_FOOT = (-0.2, 0.0)  # the same in the views alone in which it is lit
FOOT_SCALE_M = 20.0  # distance over which it is averaged
OUTWARD = 0.7  # likeness by which walls that are not upright start outside the edge of their roof
GROUND = 0.2  # likeness to the high side, at the height of the low one, below which a cell shows ground
FEET = 0.8  # what that counts beside the likeness at the roof's height, where many views see the foot
FEW_FEET = 2.0  # views of it that count half of that
SLOPE_SCALE = 2.0  # cells over which the direction of a wall is averaged
STEEP = 0.05  # tangent of the angle from the vertical below which a view, or a sun, is straight above


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

    The sun is one more view: where the shadow of the wall ends it shows the roof's edge once more, see `shadow_sides`.

    Where the matching has its step and where the likeness changes are two measurements of a wall, whose errors have
    little in common. So the further from the matching's step, the more likeness it takes to change sides: the wall
    comes to lie between both.

    And where ground is, views from outside see ground, too, at the height of the ground; where the building stands they
    see its facade. Only they can tell, and their suns must stand outside as well: in the shadow of a wall, the ground
    at its foot never looks like the ground around. So that is a third measurement, of few views, which count the more
    the more there are.

    Where walls are upright, the roof's edge is the wall. Where they lean, or lidar and eaves make them wider, there is
    a strip which looks like neither roof nor ground: at the height of the ground, views from outside show something
    else than ground in place of the rims. There matching, which puts the step on the outer side of the strip, is
    believed more than the edge; both all views from outside and those in the sun have to say so.

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
    sunlight = _outward(frame.light * frame.cell)
    below, above, roof, told = (np.empty_like(height) for _ in range(4))
    foot, lit_foot = (np.empty((2, *height.shape), np.float32) for _ in range(2))
    around = Surroundings().times(finer)
    compare_sides(
        height, off_step, uphill, frame.images, frame.masks, frame.parallax, outward, sunlight, frame.z_ref,
        frame.margin, first_hit_height, tolerance, noise, around, below, above, roof, told, foot, lit_foot,
    )  # fmt: skip
    beside_wall = np.isfinite(below)
    doubt = doubtful_walls(roof, beside_wall, frame.cell)
    blur = blurred_walls(roof, beside_wall)
    if not beside_wall.any():
        return Snapped(median_filter(height, 3, mode="nearest"), doubt, blur, np.full_like(height, np.nan))
    side = np.where(height >= 0.5 * (below + above), 1.0, -1.0)
    rims, scale = beside_wall & (side > 0) & (roof < RIM), FOOT_SCALE_M / frame.cell
    lean = leaning(rims, foot[0], scale, FOOT)
    if not few:
        np.minimum(lean, leaning(rims, lit_foot[0], scale, LIT_FOOT), out=lean)
    stay = PULL * np.clip(_depth(beside_wall, side, FAR * finer) / finer, -FAR, FAR)
    shown, shadows = shadow_sides(
        frame, first_hit_height, height, off_step, uphill, (below, above),
        tolerance=tolerance, noise=noise, around=around,
    )  # fmt: skip
    likeness = (roof * told + shown) / np.maximum(told + shadows, 1)
    high = likeness + (1 - lean) * stay + lean * side + OUTWARD * lean
    high += lean * (_mean_within(high, beside_wall, 1.0) - high)
    likeness_of_foot, feet = foot if few else lit_foot
    high += FEET * _no_ground(likeness_of_foot, np.where(told > 0, feet, 0.0))
    moved = np.where(beside_wall & (side > 0) & (high <= 0), below, height)
    moved = np.where(beside_wall & (side < 0) & (high > 0), above, moved)
    sure = np.where(beside_wall, np.clip(high, -1, 1), np.nan).astype(np.float32)
    return Snapped(median_filter(moved, 3, mode="nearest"), doubt, blur, sure)


def _no_ground(likeness: np.ndarray, views: np.ndarray) -> np.ndarray:
    """How surely cells show no ground, about -1 ... 1: the views' mean, as if some more had not known.

    Args:
        likeness: ``[H, W]`` to the high side at the height of the low one, -1 ... 1.
        views: ``[H, W]`` number of views that tell it.
    """
    return np.where(views > 0, likeness - GROUND, 0.0) * views / (views + FEW_FEET)


def _outward(tangent: np.ndarray) -> np.ndarray:
    """Unit vectors of ``[V, 2]`` tangents; NaN = from straight above, or unknown."""
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


__all__ = ["Snapped", "leaning", "snap_edges"]

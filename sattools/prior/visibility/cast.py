"""Walls where their shadows end: the sun is one more view, which sees the edge of a roof on the ground."""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import njit, spread
from sattools.prior.frame import Frame
from sattools.prior.visibility.sides import (
    FEWEST_VIEWS,
    OUTSIDE,
    SAME_M,
    STEP_M,
    Surroundings,
    bell,
    gather,
    likeness_of,
)

STEEP = 0.05  # tangent of the angle from the vertical below which the sun throws no shadow beside a wall
LANDED_M = 0.1  # change of height at which the place where a beam ends is known
TRIES = 3  # steps along a beam until then
NEARER = 0.5  # of the distance up to which the views look around a cell: light and shade are the same all along a wall


def shadow_sides(
    frame: Frame,
    first_hit_height: np.ndarray,
    height: np.ndarray,
    off_step: np.ndarray,
    uphill: np.ndarray,
    sides: tuple[np.ndarray, np.ndarray],
    *,
    tolerance: float,
    noise: float,
    around: Surroundings,
) -> tuple[np.ndarray, np.ndarray]:
    """How surely cells beside walls throw shadow, as the views see it where it falls.

    The beam that passes over a cell at the height of the roof beside it ends on the ground further on. Where the cell
    is roof it ends there in shadow, where it is not, in sunlight, and so an image of the ground shows the edge of the
    roof once more, at another place, against another ground, and whatever the roof looks like.

    Args:
        frame: the views, with their suns.
        first_hit_height: ``[V, Hf, Wf]`` heights at which rays first meet the surface [m].
        height: ``[H, W]`` float32 [m].
        off_step: ``[H, W]`` bool, surely on one side of a wall.
        uphill: ``[2, H, W]`` float32 unit vector (rows, columns) up the wall.
        sides: heights ``[H, W]`` of the low and of the high side [m]; NaN = not near a wall.
        tolerance: depth below the visible surface that still counts as seen [m].
        noise: standard deviation of brightness on one material.
        around: how far around a cell to look.

    Returns:
        ``[H, W]`` float32 sum over the views of the likeness to the high side, -1 ... 1 each, and the number of views;
        both 0 where fewer than two tell.
    """
    like, views = np.zeros_like(height), np.zeros_like(height)
    beams = frame.light
    beams[~(np.hypot(*beams.T) * frame.cell > STEEP)] = np.nan
    if np.isfinite(beams).any():
        around = around._replace(look=max(1, round(NEARER * around.look)))
        ground = np.pad(height, frame.margin, constant_values=np.nan)
        compare_shadows(
            ground, off_step, uphill, frame.images, frame.masks, frame.parallax, beams, frame.z_ref, frame.margin,
            first_hit_height, tolerance, noise, around, *sides, like, views,
        )  # fmt: skip
        alone = views < FEWEST_VIEWS
        like[alone] = views[alone] = 0.0
    return like, views


@njit(cache=True)
def _landing(ground, row, col, beam, bottom, top):
    """Row, column and height at which a beam meets the ground that passes over a cell at the height of the roof.

    NaN where it meets none: beyond the border, or where something stands as high as the roof.
    """
    z = bottom
    for _ in range(TRIES):
        r, c = row + beam[0] * (top - z), col + beam[1] * (top - z)
        if not (0 <= r <= ground.shape[0] - 1 and 0 <= c <= ground.shape[1] - 1):
            return np.nan, np.nan, np.nan
        there = ground[round(r), round(c)]
        if not there <= top - STEP_M:
            return np.nan, np.nan, np.nan
        if abs(there - z) < LANDED_M:
            break
        z = there
    return r, c, z


@njit(cache=True)
def _shown(image, mask, hit, ground, to_view, at, z, tolerance, where, weight, count):
    """Weight, mean and variance of the pixels in which a view shows the ground around the end of a beam."""
    total = mean = squares = 0.0
    for n in range(count):
        there = at + where[n]
        if there < 0 or there >= len(ground) or not abs(ground[there] - z) <= SAME_M:
            continue
        there += to_view
        if mask[there] == 0 or hit[there] > z + tolerance:
            continue
        total += weight[n]
        mean += weight[n] * image[there]
        squares += weight[n] * image[there] * image[there]
    if total == 0:
        return 0.0, 0.0, 0.0
    mean /= total
    return total, mean, max(squares / total - mean * mean, 0.0)


@spread(lambda ground, off_step, *_: len(off_step))
@njit(cache=True, nogil=True)
def compare_shadows(
    ground, off_step, uphill, images, masks, parallax, beams, z_ref, margin, first_hit_height, tolerance, noise, around,
    below, above, like, seen, first_row, end_row,
):  # fmt: skip
    """What `shadow_sides` says, cell by cell; ``ground`` is the height with the frame's margin around it, NaN there.

    beams: ``[V, 2]`` float64 (row, column) cells that the light of a view's sun moves by as it falls by a metre.
    """
    rows, cols = off_step.shape
    stride = images.shape[2]
    most = (2 * around.look + 1) * (around.look + 1)
    falls = np.stack((bell(around.look, around.low_fall), bell(around.look, around.high_fall)))
    height = ground[margin : margin + rows, margin : margin + cols]
    flat = ground.reshape(-1)
    for row in range(first_row, end_row):
        where, weight = np.empty((2, most), np.int64), np.empty((2, most))
        count, total = np.empty(2, np.int64), np.empty(2)
        for col in range(cols):
            bottom, top = below[row, col], above[row, col]
            if not top - bottom >= STEP_M:
                continue
            gathered = False
            for v in range(len(images)):
                way = beams[v, 0] * uphill[0, row, col] + beams[v, 1] * uphill[1, row, col]
                if not way < -OUTSIDE * math.hypot(beams[v, 0], beams[v, 1]):
                    continue
                r, c, z = _landing(ground, row + margin, col + margin, beams[v], bottom, top)
                if z != z:
                    continue
                y, x = r + parallax[v, 0] * (z - z_ref), c + parallax[v, 1] * (z - z_ref)
                a, b = round(y), round(x)
                if first_hit_height[v, a, b] > z + tolerance or masks[v, a, b] == 0:
                    continue
                if not gathered:
                    gather(height, off_step, row, col, bottom, top, stride, falls, where, weight, count, total)
                    gathered = True
                if total.min() < around.fewest_looks:
                    break
                at = round(r) * stride + round(c)
                sights = images[v].reshape(-1), masks[v].reshape(-1), first_hit_height[v].reshape(-1)
                place = flat, a * stride + b - at, at, z, tolerance
                lit_weight, lit, lit_spread = _shown(*sights, *place, where[0], weight[0], count[0])
                dark_weight, dark, dark_spread = _shown(*sights, *place, where[1], weight[1], count[1])
                if lit < dark or min(lit_weight, dark_weight) < around.fewest_looks:
                    continue
                found = likeness_of(images[v], y, x, lit, lit_spread, dark, dark_spread, noise)
                if found == found:
                    like[row, col] += found
                    seen[row, col] += 1


__all__ = ["compare_shadows", "shadow_sides"]

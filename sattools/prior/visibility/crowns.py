"""Crowns that a part of the images shows without leaves.

In winter the ground under a tree is seen between its branches, and the few pairs of such images agree about it better
than any pair does about leaves. So what some pairs agree about best (a high power mean) is the ground, and what most
of them agree about (a root mean square) is the crown; a surface model is of what lies on top. Elsewhere the two are
one, but for places that few images show, in the sun or at all: there most pairs agree about something else, the roof
beside them above all, and nothing is changed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_opening, binary_propagation, label, mean, median_filter, standard_deviation

from sattools.prior.matching.sweep import MatchTask, sweep_blocks
from sattools.prior.visibility.courtyards import RoughSurface
from sattools.prior.visibility.occlusion import at_surface, within_images

HIGHER_M = (2.0, 30.0)  # above the surface that is found otherwise
WIDTH_M = 2.0  # of a crown's core, at least
OPEN = 0.9  # share of the images that see each cell of the ground there
LIT = 0.6  # share of them that see the crown in the sun
AGREED = 0.36  # root mean square of the agreement about the crown; by chance, as on water, it is up to 0.34
EVEN = 0.9  # standard deviation of what the images show of it, in what they may differ by (`brightness`), at most
POOR = 0.62  # agreement (of few pairs) about the ground; streets in changing shade, on which most disagree, have more
ROUGH_M = 5.5  # standard deviation of the heights, at most; two crowns that touch have up to 5


def bare_crowns(task: MatchTask, surface: RoughSurface, restless: np.ndarray | None) -> np.ndarray | None:
    """Heights ``[H, W]`` float32 of crowns that a surface lacks [m], NaN elsewhere; None where it lacks none.

    Args:
        task: of the rough passes, with the shares of the pairs: those of two images in leaf are alike.
        surface: which they found.
        restless: ``[H, W]`` bool, where it did not settle: waves look like anything.
    """
    frame, ground, tolerance = task.frame, surface.height, task.options.tolerance
    first_hit, shadow = surface.visibility.first_hit_height, surface.visibility.shadow_height
    # at all heights, not near those of the surface around: a tree may stand alone on wide ground
    high, agreed, _ = sweep_blocks(replace(task, by_most=True), surface.visibility, ceiling=surface.ceiling)
    high = median_filter(high, 3, mode="nearest")
    above = high - ground
    higher = (above > HIGHER_M[0]) & (above < HIGHER_M[1])
    if restless is not None:
        higher &= ~restless
    shown = np.maximum(within_images(frame, ground, tolerance).sum(axis=0), 1)
    higher &= at_surface(frame, first_hit, ground, tolerance)[1].sum(axis=0) >= OPEN * shown
    size = max(round(WIDTH_M / frame.cell), 2)
    core = binary_opening(higher, np.ones((size, size)))
    crown, count = label(binary_propagation(core, mask=higher))
    if not count:
        return None
    value, seen = at_surface(frame, first_hit, high, tolerance)
    lit = (seen & (high >= shadow)).sum(axis=0) / shown
    every = np.arange(1, count + 1)
    stays = (
        (mean(agreed, crown, every) >= AGREED)
        & (mean(surface.score, crown, every) <= POOR)
        & (mean(lit, crown, every) >= LIT)
        & (mean(value.std(axis=0), crown, every) <= EVEN * task.options.brightness)
        & (standard_deviation(high, crown, every) <= ROUGH_M)
    )
    chosen = np.concatenate([[False], stays])[crown]
    return np.where(chosen, high, np.float32(np.nan)) if chosen.any() else None


def with_crowns(height: np.ndarray, crowns: np.ndarray) -> np.ndarray:
    """A surface ``[H, W]`` [m] with those crowns (`bare_crowns`, on its cells) that it lacks."""
    return np.where(crowns > height + HIGHER_M[0], crowns, height)


__all__ = ["bare_crowns", "with_crowns"]

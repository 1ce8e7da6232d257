"""Courtyards that the smoothness term has bridged: found by their darkness, opened where that explains the images
better.

Matching starts without knowing the occlusions. The floor of a deep courtyard is then disturbed by all the views that
see the roofs around it, smoothness spans it with a roof, and this roof hides the floor in every later pass. But such a
roof lies in the sun, while what the images show in its place is as dark as shadow, and disagrees.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening, grey_closing, label, minimum_filter
from scipy.ndimage import mean as mean_over

from sattools.prior.frame import Frame
from sattools.prior.options import PriorOptions
from sattools.prior.sweep import sweep_blocks
from sattools.prior.visibility import UNKNOWN, Visibility, at_surface, compute_visibility

POOR = 0.5  # agreement above which a cell is not doubted
DARK_VIEWS = 0.5  # share of the views in whose sun a doubted cell lies that show it as dark as shadow
FEWEST_VIEWS = 2
FEWEST_CELLS = 4  # of a region that is opened
REACH_M = 30.0  # distance within which the lowest surface is a guess of a courtyard's floor
PIT_CELLS = 7  # narrower pits of the surface are errors, not floors
DEPTH_M = 4.0  # courtyards less deep are not looked for
BELOW_M = 3.0  # a floor lies at least this far below the roof that is taken away
GAIN = 0.08  # by how much the mean agreement of a region must rise for it to stay open


def doubtful(
    frame: Frame, visibility: Visibility, surface: np.ndarray, score: np.ndarray, options: PriorOptions
) -> np.ndarray:
    """Cells ``[H, W]`` bool that lie in the sun and look like shadow, while the views disagree about them."""
    value, seen = at_surface(frame, visibility.first_hit_height, surface, options.tolerance)
    lit = seen & (surface >= visibility.shadow_height)
    dark = lit & (value < visibility.dark[:, None, None] + options.brightness / 2)
    count = lit.sum(axis=0)
    doubt = (count >= FEWEST_VIEWS) & (dark.sum(axis=0) > DARK_VIEWS * count) & (score < POOR)
    return binary_opening(doubt, np.ones((2, 2)))


def open_courtyards(
    frame: Frame,
    surface: np.ndarray,
    eroded: np.ndarray,
    score: np.ndarray,
    pairs: np.ndarray,
    z_range: tuple[float, float],
    step: float,
    options: PriorOptions,
    visibility: Visibility,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Take away the roofs of courtyards.

    Every doubtful region is opened, the area is matched again without heights near the old surface there, and regions
    about which the views now agree better stay open.

    Args:
        frame: the views.
        surface: ``[H, W]`` heights [m].
        eroded: the same without its rims, as it hides.
        score: ``[H, W]`` their agreement.
        pairs: ``[P, 2]`` indices of views.
        z_range: lowest and highest height [m].
        step: distance of the height planes [m].
        options: see `PriorOptions`.
        visibility: what the surface hides; changed where a region is opened.

    Returns:
        ``[H, W]`` heights, lower where a region has been opened, and ``[H, W]`` heights above which nothing must be
        looked for again (smoothness alone would put the roof back); None if nothing has been opened.
    """
    if visibility.dark.max() <= UNKNOWN:
        return surface, None
    low = minimum_filter(grey_closing(surface, PIT_CELLS), 2 * int(REACH_M / frame.cell) + 1, mode="nearest")
    doubt = doubtful(frame, visibility, surface, score, options) & (surface - low > DEPTH_M)
    regions, count = label(doubt)
    if not count:
        return surface, None
    wide = binary_dilation(doubt)
    opened = Visibility(visibility.first_hit_height.copy(), visibility.shadow_height.copy(), visibility.dark)
    compute_visibility(frame, np.where(wide, np.minimum(low, eroded), eroded), z_range, options.tolerance, opened)
    ceiling = np.where(wide, surface - BELOW_M, -UNKNOWN).astype(np.float32)
    floor, agreement, _ = sweep_blocks(frame, opened, pairs, z_range, step, options, ceiling=ceiling)
    every = np.arange(1, count + 1)
    size = np.bincount(regions.ravel(), minlength=count + 1)[1:]
    gain = mean_over(agreement - score, regions, every)
    core = np.isin(regions, every[(gain > GAIN) & (size >= FEWEST_CELLS)])
    if not core.any():
        return surface, None
    stays = binary_dilation(core)
    compute_visibility(frame, np.where(stays, np.minimum(low, eroded), eroded), z_range, options.tolerance, visibility)
    return np.where(stays, np.minimum(floor, surface), surface), np.where(core, ceiling, -UNKNOWN).astype(np.float32)


__all__ = ["doubtful", "open_courtyards"]

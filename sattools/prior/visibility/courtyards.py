"""Courtyards that the smoothness term has bridged.

They are found by their darkness, and opened where that explains the images better.

Matching starts without knowing the occlusions. The floor of a deep courtyard is then disturbed by all the views that
see the roofs around it, smoothness spans it with a roof, and this roof hides the floor in every later pass. But such a
roof lies in the sun, while what the images show in its place is as dark as shadow, and disagrees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening, grey_closing, label, minimum_filter
from scipy.ndimage import mean as mean_over

from sattools.prior.frame import Frame
from sattools.prior.matching.sweep import MatchTask, sweep_blocks
from sattools.prior.options import PriorOptions
from sattools.prior.visibility.occlusion import UNKNOWN, Visibility, at_surface, compute_visibility

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
    """Cells that lie in the sun and look like shadow, while the views disagree about them.

    Args:
        frame: the views.
        visibility: of the surface.
        surface: ``[H, W]`` heights [m].
        score: ``[H, W]`` agreement of the views there, in [0, 1].
        options: see `PriorOptions`.

    Returns:
        ``[H, W]`` bool.
    """
    value, seen = at_surface(frame, visibility.first_hit_height, surface, options.tolerance)
    lit = seen & (surface >= visibility.shadow_height)
    dark = lit & (value < visibility.dark[:, None, None] + options.brightness / 2)
    count = lit.sum(axis=0)
    doubt = (count >= FEWEST_VIEWS) & (dark.sum(axis=0) > DARK_VIEWS * count) & (score < POOR)
    return binary_opening(doubt, np.ones((2, 2)))


@dataclass(frozen=True)
class RoughSurface:
    """The surface after a rough pass, and what it causes.

    Attributes:
        height: ``[H, W]`` float32 [m].
        score: ``[H, W]`` float32 agreement of the views there, in [0, 1].
        eroded: ``[H, W]`` the heights without their rims, as they occlude [m].
        visibility: of the eroded heights.
        ceiling: ``[H, W]`` heights above which nothing must be looked for again [m] (smoothness alone would put a
            bridged roof back), or None.
        crowns: ``[H, W]`` heights of crowns that it lacks [m], NaN elsewhere, or None (see `bare_crowns`).
    """

    height: np.ndarray
    score: np.ndarray
    eroded: np.ndarray
    visibility: Visibility
    ceiling: np.ndarray | None = None
    crowns: np.ndarray | None = None


def open_courtyards(task: MatchTask, surface: RoughSurface) -> RoughSurface:
    """Take away the roofs by which the smoothness term has bridged courtyards.

    Every doubtful region is opened, the area is matched again without heights near the old surface there, and regions
    about which the views now agree better stay open.

    Args:
        task: what is matched.
        surface: of a rough pass.

    Returns:
        The surface with lower heights, their visibility and a ceiling where a region has been opened; the same surface
        without a ceiling if none has been.
    """
    frame, height, eroded = task.frame, surface.height, surface.eroded
    unchanged = replace(surface, ceiling=None)
    if surface.visibility.dark.max() <= UNKNOWN:
        return unchanged
    low = minimum_filter(grey_closing(height, PIT_CELLS), 2 * int(REACH_M / frame.cell) + 1, mode="nearest")
    doubt = doubtful(frame, surface.visibility, height, surface.score, task.options) & (height - low > DEPTH_M)
    regions, count = label(doubt)
    if not count:
        return unchanged

    def visibility_without(region: np.ndarray) -> Visibility:
        """As if the courtyards' floors were seen in a region."""
        lowered = np.where(region, np.minimum(low, eroded), eroded)
        return compute_visibility(frame, lowered, task.z_range, task.options.tolerance, surface.visibility.dark)

    wide = binary_dilation(doubt)
    ceiling = np.where(wide, height - BELOW_M, -UNKNOWN).astype(np.float32)
    floor, agreement, _ = sweep_blocks(task, visibility_without(wide), ceiling=ceiling)
    every = np.arange(1, count + 1)
    size = np.bincount(regions.ravel(), minlength=count + 1)[1:]
    gain = mean_over(agreement - surface.score, regions, every)
    core = np.isin(regions, every[(gain > GAIN) & (size >= FEWEST_CELLS)])
    if not core.any():
        return unchanged
    stays = binary_dilation(core)
    return replace(
        surface,
        height=np.where(stays, np.minimum(floor, height), height),
        visibility=visibility_without(stays),
        ceiling=np.where(core, ceiling, -UNKNOWN).astype(np.float32),
    )


__all__ = ["RoughSurface", "doubtful", "open_courtyards"]

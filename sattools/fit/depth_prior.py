"""The depth prior of a fit: matched heights and how sure they are, in one type for every stage and field."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
from torch import Tensor

from sattools.compare.metrics import nmad
from sattools.scene import Grid
from sattools.scene.regrid import resize_map, sample_map
from sattools.views import GROUND_SHARE

# how far off a prior's height may be, from the surest to the least sure [m]
BEST_STD_M, WORST_STD_M = 0.5, 4.0
LEVEL_M = 1.0  # relief within 5 x 5 cells up to which ground or a roof is level
LEVEL_SHARE = 0.3  # of all cells, without which hills are meant
NOISE = 0.04  # noise of level ground, as a share of a cell, from which the smoothness of a fit mends more than it blurs
MOST_CERTAIN = 10.0  # factor by which less noisy heights are believed more, at most


@dataclass(frozen=True)
class DepthPrior:
    """Depth supervision on a grid.

    Attributes:
        height: ``[H, W]`` ellipsoidal heights [m]; NaN = none.
        confidence: ``[H, W]`` in [0, 1].
        grid: of all.
        normal: ``[H, W, 3]`` (east, north, up) of the surface that light falls on; None: that of the heights.
    """

    height: Tensor
    confidence: Tensor
    grid: Grid
    normal: Tensor | None = None

    @classmethod
    def from_arrays(cls, height: np.ndarray, confidence: np.ndarray, grid: Grid) -> DepthPrior:
        """A prior of maps ``[H, W]`` as `sattools.prior.files.read_prior` reads them: heights [m], confidence.

        Args:
            height: ``[H, W]`` [m].
            confidence: ``[H, W]`` in [0, 1].
            grid: of both.
        """
        return cls(torch.from_numpy(height), torch.from_numpy(confidence), grid)

    def on(self, grid: Grid, device: torch.device | None = None) -> DepthPrior:
        """The prior on another grid with the same upper left corner, on a device."""
        height, confidence = (
            torch.from_numpy(resize_map(m.numpy(), self.grid, grid)) for m in (self.height, self.confidence)
        )
        normal = None if self.normal is None else torch.from_numpy(sample_map(self.normal.numpy(), self.grid, grid))
        return DepthPrior(height, confidence, grid, normal).to(device or torch.device("cpu"))

    def to(self, device: torch.device) -> DepthPrior:
        """The same on a device."""
        normal = None if self.normal is None else self.normal.to(device)
        return DepthPrior(self.height.to(device), self.confidence.to(device), self.grid, normal)

    def median_height(self) -> float:
        """Median of the known heights [m]."""
        return float(np.nanmedian(self.height.numpy()))


def noise(height: np.ndarray) -> float:
    """Standard deviation of heights ``[H, W]`` [m] from their mean over 5 x 5 cells where it is level; NaN on hills.

    Level is what is lower than `LEVEL_M` from its lowest to its highest cell, plain slopes included; what is left of
    it is noise of the matching, and little else.
    """
    known = minimum_filter(np.isfinite(height), 5, mode="nearest")
    filled = np.where(np.isfinite(height), height, 0).astype(np.float64)
    relief = maximum_filter(filled, 5, mode="nearest") - minimum_filter(filled, 5, mode="nearest")
    level = known & (relief < LEVEL_M)
    if level.sum() < LEVEL_SHARE * max(known.sum(), 1):
        return math.nan
    return nmad((filled - uniform_filter(filled, 5, mode="nearest"))[level])


def certainty(prior: DepthPrior) -> float:
    """Factor of a prior's weight in the fit of a surface: 1 where its heights are noisy, more by their precision.

    The smoothness of a surface takes noise away, and parapets and crowns with it. Which of both is more is a matter of
    how noisy the heights are: of 8-bit images of many dates, or of three images, more than of many sharp ones.
    """
    spread = noise(prior.height.numpy()) / prior.grid.cell_size
    if math.isnan(spread):
        return 1.0
    return float(np.clip((NOISE / max(spread, 1e-6)) ** 2, 1.0, MOST_CERTAIN))


def depth_std_m(confidence: Tensor) -> Tensor:
    """Standard deviation of a prior's heights with a confidence in [0, 1], any shape [m]."""
    return BEST_STD_M + (WORST_STD_M - BEST_STD_M) * (1 - confidence) ** 2


def reference_height(prior: DepthPrior | None, z_range: tuple[float, float]) -> float:
    """Height [m] at which the views are resampled: the prior's median, or a guess of the ground within the range."""
    return prior.median_height() if prior else z_range[0] + GROUND_SHARE * (z_range[1] - z_range[0])


__all__ = ["DepthPrior", "certainty", "depth_std_m", "noise", "reference_height"]

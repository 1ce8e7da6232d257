"""Confidence of a matched height."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from sattools.prior.matching.match import Match

UNIQUENESS_SCALE = 0.3  # cost gap to the next best height at which this factor is 1 - 1/e
FULL_AGREEMENT = 0.9  # agreement of well-matched images
STEP_SCALE = 3.0  # height difference within the neighbourhood that halves the confidence [m]
NEIGHBOURHOOD = 5  # cells: about as far as matching smears a wall
ENOUGH_VIEWS = 3.0


def match_confidence(match: Match) -> np.ndarray:
    """Confidence of every cell, a product of four factors.

    They are the agreement of the images, the uniqueness of the best height (cost margin to the second best), the
    number of consistent views, and the distance from height steps, where a window shows two surfaces at once.

    Returns:
        ``[H, W]`` float32 in [0, 1]; 0 where fewer than two images see the surface and have the best place of their
        lines of sight there.
    """
    agreement = np.clip(match.score / FULL_AGREEMENT, 0.0, 1.0)
    unique = 1.0 - np.exp(-np.maximum(match.uniqueness, 0.0) / UNIQUENESS_SCALE)
    # one view alone sees no height; two can, but cannot contradict each other
    seen = 1.0 - np.exp(-np.maximum(match.consistent_views.astype(np.float32) - 1.0, 0.0) / (ENOUGH_VIEWS - 1.0))
    jump = maximum_filter(match.height, NEIGHBOURHOOD) - minimum_filter(match.height, NEIGHBOURHOOD)
    return (agreement * unique * seen / (1.0 + jump / STEP_SCALE)).astype(np.float32)


__all__ = ["match_confidence"]

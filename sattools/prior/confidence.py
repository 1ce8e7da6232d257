"""How far to trust a matched height."""

from __future__ import annotations

import numpy as np

from sattools.prior.match import Match

RIVAL_SCALE = 0.15  # cost gap to the next best height at which trust in it is 1 - 1/e
SCORE_RANGE = (0.3, 0.9)  # agreement of unrelated and of well-matched images
ENOUGH_VIEWS = 3.0


def confidence(match: Match) -> np.ndarray:
    """Product of three doubts: images disagree, another height is nearly as good, few images see the place.

    Returns:
        ``[H, W]`` float32 in [0, 1].
    """
    low, high = SCORE_RANGE
    agreement = np.clip((match.score - low) / (high - low), 0.0, 1.0)
    unique = 1.0 - np.exp(-np.maximum(match.rival, 0.0) / RIVAL_SCALE)
    # one view alone sees no height; two can, but cannot contradict each other
    seen = 1.0 - np.exp(-np.maximum(match.views.astype(np.float32) - 1.0, 0.0) / (ENOUGH_VIEWS - 1.0))
    return (agreement * unique * seen).astype(np.float32)


__all__ = ["confidence"]

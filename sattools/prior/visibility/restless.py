"""Places about which every pass of the matching finds something else, as woods: what hides what is not known there."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label, uniform_filter

CHANGE_M = 2.0  # by which heights of two passes differ
AROUND_M = 30.0  # edge of the square around a cell whose cells are asked
SHARE = 0.3  # of them that change: 0.04 to 0.12 in towns and on hills, 0.43 and more in woods, on water with waves
LEAST_M2 = 2500.0  # of such a place: smaller ones hide but little, and in towns they are chance


def restless(height: np.ndarray, before: np.ndarray, cell: float) -> np.ndarray:
    """Where a surface does not settle, ``[H, W]`` bool.

    A surface that is wrong hides what is right and shows what is wrong, and the next pass is wrong elsewhere.

    Args:
        height: ``[H, W]`` surface [m].
        before: ``[H, W]`` that of the pass before it [m].
        cell: edge of a cell [m].
    """
    changed = (np.abs(height - before) > CHANGE_M).astype(np.float32)
    size = 2 * round(AROUND_M / 2 / cell) + 1
    places, count = label(uniform_filter(changed, size, mode="nearest") > SHARE)
    large = np.bincount(places.ravel(), minlength=count + 1) * cell**2 >= LEAST_M2
    large[0] = False
    return np.asarray(large[places])


__all__ = ["restless"]

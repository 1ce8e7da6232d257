"""Errors by the slope of the reference. Pure functions of arrays, no I/O."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

STRIP_ROWS = 256  # of which slopes are known at a time
STEPS_DEG = (0.0, 5.0, 15.0, 30.0, 60.0, 90.0)


def slope_deg(heights: np.ndarray, cell_size: float) -> np.ndarray:
    """Slope ``[H, W]`` of a surface [degrees], by central differences; NaN where a neighbour is not known.

    Args:
        heights: ``[H, W]`` [m]; NaN = none.
        cell_size: edge of a cell [m].
    """
    if min(heights.shape) < 2:
        return np.full(heights.shape, np.nan)
    south, east = np.gradient(heights.astype(np.float64), cell_size)
    return np.asarray(np.degrees(np.arctan(np.hypot(south, east))))


def errors_by_slope(difference: np.ndarray, reference: np.ndarray, cell_size: float) -> list[dict[str, Any]]:
    """Figures of the errors in every range of slopes; ranges without a scored cell are left out.

    Args:
        difference: ``[H, W]`` prediction minus reference [m]; NaN = not scored.
        reference: ``[H, W]`` heights [m]; NaN = none.
        cell_size: edge of a cell [m].

    Returns:
        ``from_deg``, ``to_deg``, ``mae``, ``median`` (of the absolute errors) [m], ``n`` cells.
    """
    absolute = np.abs(difference)
    steps = _ranges(reference, cell_size)
    steps[~np.isfinite(absolute)] = 0
    found = []
    for number, (low, high) in enumerate(pairwise(STEPS_DEG), start=1):
        own = absolute[steps == number]
        if own.size:
            figures = {"mae": float(own.mean(dtype=np.float64)), "median": float(np.median(own)), "n": int(own.size)}
            found.append({"from_deg": low, "to_deg": high, **figures})
    return found


def _ranges(reference: np.ndarray, cell_size: float) -> np.ndarray:
    """Number of the range of slopes ``[H, W]`` uint8, from 1; 0 where none is known. By strips, to save memory."""
    height = len(reference)
    found = np.zeros(reference.shape, np.uint8)
    for first in range(0, height, STRIP_ROWS):
        last = min(first + STRIP_ROWS, height)
        start, end = max(0, first - 1), min(height, last + 1)
        slope = slope_deg(reference[start:end], cell_size)[first - start : last - start]
        number = np.searchsorted(STEPS_DEG, slope, side="right")
        found[first:last] = np.where(slope < STEPS_DEG[-1], number, 0)  # NaN compares false
    return found


__all__ = ["STEPS_DEG", "errors_by_slope", "slope_deg"]

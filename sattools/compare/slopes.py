"""Slopes of the reference, by which errors are told apart. Pure functions of arrays, no I/O."""

from __future__ import annotations

import numpy as np

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


def slope_ranges(reference: np.ndarray, cell_size: float) -> np.ndarray:
    """Number of the range of slopes ``[H, W]`` uint8, between two of `STEPS_DEG`, from 1; 0 where none is known.

    Args:
        reference: ``[H, W]`` heights [m]; NaN = none.
        cell_size: edge of a cell [m].
    """
    slope = slope_deg(reference, cell_size)
    number = np.searchsorted(STEPS_DEG, slope, side="right").astype(np.uint8)
    return np.where(slope < STEPS_DEG[-1], number, np.uint8(0))  # NaN compares false


__all__ = ["STEPS_DEG", "slope_deg", "slope_ranges"]

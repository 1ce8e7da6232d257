"""Errors beside height steps and away from them, about the median. Pure functions of arrays, no I/O.

The mean height difference is removed before a surface is scored, so errors beside steps that do not balance are paid by
every other cell, and errors that happen to balance look like accuracy. These figures tell the two apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

STEP_M = 3.0  # height range of 3 x 3 cells from which there is a step
NEAR_M = 2.0  # distance from a cell on a step within which a cell is beside it


def halo(cell_size: float) -> int:
    """Rows around a piece of a map on which `beside_steps` of it depends, and its slopes [cells]."""
    return 2 + _reach(cell_size)


def beside_steps(reference: np.ndarray, cell_size: float) -> np.ndarray:
    """Cells `[H, W]` bool within 2 m, along rows and columns, of a cell on a step of more than 3 m.

    On a step is a cell whose 3 x 3 neighbours differ by more than that. `reference` [H, W] in metres, NaN = not known,
    which makes no step; `cell_size` in metres.
    """
    from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter

    known = np.isfinite(reference)
    high = maximum_filter(np.where(known, reference, -np.inf), 3, mode="nearest")
    low = minimum_filter(np.where(known, reference, np.inf), 3, mode="nearest")
    on_step: np.ndarray = known & (high - low > STEP_M)
    cells = _reach(cell_size)
    if not cells or not on_step.any():
        return on_step
    near: np.ndarray = binary_dilation(on_step, iterations=cells)
    return near


def _reach(cell_size: float) -> int:
    return math.floor(NEAR_M * (1 + 1e-9) / cell_size)


def step_text(figures: Mapping[str, Any]) -> str:
    """The figures for people, one line."""
    near, away = figures["near_steps"], figures["away_from_steps"]
    text = f"about the median: MAE {figures['mae_centred']:.3f} m   each at most 5 m {figures['mae_capped_5m']:.3f} m"
    if near["share"]:
        text += f"   beside steps ({100 * near['share']:.0f} %) {near['signed']:+.3f}, |{near['absolute']:.3f}| m"
    if away["share"]:
        text += f"   away from them {away['signed']:+.3f}, |{away['absolute']:.3f}| m"
    return text


__all__ = ["beside_steps", "halo", "step_text"]

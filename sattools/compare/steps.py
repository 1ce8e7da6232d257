"""Errors beside height steps and away from them, about the median. Pure functions of arrays, no I/O.

The mean height difference is removed before a surface is scored, so errors beside steps that do not balance are paid by
every other cell, and errors that happen to balance look like accuracy. These figures tell the two apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from typing import Any

import numpy as np

from sattools.compare.metrics import CLASSES
from sattools.scene.jsonio import JsonObject

STEP_M = 3.0  # height range of 3 x 3 cells from which there is a step
NEAR_M = 2.0  # distance from a cell on a step within which a cell is beside it
CAP_M = 5.0  # largest error that counts in the capped mean


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
    cells = math.floor(NEAR_M * (1 + 1e-9) / cell_size)
    if not cells or not on_step.any():
        return on_step
    near: np.ndarray = binary_dilation(on_step, iterations=cells)
    return near


def step_errors(centred: np.ndarray, near: np.ndarray) -> JsonObject:
    """Figures of errors about the median `centred` [N] in metres, of which `near` [N] bool lie beside a step.

    `signed` and `absolute` are means in metres, None without cells; `share` is that of the cells.
    """
    absolute = np.abs(centred)

    def part(member: np.ndarray) -> dict[str, float | None]:
        if not member.any():
            return {"signed": None, "absolute": None, "share": 0.0 if member.size else None}
        return {
            "signed": float(centred[member].mean(dtype=np.float64)),
            "absolute": float(absolute[member].mean(dtype=np.float64)),
            "share": float(member.mean()),
        }

    return {
        "mae_centred": float(absolute.mean(dtype=np.float64)) if absolute.size else None,
        "mae_capped_5m": float(np.minimum(absolute, CAP_M).mean(dtype=np.float64)) if absolute.size else None,
        "near_steps": part(near),
        "away_from_steps": part(~near),
    }


def add_step_errors(
    figures: MutableMapping[str, Any],
    difference: np.ndarray,
    reference: np.ndarray,
    classes: np.ndarray | None,
    cell_size: float,
) -> None:
    """Add the figures of `step_errors` to an error table and to its classes.

    `difference` [H, W] is prediction minus reference in metres, NaN = not scored; `reference` [H, W] in metres;
    `classes` [H, W] codes or None; `cell_size` in metres. Errors of a class are about the median of all cells.

    Args:
        figures: error table, changed.
        difference: ``[H, W]`` prediction minus reference [m].
        reference: ``[H, W]`` heights [m]; NaN = none.
        classes: ``[H, W]`` class codes, or None.
        cell_size: edge of a cell [m].
    """
    scored = np.isfinite(difference)
    centred = difference - np.median(difference[scored])
    near = beside_steps(reference, cell_size)
    figures.update(step_errors(centred[scored], near[scored]))
    for name, own in figures.get("classes", {}).items():
        if classes is not None:
            member = scored & np.isin(classes, CLASSES[name])
            own |= step_errors(centred[member], near[member])


def step_text(figures: Mapping[str, Any]) -> str:
    """The figures for people, one line."""
    near, away = figures["near_steps"], figures["away_from_steps"]
    text = f"about the median: MAE {figures['mae_centred']:.3f} m   each at most 5 m {figures['mae_capped_5m']:.3f} m"
    if near["share"]:
        text += f"   beside steps ({100 * near['share']:.0f} %) {near['signed']:+.3f}, |{near['absolute']:.3f}| m"
    if away["share"]:
        text += f"   away from them {away['signed']:+.3f}, |{away['absolute']:.3f}| m"
    return text


__all__ = ["add_step_errors", "beside_steps", "step_errors", "step_text"]

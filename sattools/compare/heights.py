"""Error figures of registered heights. Functions of maps that are read by rows, no I/O."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from sattools.compare.holes import fill_holes
from sattools.compare.slopes import STEPS_DEG, slope_ranges
from sattools.compare.steps import beside_steps, halo
from sattools.compare.tally import ROUNDS, Steps, Tally
from sattools.errors import InputError
from sattools.scene.jsonio import JsonObject
from sattools.scene.stored import map_like, pieces

WATER = 9
CLASSES: dict[str, tuple[int, ...]] = {"ground": (2,), "trees": (5,), "buildings": (6,)}
"""Names of the classes scored on their own, and their codes in the class map (ASPRS LAS codes)."""

CLIP_M = 10.0  # beyond the reference's range: blunders of a registered surface count no more
FILL_METHOD = "nearest"
COUNTED, MEASURED, NEAR = 1, 2, 4  # bits of what is known of a cell; then two of its class, three of its slope
_CLASS, _SLOPE = 3, 5  # first of those

Rows = tuple[np.ndarray, np.ndarray, np.ndarray | None]
"""Of some rows ``[h, W]``: heights [m], NaN = none; the same with holes filled; which of them images show (bool)."""


def height_errors(
    predicted: np.ndarray,
    reference: np.ndarray,
    classes: np.ndarray | None = None,
    filled: np.ndarray | None = None,
    measured: np.ndarray | None = None,
    *,
    cell_size: float | None = None,
) -> JsonObject:
    """Error table of a registered prediction; all arrays [H, W] in metres, NaN = no height.

    Reference cells that are NaN or of class 9 (water) do not count. Errors are over cells with a prediction;
    `completeness`, `within_1m` and `within_2_5m` are shares of *all* counted reference cells, so a hole is never
    within. `completeness` counts cells that were `measured` (bool; default: that have a prediction), whose errors are
    in `measured`; `filled` has those of all counted cells with holes filled from `filled` (default: the nearest
    predicted cell), `mae_filled` their mean. With `cell_size`, errors beside steps and away from them (about the
    median of all cells, also by class) and errors by the slope of the reference (`slopes`: `from_deg`, `to_deg`,
    `mae`, `median`, `n`). Raises InputError where shapes differ or nothing can be compared.

    Args:
        predicted: ``[H, W]`` heights [m]; NaN = none.
        reference: ``[H, W]`` heights [m]; NaN = none.
        classes: ``[H, W]`` class codes, or None.
        filled: ``[H, W]`` the prediction without holes [m], or None.
        measured: ``[H, W]`` bool, cells that images show; None = all.
        cell_size: edge of a cell [m], for what lies beside steps and for slopes; None = without.
    """
    given = {"prediction": predicted, "class map": classes, "filled prediction": filled, "measured cells": measured}
    for name, array in given.items():
        if array is not None and array.shape != reference.shape:
            raise InputError(f"{name}: found shape {array.shape}, expected {reference.shape}")
    counted = np.isfinite(reference) if classes is None else np.isfinite(reference) & (classes != WATER)
    scored = np.where(counted, reference, np.nan).astype(np.float32)
    complete = fill_holes(np.asarray(predicted if filled is None else filled, np.float32))
    heights = np.asarray(predicted, np.float32)

    def of(rows: slice) -> Rows:
        return heights[rows], complete[rows], None if measured is None else measured[rows]

    return errors_of(of, scored, classes, cell_size)[0]


def errors_of(
    predicted: Callable[[slice], Rows],
    reference: np.ndarray,
    classes: np.ndarray | None,
    cell_size: float | None,
    *,
    limited: bool = True,
) -> tuple[JsonObject, np.ndarray]:
    """`height_errors` of maps that may be larger than memory, and prediction minus reference.

    Args:
        predicted: gives some rows of the registered prediction.
        reference: ``[H, W]`` heights [m]; NaN = not counted.
        classes: ``[H, W]`` class codes, or None.
        cell_size: see `height_errors`.
        limited: heights count to 10 m beyond the reference's. Not for those that nobody registered: another vertical
            datum would be cut to that.

    Returns:
        The table, and the differences ``[H, W]`` [m], limited as the table's are; NaN = not scored.

    Raises:
        InputError: nothing can be compared.
    """
    limits = _limits(reference) if limited else (-np.inf, np.inf)
    shape = (reference.shape[0], reference.shape[1])
    difference, everywhere = (map_like(reference, shape, np.float32) for _ in range(2))
    kind = map_like(reference, shape, np.uint8)
    for rows in pieces(shape):
        own = reference[rows]
        heights, complete, measured = predicted(rows)
        apart = np.clip(heights, *limits) - own
        difference[rows], everywhere[rows] = apart, np.clip(complete, *limits) - own
        about = np.isfinite(own) * np.uint8(COUNTED)
        known = np.isfinite(apart) if measured is None else np.isfinite(apart) & measured
        about |= known * np.uint8(MEASURED)
        if classes is not None:
            for number, codes in enumerate(CLASSES.values(), start=1):
                about |= np.isin(classes[rows], codes) * np.uint8(number << _CLASS)
        if cell_size is not None:
            about |= _shape_of(reference, rows, cell_size)
        kind[rows] = about
    table = Table(CLASSES if classes is not None else (), cell_size is not None)
    for round_ in range(ROUNDS):
        for rows in pieces(shape):
            table.add(round_, difference[rows], everywhere[rows], kind[rows])
        if not table.everything.count:
            raise InputError("prediction: found no height on a cell of the reference, expected at least one")
    return table.figures(), difference


def _limits(reference: np.ndarray) -> tuple[np.float32, np.float32]:
    """Heights [m] to which a prediction is limited: 10 m beyond the lowest and the highest of the reference."""
    low, high = np.float32(np.inf), np.float32(-np.inf)
    for rows in pieces((reference.shape[0], reference.shape[1])):
        part = reference[rows]
        known = part[np.isfinite(part)]
        if known.size:
            low, high = min(low, known.min()), max(high, known.max())
    if low > high:
        raise InputError("reference: found no height outside water, expected at least one")
    return np.float32(low - CLIP_M), np.float32(high + CLIP_M)


def _shape_of(reference: np.ndarray, rows: slice, cell_size: float) -> np.ndarray:
    """Bits ``[h, W]`` of some rows of the reference: beside a step, and the range of the slope."""
    spare = halo(cell_size)
    first, last = max(0, rows.start - spare), min(reference.shape[0], rows.stop + spare)
    around = reference[first:last]
    own = slice(rows.start - first, rows.stop - first)
    near = beside_steps(around, cell_size)[own]
    return near * np.uint8(NEAR) | slope_ranges(around, cell_size)[own] << np.uint8(_SLOPE)


class Table:
    """The error table, of pieces that are shown in `ROUNDS` rounds.

    Args:
        classes: names of the classes that are scored on their own, in the order of their numbers.
        shapes: whether cells beside steps and slopes are known.
    """

    def __init__(self, classes: Iterable[str], shapes: bool) -> None:
        self.everything, self._measured, self._filled = Tally(), Tally(), Tally()
        self._classes = {name: Tally() for name in classes}
        self._members = dict.fromkeys(self._classes, 0)
        self._slopes = [Tally() for _ in pairwise(STEPS_DEG)] if shapes else []
        self._steps = {name: Steps() for name in ("", *self._classes)} if shapes else {}
        self._counted = self._within_1m = self._within_2_5m = 0

    def add(self, round_: int, difference: np.ndarray, everywhere: np.ndarray, kind: np.ndarray) -> None:
        """Count a piece.

        Args:
            round_: 0, 1, 2 or 3.
            difference: ``[h, W]`` float32 [m]; NaN = not scored.
            everywhere: ``[h, W]`` float32, the same with holes filled; only counted cells matter.
            kind: ``[h, W]`` uint8, bits.
        """
        counted = (kind & COUNTED) > 0
        seen = np.isfinite(difference)
        errors, about = difference[seen], kind[seen]
        if round_ == 0:
            self._counted += int(counted.sum())
            self._within_1m += int((np.abs(errors) <= 1.0).sum())
            self._within_2_5m += int((np.abs(errors) <= 2.5).sum())
        self.everything.add(round_, errors)
        self._filled.add(round_, everywhere[counted])
        self._measured.add(round_, errors[(about & MEASURED) > 0])
        own = (about >> np.uint8(_CLASS)) & 3
        for number, (name, tally) in enumerate(self._classes.items(), start=1):
            tally.add(round_, errors[own == number])
            if round_ == 0:
                self._members[name] += int((counted & ((kind >> np.uint8(_CLASS)) & 3 == number)).sum())
        if round_ < 2:
            slope = about >> np.uint8(_SLOPE)
            for number, tally in enumerate(self._slopes, start=1):
                tally.add(round_, errors[slope == number])
        elif round_ == 2 and self._steps:
            self._add_steps(errors - np.float32(self.everything.centre), (about & NEAR) > 0, own)

    def _add_steps(self, centred: np.ndarray, near: np.ndarray, own: np.ndarray) -> None:
        for number, steps in enumerate(self._steps.values()):
            member = own == number if number else slice(None)
            steps.add(centred[member], near[member])

    def figures(self) -> JsonObject:
        """See `height_errors`."""
        total = self._counted
        filled = self._filled.figures()
        result: dict[str, Any] = self.everything.figures()
        result |= {
            "completeness": self._measured.count / total,
            "within_1m": self._within_1m / total,
            "within_2_5m": self._within_2_5m / total,
            "mae_filled": filled["mae"],
            "filled_by": FILL_METHOD,
            "cells": total,
            "cells_predicted": self.everything.count,
            "measured": {**self._measured.figures(), "n": self._measured.count},
            "filled": {**filled, "n": total},
        }
        if self._classes:
            result["classes"] = {name: self._class_figures(name) for name in self._classes}
        if self._steps:
            result |= self._steps[""].figures()
            result["slopes"] = _slope_rows(self._slopes)
        return result

    def _class_figures(self, name: str) -> JsonObject:
        tally, total = self._classes[name], self._members[name]
        found = {**tally.figures(), "n": tally.count, "completeness": tally.count / total if total else None}
        return found | (self._steps[name].figures() if self._steps else {})


def _slope_rows(tallies: Sequence[Tally]) -> list[JsonObject]:
    """Figures of the errors in every range of slopes; ranges without a scored cell are left out."""
    return [
        {"from_deg": low, "to_deg": high, "mae": found["mae"], "median": found["median"], "n": tally.count}
        for (low, high), tally in zip(pairwise(STEPS_DEG), tallies, strict=True)
        if tally.count and (found := tally.figures())
    ]


__all__ = ["CLASSES", "WATER", "Rows", "Table", "errors_of", "height_errors"]

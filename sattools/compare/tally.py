"""Figures of errors that are shown piece by piece: exact, in the memory of a piece.

Medians of numbers that are not held need them twice: which upper halves of their bits are how frequent, then the lower
halves of those in the middle. A spread about a median needs that median first, so errors are shown in four rounds.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sattools.scene.jsonio import JsonObject

ROUNDS = 4
CAP_M = 5.0  # largest error that counts in the capped mean
_HALF = 16  # bits
_SIGN = np.uint32(1 << 31)
_LOWER = np.uint32((1 << _HALF) - 1)
NO_ERRORS: dict[str, Any] = dict.fromkeys(("mae", "rmse", "median", "nmad", "bias"))


class Median:
    """Median of finite float32 numbers, which are shown once by `first` and once again by `again`, in any pieces."""

    def __init__(self) -> None:
        self._upper = np.zeros(1 << _HALF, np.int64)
        self._lower: dict[int, np.ndarray] = {}
        self._ranks: list[tuple[int, int]] = []  # upper half, and how many with it are smaller

    def first(self, values: np.ndarray) -> None:
        """Count numbers ``[N]``."""
        self._upper += np.bincount(_ordered(values) >> np.uint32(_HALF), minlength=1 << _HALF)

    def again(self, values: np.ndarray) -> None:
        """Count the same numbers ``[N]`` once more."""
        if not self._ranks:
            self._find()
        keys = _ordered(values)
        upper = keys >> np.uint32(_HALF)
        for wanted, counts in self._lower.items():
            own = keys[upper == wanted] & _LOWER
            counts += np.bincount(own, minlength=1 << _HALF)

    def value(self) -> float:
        """The median as `numpy.median` has it; NaN of nothing."""
        if not self._ranks:
            return math.nan
        found = []
        for upper, rank in self._ranks:
            lower = int(np.searchsorted(np.cumsum(self._lower[upper]), rank, side="right"))
            found.append(_number((upper << _HALF) | lower))
        return float(np.mean(np.array(found, np.float32)))

    def _find(self) -> None:
        upto = np.cumsum(self._upper)
        count = int(upto[-1])
        for rank in sorted({(count - 1) // 2, count // 2}) if count else ():
            upper = int(np.searchsorted(upto, rank, side="right"))
            self._ranks.append((upper, rank - int(upto[upper] - self._upper[upper])))
            self._lower.setdefault(upper, np.zeros(1 << _HALF, np.int64))


def _ordered(values: np.ndarray) -> np.ndarray:
    """Bits ``[N]`` uint32 of float32 numbers, in their order."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)


def _number(key: int) -> float:
    bits = np.uint32(key)
    return float(np.asarray(bits & ~_SIGN if bits & _SIGN else ~bits, np.uint32).view(np.float32))


class Part:
    """Mean errors of some of the cells."""

    def __init__(self) -> None:
        self.count, self.signed, self.absolute = 0, 0.0, 0.0

    def add(self, errors: np.ndarray) -> None:
        """Count errors ``[N]`` [m]."""
        self.count += errors.size
        self.signed += float(errors.sum(dtype=np.float64))
        self.absolute += float(np.abs(errors).sum(dtype=np.float64))

    def figures(self, total: int) -> dict[str, float | None]:
        """Means [m] and the share of all the cells."""
        if not self.count:
            return {"signed": None, "absolute": None, "share": 0.0 if total else None}
        return {
            "signed": self.signed / self.count,
            "absolute": self.absolute / self.count,
            "share": self.count / total,
        }


class Steps:
    """Errors about a median, beside steps and away from them."""

    def __init__(self) -> None:
        self.near, self.away, self._capped = Part(), Part(), 0.0

    def add(self, centred: np.ndarray, near: np.ndarray) -> None:
        """Count errors ``[N]`` [m] about the median, of which some are beside a step."""
        self.near.add(centred[near])
        self.away.add(centred[~near])
        self._capped += float(np.minimum(np.abs(centred), CAP_M).sum(dtype=np.float64))

    def figures(self) -> JsonObject:
        """See `sattools.compare.steps.step_errors`."""
        count = self.near.count + self.away.count
        absolute = self.near.absolute + self.away.absolute
        return {
            "mae_centred": absolute / count if count else None,
            "mae_capped_5m": self._capped / count if count else None,
            "near_steps": self.near.figures(count),
            "away_from_steps": self.away.figures(count),
        }


class Tally:
    """Figures of the errors of some cells; the same pieces are shown in `ROUNDS` rounds, without a spread in two."""

    def __init__(self) -> None:
        self.count = 0
        self._total = self._absolute = self._square = 0.0
        self._median, self._middle, self._spread = Median(), Median(), Median()
        self._centre: float | None = None

    def add(self, round_: int, errors: np.ndarray) -> None:
        """Count errors ``[N]`` float32 [m]; rounds are 0, 1, 2, 3."""
        if not errors.size:
            return
        if round_ == 0:
            exact = errors.astype(np.float64)
            self.count += errors.size
            self._total += float(exact.sum())
            self._absolute += float(np.abs(exact).sum())
            self._square += float(exact @ exact)
        if round_ < 2:
            for median, values in ((self._median, np.abs(errors)), (self._middle, errors)):
                (median.again if round_ else median.first)(values)
            return
        spread = np.abs(errors - np.float32(self.centre))
        (self._spread.first if round_ == 2 else self._spread.again)(spread)

    @property
    def centre(self) -> float:
        """Median of the errors [m], known from the third round on."""
        if self._centre is None:
            self._centre = self._middle.value()
        return self._centre

    def figures(self) -> JsonObject:
        """`mae`, `rmse`, `median` (of the absolute errors), `nmad`, `bias` [m]; None without cells."""
        if not self.count:
            return dict(NO_ERRORS)
        return {
            "mae": self._absolute / self.count,
            "rmse": math.sqrt(self._square / self.count),
            "median": self._median.value(),
            "nmad": 1.4826 * self._spread.value(),
            "bias": self._total / self.count,
        }


__all__ = ["CAP_M", "NO_ERRORS", "ROUNDS", "Median", "Part", "Steps", "Tally"]

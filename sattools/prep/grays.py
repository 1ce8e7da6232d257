"""Grey values as `prep` looks at them: of a size to calculate with."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.float32]
SMALL = 1e-3  # images that reach no further are multiplied: squares of what is less vanish in single precision


def of_size_one(gray: Gray) -> Gray:
    """Grey values times a power of two, if all are small; which it is does not matter to what they are compared by.

    Args:
        gray: ``[H, W]``; NaN = missing.
    """
    largest = float(np.nanmax(np.abs(gray), initial=0.0))
    return gray if largest >= SMALL or largest == 0 else np.ldexp(gray, -math.frexp(largest)[1])


__all__ = ["of_size_one"]

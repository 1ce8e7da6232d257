"""Grey values as `prep` looks at them: without single pixels that are missing, and of a size to calculate with."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.float32]
# Holes of so few pixels are single ones that are missing, not a frame, a cloud or water. They are filled where they are
# so many that hardly a neighbourhood of a feature (17 x 17 pixels) is without any: fewer do no harm
HOLE_PX = 24
MANY = 0.005  # of the pixels
FILL_PX = 1.0  # sigma of the mean of known neighbours
SMALL = 1e-3  # images that reach no further are multiplied: squares of what is less vanish in single precision


def without_holes(gray: Gray) -> Gray:
    """Grey values with those of single missing pixels from their neighbours, if there are many.

    Args:
        gray: ``[H, W]``; NaN = missing.
    """
    import cv2

    missing = ~np.isfinite(gray)
    if missing.sum() <= MANY * missing.size:
        return gray
    _, label, stats, _ = cv2.connectedComponentsWithStats(missing.view(np.uint8), connectivity=8)
    size = stats[:, cv2.CC_STAT_AREA]
    size[0] = missing.size  # what is there
    if size[size <= HOLE_PX].sum() <= MANY * missing.size:
        return gray
    weight = cv2.GaussianBlur((~missing).astype(np.float32), (0, 0), FILL_PX)
    total = cv2.GaussianBlur(np.where(missing, np.float32(0), gray), (0, 0), FILL_PX)
    holes = (size <= HOLE_PX)[label] & (weight > 0.01)
    return np.where(holes, total / np.maximum(weight, np.float32(0.01)), gray)


def of_size_one(gray: Gray) -> Gray:
    """Grey values times a power of two, if all are small; which it is does not matter to what they are compared by.

    Args:
        gray: ``[H, W]``; NaN = missing.
    """
    largest = float(np.nanmax(np.abs(gray), initial=0.0))
    return gray if largest >= SMALL or largest == 0 else np.ldexp(gray, -math.frexp(largest)[1])


__all__ = ["of_size_one", "without_holes"]

"""Single pixels that are missing: where they are many, they get numbers from their neighbours, to be matched by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Holes of so few pixels are single ones that are missing, not a frame, a cloud or water. They are filled where they are
# many: fewer do no harm to the windows of matching. A feature's neighbourhood is 17 x 17 pixels, of which one in 20
# lacks a pixel where 0.0002 do, two in three where 0.004 do
HOLE_PX = 24
MANY, MANY_FOR_FEATURES = 0.005, 0.0002  # of the pixels
FILL_PX = 1.0  # sigma of the mean of known neighbours
LEAST_WEIGHT = 0.01  # of neighbours that are known


def without_holes(image: NDArray[np.float32], many: float = MANY) -> NDArray[np.float32]:
    """An image with numbers for its single missing pixels from their neighbours, if there are many of them.

    Args:
        image: ``[H, W]`` or ``[C, H, W]`` float32; a pixel that is not finite in a band is missing.
        many: share of the pixels from which on they are filled.

    Returns:
        The image itself where there are few, else a copy; numbers that are known stay as they are.
    """
    import cv2

    bands = image.reshape(-1, *image.shape[-2:])
    missing: NDArray[np.bool_] = ~np.asarray(np.isfinite(bands).all(axis=0))
    if missing.sum() <= many * missing.size:
        return image
    _, label, stats, _ = cv2.connectedComponentsWithStats(missing.view(np.uint8), connectivity=8)
    size = stats[:, cv2.CC_STAT_AREA]
    size[0] = missing.size  # what is there
    if size[size <= HOLE_PX].sum() <= many * missing.size:
        return image
    weight = cv2.GaussianBlur((~missing).astype(np.float32), (0, 0), FILL_PX)
    holes = (size <= HOLE_PX)[label] & (weight > LEAST_WEIGHT)
    weight = np.maximum(weight, np.float32(LEAST_WEIGHT))
    filled = np.empty_like(bands)
    for own, band in zip(filled, bands, strict=True):
        total = cv2.GaussianBlur(np.where(missing, np.float32(0), band), (0, 0), FILL_PX)
        own[:] = np.where(holes & ~np.isfinite(band), total / weight, band)
    return filled.reshape(image.shape)


__all__ = ["MANY_FOR_FEATURES", "without_holes"]

"""What is small and high and stands alone: trees, above all.

A tree is seen against the ground behind it by every view but the steepest, its leaves move and fall, and half of it is
rim. So of its cells a third, or a half, do not stand by themselves (see `consistency`), and were they filled from the
ground around, it would be a post. What smears a roof over the ground beside it looks just like that, but hangs on the
roof. So what is narrow and has ground all around is judged as a whole.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label, maximum, mean

from sattools.prior.visibility.occlusion import erode

WIDTH_M = 6.0  # wider things are found without it
HIGHER_M = 2.0  # above the surface without narrow things
HIGHEST_M = 25.0  # higher ones are corners of towers and what matching finds by chance between them
FEWEST_CELLS = 3  # along that width, without which no tree has a shape
LEAST_M2 = 4.0  # smaller ones are corners of roofs, which an opening cuts off, too
SHARE = 0.5  # of the views that see it, in the mean over its cells, have their best place there


def stands_alone(height: np.ndarray, agreeing: np.ndarray, views: np.ndarray, cell: float) -> np.ndarray:
    """Cells ``[H, W]`` bool of narrow, high things that half of the views or more agree about.

    Args:
        height: ``[H, W]`` float32 [m].
        agreeing: ``[H, W]`` views that have their best place there.
        views: ``[H, W]`` views that see it.
        cell: edge of a cell [m].
    """
    if cell > WIDTH_M / FEWEST_CELLS:
        return np.zeros(height.shape, bool)
    radius = round(WIDTH_M / 2 / cell)
    without = -erode(-erode(height, radius), radius)
    higher = height - without
    thing, count = label(higher > HIGHER_M, np.ones((3, 3)))
    every = np.arange(1, count + 1)
    area = np.bincount(thing.ravel(), minlength=count + 1)[1:] * cell**2
    share = mean(agreeing / np.maximum(views, 1), thing, every)
    stays = (area >= LEAST_M2) & (share >= SHARE) & (maximum(higher, thing, every) <= HIGHEST_M)
    return np.asarray(np.concatenate([[False], stays])[thing])


__all__ = ["stands_alone"]

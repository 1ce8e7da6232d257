"""Views of a known surface, painted plane by plane."""

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from sattools.prior.frame import Frame
from sattools.prior.matching.match import margin_for

RANGE = (-4.0, 16.0)
CELL = 0.5


def views_of(height: Any, slopes: Any, seed: Any = 0) -> Any:
    """A frame of a surface with noise for texture, each view rendered from the top downward so that walls hide."""
    rng = np.random.default_rng(seed)
    slopes = np.array(slopes)
    margin = margin_for(slopes, 0.0, RANGE, 2)
    wide = np.pad(height, margin, mode="edge")
    texture = gaussian_filter(rng.normal(0, 1, wide.shape), 0.8) * 0.3 + 0.5
    rows, cols = np.indices(wide.shape).astype(float)
    images = []
    for slope in slopes:
        image = np.full(wide.shape, 0.5)
        for z in np.arange(RANGE[0], RANGE[1], 0.05):  # higher planes paint over lower ones
            at = [rows - slope[0] * z, cols - slope[1] * z]
            solid = map_coordinates(wide, at, order=0, mode="nearest") >= z - 0.025
            image = np.where(solid, map_coordinates(texture, at, order=1, mode="nearest"), image)
        images.append(image)
    stack = np.stack(images).astype(np.float32)
    return Frame(stack, np.ones(stack.shape, np.uint8), slopes, 0.0, CELL, margin, (None,) * len(stack))


def by_cell(volume: Any) -> Any:
    """The twin's order of axes, [H, W, D], for a volume [H, D, W], or back."""
    return np.ascontiguousarray(np.swapaxes(volume, 1, 2))

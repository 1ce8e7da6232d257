"""Views of a known surface, painted plane by plane."""

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from sattools.prior.frame import Frame
from sattools.prior.matching.match import margin_for

RANGE = (-4.0, 16.0)
CELL = 0.5


def moved(values: Any, row: float, col: float, reach: int) -> Any:
    """Values as they lie (row, col) cells further down and to the right, bilinear; ``values``: wider by ``reach``."""
    height, width = (length - 2 * reach for length in values.shape)
    top, left = reach + int(np.floor(-row)), reach + int(np.floor(-col))
    down, right = -row - np.floor(-row), -col - np.floor(-col)
    corners = [values[top + r : top + r + height, left + c : left + c + width] for r in (0, 1) for c in (0, 1)]
    weights = [r * c for r in (1 - down, down) for c in (1 - right, right)]
    return sum(weight * corner for weight, corner in zip(weights, corners))


def views_of(height: Any, slopes: Any, seed: Any = 0) -> Any:
    """A frame of a surface with noise for texture, each view rendered from the top downward so that walls hide."""
    rng = np.random.default_rng(seed)
    slopes = np.array(slopes)
    margin = margin_for(slopes, 0.0, RANGE, 2)
    wide = np.pad(height, margin, mode="edge")
    texture = gaussian_filter(rng.normal(0, 1, wide.shape), 0.8) * 0.3 + 0.5
    reach = 2 + int(np.ceil(np.abs(slopes).max(initial=0) * np.abs(RANGE).max()))
    around, painted = np.pad(wide, reach, mode="edge"), np.pad(texture, reach, mode="edge")
    images = []
    for slope in slopes:
        image = np.full(wide.shape, 0.5)
        for z in np.arange(RANGE[0], RANGE[1], 0.05):  # higher planes paint over lower ones
            row, col = slope * z
            solid = moved(around, np.floor(row + 0.5), np.floor(col + 0.5), reach) >= z - 0.025  # the nearest cell's
            image = np.where(solid, moved(painted, row, col, reach), image)
        images.append(image)
    stack = np.stack(images).astype(np.float32)
    return Frame(stack, np.ones(stack.shape, np.uint8), slopes, 0.0, CELL, margin, (None,) * len(stack))


def by_cell(volume: Any) -> Any:
    """The twin's order of axes, [H, W, D], for a volume [H, D, W], or back."""
    return np.ascontiguousarray(np.swapaxes(volume, 1, 2))

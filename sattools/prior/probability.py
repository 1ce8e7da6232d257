"""How probable it is that a matched height is right to a metre, and how far off it may be."""

from __future__ import annotations

import math

import numpy as np

LIMIT_M = 1.0
USUAL_CELL_M = 0.5
MEANING = "less than 1 m of error"
METHOD = "logistic curve over the confidence of matching; its weights are from simulated scenes"
NAMES = ("1", "confidence", "its square root", "log2 of the cell over 0.5 m")
# found by benchmarks/probability.py on simulated scenes, see docs/lab/accuracy.md
WEIGHTS = (-1.025, 3.642, 5.506, -0.7286)
# logarithms [m] of what 68.3 % and 95.4 % of the errors stay below, on the same features and scenes
STD_WEIGHTS = (2.317, 2.600, -8.718, 0.7217)
ERROR95_WEIGHTS = (4.355, 0.753, -8.572, 0.5921)
STD_MEANING = "68 % of the heights are less than this off; errors have long tails, see the 95 % map"
ERROR95_MEANING = "95 % of the heights are less than this off"
ERROR_METHOD = "quantiles of the error given the confidence of matching; weights are from simulated scenes"


def features(confidence: np.ndarray, cell: float) -> np.ndarray:
    """What the probability depends on.

    Relief around the cell, its step and whether no image agrees are in the confidence already: they change nothing.

    Args:
        confidence: ``[H, W]`` of matching, 0 ... 1; NaN = unknown.
        cell: edge of a cell [m].

    Returns:
        ``[H, W, 4]`` float32, see `NAMES`.
    """
    size = np.full_like(confidence, math.log2(cell / USUAL_CELL_M))
    parts = [np.ones_like(confidence), confidence, np.sqrt(np.maximum(confidence, 0)), size]
    return np.stack(parts, axis=-1).astype(np.float32)


def from_features(parts: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Probability ``[...]`` of features ``[..., K]``: a logistic curve over their weighted sum."""
    return np.asarray(1 / (1 + np.exp(-(parts @ np.asarray(weights, np.float32)))))


def height_probability(confidence: np.ndarray, cell: float) -> np.ndarray:
    """Probability that a height is less than 1 m off.

    Args:
        confidence: ``[H, W]`` of matching, 0 ... 1; NaN = unknown.
        cell: edge of a cell [m].

    Returns:
        ``[H, W]`` float32; NaN where the confidence is unknown.
    """
    return from_features(features(confidence, cell), np.array(WEIGHTS)).astype(np.float32)


def height_errors(confidence: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """What 68 % and 95 % of the heights are less off by.

    The distribution of errors is no normal one: most heights are right to a decimetre and few are off by metres, so
    the second is three to five times the first, not twice.

    Args:
        confidence: ``[H, W]`` of matching, 0 ... 1; NaN = unknown.
        cell: edge of a cell [m].

    Returns:
        Both ``[H, W]`` float32 [m]; NaN where the confidence is unknown.
    """
    parts = features(confidence, cell)
    std, error95 = (np.exp(parts @ np.asarray(of, np.float32)) for of in (STD_WEIGHTS, ERROR95_WEIGHTS))
    return std.astype(np.float32), error95.astype(np.float32)


__all__ = [
    "ERROR95_MEANING", "ERROR95_WEIGHTS", "ERROR_METHOD", "LIMIT_M", "MEANING", "METHOD", "NAMES", "STD_MEANING",
    "STD_WEIGHTS", "WEIGHTS", "features", "from_features", "height_errors", "height_probability",
]  # fmt: skip

"""How probable it is that a matched height is right to a metre."""

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


__all__ = ["LIMIT_M", "MEANING", "METHOD", "NAMES", "WEIGHTS", "features", "from_features", "height_probability"]

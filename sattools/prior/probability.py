"""How probable it is that a matched height is right to a metre, and how far off it may be."""

from __future__ import annotations

import json
import math
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter, uniform_filter

LIMIT_M = 1.0
USUAL_CELL_M = 0.5
MEANING = "less than 1 m of error"
METHOD = "small network over the confidence of matching and the relief around; its weights are from simulated scenes"
NAMES = (
    "root of the confidence", "its mean within 1 m", "its mean within 4.5 m", "off the mean height within 2.5 m",
    "relief within 3 m", "above the lowest within 6 m", "standard deviation of the heights within 2 m",
    "log2 of the cell over 0.5 m",
)  # fmt: skip
STD_MEANING = "68 % of the heights are less than this off; errors have long tails, see the 95 % map"
ERROR95_MEANING = "95 % of the heights are less than this off"
ERROR_METHOD = "quantiles of the error by the network of the probability"
SHARES = (0.683, 0.954)  # of the errors, below the two bounds
LEAST_M = 0.02  # is added to an error before its logarithm is taken
# of the windows: confidence, far around, mean height, relief, lowest height, standard deviation
WIDTHS_M = (2.0, 9.0, 5.0, 6.0, 12.0, 4.0)
LOWEST_OF_M = 2.0  # width of the means of which the lowest is taken
# Where no cell within 4.5 m has any confidence, heights are guesses, however level: at most so probable, at least so
# far off [m] (in the mean of eight sets of images with such places 0.34 are right, bounds are 11 and 39 m)
FAR, GUESSED = 2, (0.3, 10.0, 40.0)
BEYOND = 3.0  # standard deviations of a feature on the scenes of the fit: further out it counts as that far


def margin(cell: float) -> int:
    """Cells around a part of a map that its features depend on.

    Args:
        cell: edge of a cell [m].
    """
    return max(_window(width, cell) // 2 for width in WIDTHS_M) + _window(LOWEST_OF_M, cell) // 2


def features(height: np.ndarray, confidence: np.ndarray, cell: float) -> np.ndarray:
    """What the probability depends on.

    Args:
        height: ``[H, W]`` matched [m]; NaN = unknown.
        confidence: ``[H, W]`` of matching, 0 ... 1; NaN = unknown.
        cell: edge of a cell [m].

    Returns:
        ``[H, W, 8]`` float32, see `NAMES`; lengths as the logarithm of one metre more.
    """
    sure, far, around, relief, low, spread = (_window(width, cell) for width in WIDTHS_M)
    known = np.isfinite(height)
    level = float(np.median(height[known])) if known.any() else 0.0
    z = height.astype(np.float64) - level  # float64: squares of heights are taken
    if not known.all():  # an unknown height is no step
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        z = z[tuple(nearest)] if known.any() else np.zeros_like(z)
    root = np.sqrt(np.maximum(np.nan_to_num(confidence), 0)).astype(np.float64)
    lowest = minimum_filter(uniform_filter(z, _window(LOWEST_OF_M, cell), mode="nearest"), low, mode="nearest")
    lengths = (
        np.abs(z - uniform_filter(z, around, mode="nearest")),
        maximum_filter(z, relief, mode="nearest") - minimum_filter(z, relief, mode="nearest"),
        np.maximum(z - lowest, 0),
        _deviation(z, spread),
    )
    size = np.full_like(z, math.log2(cell / USUAL_CELL_M))
    trust = [root, *(uniform_filter(root, width, mode="nearest") for width in (sure, far))]
    trust[FAR][maximum_filter(root, far, mode="nearest") == 0] = 0  # running sums leave something behind
    parts = [*trust, *(np.log1p(length) for length in lengths), size]
    return np.stack(parts, axis=-1).astype(np.float32)


def from_features(parts: np.ndarray, network: dict[str, Any] | None = None) -> tuple[np.ndarray, ...]:
    """Probability and both bounds of the error [m], ``[...]`` float32 each, of features ``[..., K]``.

    Args:
        parts: see `features`.
        network: as `the_network`, which is taken where there is none.
    """
    network = network or the_network()
    x = np.clip((parts - network["mean"]) / network["std"], -BEYOND, BEYOND).astype(np.float32)
    *hidden, last = network["layers"]
    for weights, bias in hidden:
        x = np.maximum(x @ weights + bias, 0)
    x = x @ last[0] + last[1]
    probability = 1 / (1 + np.exp(-x[..., 0]))
    std = np.maximum(np.exp(x[..., 1]) - LEAST_M, LEAST_M)
    error95 = np.maximum(np.exp(x[..., 2]) - LEAST_M, std)
    guessed = parts[..., FAR] <= 0
    most, *least = GUESSED
    bounds = (np.where(guessed, np.maximum(e, low), e) for e, low in zip((std, error95), least, strict=True))
    return np.where(guessed, np.minimum(probability, most), probability), *bounds


def height_doubt(
    height: np.ndarray, confidence: np.ndarray, cell: float, span: float = math.inf
) -> tuple[np.ndarray, ...]:
    """Probability that a height is less than 1 m off, and what 68 % and 95 % of such heights are less off by.

    The distribution of errors is no normal one: most heights are right to a decimetre and few are off by metres, so
    the second bound is three to five times the first, not twice.

    Args:
        height: ``[H, W]`` matched [m]; NaN = unknown.
        confidence: ``[H, W]`` of matching, 0 ... 1; NaN = unknown.
        cell: edge of a cell [m].
        span: of the heights that were looked at, within which the right one lies, too: no height is further off [m].

    Returns:
        Probability, and both bounds [m], ``[H, W]`` float32 each; NaN where height or confidence are unknown.
    """
    probability, *bounds = from_features(features(height, confidence, cell))
    found = (probability, *(np.minimum(bound, np.float32(span)) for bound in bounds))
    unknown = ~(np.isfinite(height) & np.isfinite(confidence))
    return tuple(np.where(unknown, np.float32(np.nan), values.astype(np.float32)) for values in found)


@cache
def the_network() -> dict[str, Any]:
    """``mean`` and ``std`` ``[K]`` of the features, and ``layers``: weights ``[in, out]`` and bias ``[out]`` of each.

    Found by ``benchmarks/probability.py`` on simulated scenes, see docs/lab/accuracy.md.
    """
    text = files("sattools.prior").joinpath("probability.json").read_text(encoding="utf-8")
    return arrays(json.loads(text))


def arrays(stored: dict[str, Any]) -> dict[str, Any]:
    """A network with arrays, of one with lists."""
    layers = [tuple(np.asarray(part, np.float32) for part in (one["weights"], one["bias"])) for one in stored["layers"]]
    return {name: np.asarray(stored[name], np.float32) for name in ("mean", "std")} | {"layers": layers}


def _window(width: float, cell: float) -> int:
    """Cells of a window, an odd number: so many metres, but at least three cells."""
    return max(3, round(width / cell) | 1)


def _deviation(z: np.ndarray, window: int) -> np.ndarray:
    mean = uniform_filter(z, window, mode="nearest")
    return np.sqrt(np.maximum(uniform_filter(z * z, window, mode="nearest") - mean * mean, 0))


__all__ = [
    "ERROR95_MEANING", "ERROR_METHOD", "LEAST_M", "LIMIT_M", "MEANING", "METHOD", "NAMES", "SHARES", "STD_MEANING",
    "arrays", "features", "from_features", "height_doubt", "margin", "the_network",
]  # fmt: skip

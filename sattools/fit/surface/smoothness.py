"""Smoothness of the height map that leaves steps and planes alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sattools.fit.losses import tone

CONTRAST = 0.04  # tone-mapped step at which the weight of a neighbour falls to 1/e
LEAST = 0.05  # smallest weight
NOISE_M = 0.1  # differences below it are noise


@dataclass(frozen=True)
class EdgeWeights:
    """Edge-aware weights of neighbours in (0, 1]: down the rows ``[H - 1, W]``, along the columns ``[H, W - 1]``."""

    down: Tensor
    along: Tensor


def edge_weights(albedo: Tensor) -> EdgeWeights:
    """Small weights where the albedo changes, large ones within a uniform surface.

    Heights step where colours step (a roof's rim), while a plain roof shows the renderer nothing to hold on to.

    Args:
        albedo: ``[H, W, C]`` linear.
    """
    toned = tone(albedo.detach())

    def weights_along(axis: int) -> Tensor:
        step = toned.diff(dim=axis).abs().amax(-1)
        return LEAST + (1 - LEAST) * torch.exp(-step / CONTRAST)

    return EdgeWeights(weights_along(0), weights_along(1))


def charbonnier(x: Tensor) -> Tensor:
    """sqrt(x^2 + s^2) - s [m] of differences [m], s = `NOISE_M`: quadratic below it, linear above."""
    return torch.sqrt(x * x + NOISE_M * NOISE_M) - NOISE_M


def concave(x: Tensor, knee: float) -> Tensor:
    """Knee * log(1 + charbonnier(x) / knee): above the knee a large step costs little more than a small one.

    Many middling steps cost more than one wall of the same height, so slopes between two levels steepen into walls.

    Args:
        x: differences [m].
        knee: above which they cost little more [m].
    """
    linear = charbonnier(x)
    return linear if math.isinf(knee) else knee * torch.log1p(linear / knee)


def smoothness_penalty(
    height: Tensor,
    cell_size: float,
    weights: EdgeWeights | None = None,
    *,
    first: float = 0.3,
    knee: float = 1.0,
) -> Tensor:
    """Mean robust first and second differences of a height map, in metres.

    Second differences vanish on tilted planes (roofs, slopes); the slow growth of `concave` lets walls be.

    Args:
        height: ``[H, W]`` [m].
        cell_size: [m]; the sum of differences along a line does not depend on the grid.
        weights: of neighbours, see `edge_weights`, or None = all 1.
        first: weight of first differences; that of second ones is 1.
        knee: [m] above which a step costs little more; infinite = linear growth.
    """
    total = height.new_zeros(())
    for axis in (0, 1):
        d1 = height.diff(dim=axis)
        one, two = concave(d1, knee), concave(d1.diff(dim=axis), knee)
        if weights is not None:
            w = weights.down if axis == 0 else weights.along
            one = w * one
            n = w.shape[axis] - 1
            two = torch.minimum(w.narrow(axis, 0, n), w.narrow(axis, 1, n)) * two
        total = total + first * one.mean() + two.mean()
    return total / cell_size


__all__ = ["EdgeWeights", "charbonnier", "concave", "edge_weights", "smoothness_penalty"]

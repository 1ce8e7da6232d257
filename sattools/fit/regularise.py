"""Smoothness of the height map that leaves steps and planes alone."""

from __future__ import annotations

import torch
from torch import Tensor


def charbonnier(x: Tensor, scale: float) -> Tensor:
    """sqrt(x^2 + scale^2) - scale: quadratic below the scale, linear above."""
    return torch.sqrt(x * x + scale * scale) - scale


def roughness(height: Tensor, cell_size: float, first: float = 0.3, second: float = 1.0, scale: float = 0.1) -> Tensor:
    """Mean robust first and second differences of a height map, in metres.

    Second differences vanish on tilted planes (roofs, slopes); the linear growth lets walls be.

    Args:
        height: ``[H, W]`` [m].
        cell_size: [m]; the differences are those over one metre, so that the weight means the same on every grid.
        first: weight of first differences.
        second: weight of second differences.
        scale: [m] below which differences are noise.
    """
    total = height.new_zeros(())
    for axis in (0, 1):
        d1 = height.diff(dim=axis)
        total = total + first * charbonnier(d1, scale).mean()
        total = total + second * charbonnier(d1.diff(dim=axis), scale).mean()
    return total / cell_size


__all__ = ["charbonnier", "roughness"]

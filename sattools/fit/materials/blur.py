"""Gaussian blur of maps, compiled for processors: torch takes eight times as long for the way back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sattools.compiled import njit, spread


def gaussian_taps(sigma: float, like: Tensor) -> Tensor:
    """Weights ``[2 R + 1]`` of a Gaussian out to three sigma, in cells; their sum is 1."""
    radius = max(1, math.ceil(3 * sigma))
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, dtype=like.dtype, device=like.device) / sigma) ** 2)
    return taps / taps.sum()


def plain_blurred(maps: Tensor, sigma: float) -> Tensor:
    """`blurred` by torch's convolutions, on any device: the readable twin."""
    taps = gaussian_taps(sigma, maps)
    radius = len(taps) // 2
    rows, cols = maps.shape[-2:]
    flat = torch.nn.functional.pad(maps.reshape(-1, 1, rows, cols), (radius,) * 4, mode="replicate")
    flat = torch.nn.functional.conv2d(flat, taps.reshape(1, 1, -1, 1))
    return torch.nn.functional.conv2d(flat, taps.reshape(1, 1, 1, -1)).reshape(maps.shape)


def blurred(maps: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of maps ``[..., H, W]``, sigma in cells; beyond the edge the nearest cell goes on."""
    if maps.device.type != "cpu":
        return plain_blurred(maps, sigma)
    value: Tensor = _Blur.apply(maps.reshape(-1, *maps.shape[-2:]).contiguous(), gaussian_taps(sigma, maps))
    return value.reshape(maps.shape)


class _Blur(torch.autograd.Function):
    """Along both axes, one after the other; the reverse is the transposed sums in the opposite order."""

    @staticmethod
    def forward(ctx: Any, maps: Tensor, taps: Tensor) -> Tensor:
        """Maps ``[M, H, W]``."""
        ctx.taps = taps
        middle, out = torch.empty_like(maps), torch.empty_like(maps)
        _down(maps.detach().numpy(), taps.numpy(), middle.numpy(), False)
        _across(middle.numpy(), taps.numpy(), out.numpy(), False)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Of the maps."""
        grad = grads[0].contiguous()
        middle, out = torch.empty_like(grad), torch.empty_like(grad)
        _across(grad.numpy(), ctx.taps.numpy(), middle.numpy(), True)
        _down(middle.numpy(), ctx.taps.numpy(), out.numpy(), True)
        return out, None


# Cell by cell: sums of whole rows are the same to the bit, and take numba ten seconds to compile in place of one.
@spread(lambda maps, *_: maps.shape[0] * maps.shape[1])
@njit(cache=True, nogil=True)
def _down(maps, taps, out, back, first, end):
    """Weighted sums of rows, for some rows of the result; `back`: transposed."""
    rows, cols, radius = maps.shape[1], maps.shape[2], len(taps) // 2
    for line in range(first, end):
        m, row = line // rows, line % rows
        for col in range(cols):
            out[m, row, col] = 0
        if back:
            for other in range(max(0, row - radius), min(rows, row + radius + 1)):
                # an edge row is read in place of all beyond it
                low = 0 if row == 0 else row - other + radius
                high = 2 * radius if row == rows - 1 else row - other + radius
                weight = taps[low]
                for k in range(low + 1, high + 1):
                    weight += taps[k]
                for col in range(cols):
                    out[m, row, col] += weight * maps[m, other, col]
        else:
            for k in range(len(taps)):
                weight, other = taps[k], min(max(row + k - radius, 0), rows - 1)
                for col in range(cols):
                    out[m, row, col] += weight * maps[m, other, col]


@spread(lambda maps, *_: maps.shape[0] * maps.shape[1])
@njit(cache=True, nogil=True)
def _across(maps, taps, out, back, first, end):
    """Weighted sums along some rows; `back`: transposed."""
    rows, cols, radius = maps.shape[1], maps.shape[2], len(taps) // 2
    wide = np.empty(cols + 2 * radius, maps.dtype)
    for line in range(first, end):
        source, total = maps[line // rows, line % rows], out[line // rows, line % rows]
        if back:
            for col in range(len(wide)):
                wide[col] = 0
            for k in range(len(taps)):
                weight = taps[k]
                for col in range(cols):
                    wide[k + col] += weight * source[col]
            for col in range(cols):
                total[col] = wide[radius + col]
            total[0] += _sum(wide, 0, radius)
            total[cols - 1] += _sum(wide, radius + cols, len(wide))
        else:
            for col in range(len(wide)):
                wide[col] = source[min(max(col - radius, 0), cols - 1)]
            for col in range(cols):
                total[col] = 0
            for k in range(len(taps)):
                weight = taps[k]
                for col in range(cols):
                    total[col] += weight * wide[k + col]


@njit
def _sum(values, first, end):
    """Of one or more, in their own precision."""
    found = values[first]
    for k in range(first + 1, end):
        found += values[k]
    return found


__all__ = ["blurred", "gaussian_taps", "plain_blurred"]

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


@spread(lambda maps, *_: maps.shape[0] * maps.shape[1])
@njit(cache=True, nogil=True)
def _down(maps, taps, out, back, first, end):
    """Weighted sums of rows, for some rows of the result; `back`: transposed."""
    rows, radius = maps.shape[1], len(taps) // 2
    for line in range(first, end):
        m, row = line // rows, line % rows
        total = out[m, row]
        total[:] = 0
        if back:
            for other in range(max(0, row - radius), min(rows, row + radius + 1)):
                # an edge row is read in place of all beyond it
                low = 0 if row == 0 else row - other + radius
                high = 2 * radius if row == rows - 1 else row - other + radius
                weight = taps[low]
                for k in range(low + 1, high + 1):
                    weight += taps[k]
                total += weight * maps[m, other]
        else:
            for k in range(len(taps)):
                total += taps[k] * maps[m, min(max(row + k - radius, 0), rows - 1)]


@spread(lambda maps, *_: maps.shape[0] * maps.shape[1])
@njit(cache=True, nogil=True)
def _across(maps, taps, out, back, first, end):
    """Weighted sums along some rows; `back`: transposed."""
    rows, cols, radius = maps.shape[1], maps.shape[2], len(taps) // 2
    wide = np.empty(cols + 2 * radius, maps.dtype)
    for line in range(first, end):
        source, total = maps[line // rows, line % rows], out[line // rows, line % rows]
        if back:
            wide[:] = 0
            for k in range(len(taps)):
                wide[k : k + cols] += taps[k] * source
            total[:] = wide[radius : radius + cols]
            total[0] += wide[:radius].sum()
            total[cols - 1] += wide[radius + cols :].sum()
        else:
            wide[:radius], wide[radius : radius + cols], wide[radius + cols :] = source[0], source, source[cols - 1]
            total[:] = 0
            for k in range(len(taps)):
                total += taps[k] * wide[k : k + cols]


__all__ = ["blurred", "gaussian_taps", "plain_blurred"]

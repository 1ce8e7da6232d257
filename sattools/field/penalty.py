"""What changed columns cost the neural field: value and gradient in one pass on a CPU; `plain_penalty` is the twin."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sattools.compiled import FASTMATH, njit
from sattools.field.kernels import ONE, sigmoid

STAY, EDGES = 2e-3, 1e-3  # weights of changed parts, of the length of edges


def plain_penalty(presence: Tensor, half: Tensor, optical: Tensor) -> Tensor:
    """The penalty, unitless: parts that are no more, new ones as far as they hide, edges.

    Args:
        presence: ``[2, H, W]`` logits of the shares, counted from `half`.
        half: ``[2, H, W]`` logits at which half of the light passes.
        optical: ``[2, H, W]`` depths of the parts where they are solid, unitless.
    """
    present = torch.sigmoid(presence)
    edges = present.diff(dim=1).abs().mean() + present.diff(dim=2).abs().mean()
    lower, upper = torch.sigmoid(presence + half)
    changed = (1 - lower).mean() - torch.expm1(-upper * optical[1]).mean()
    return STAY * changed / 2 + EDGES * edges


@njit(fastmath=FASTMATH)
def _steps(present, of_down, of_across, grad):
    """Sums of the steps between rows and between columns; their signs times weights are added to the gradient."""
    rows, cols = present.shape
    down, across = 0.0, 0.0
    for r in range(rows):
        for c in range(cols):
            if r + 1 < rows and present[r + 1, c] != present[r, c]:
                step = present[r + 1, c] - present[r, c]
                slope = of_down if step > 0 else -of_down
                down += abs(step)
                grad[r + 1, c] += slope
                grad[r, c] -= slope
            if c + 1 < cols and present[r, c + 1] != present[r, c]:
                step = present[r, c + 1] - present[r, c]
                slope = of_across if step > 0 else -of_across
                across += abs(step)
                grad[r, c + 1] += slope
                grad[r, c] -= slope
    return down, across


@njit(fastmath=FASTMATH, cache=True, nogil=True)
def _penalty(presence, half, optical, weights, grad):
    """The penalty; `grad` [2, H, W], zeros, is filled. weights: of a changed part, of a step of a row, of a column."""
    of_part, of_down, of_across = weights
    _, rows, cols = presence.shape
    present, total = np.empty((rows, cols), np.float32), 0.0
    for k in range(2):
        for r in range(rows):
            for c in range(cols):
                present[r, c] = sigmoid(presence[k, r, c])
        down, across = _steps(present, of_down, of_across, grad[k])
        total += of_down * down + of_across * across
        for r in range(rows):
            for c in range(cols):
                share = sigmoid(presence[k, r, c] + half[k, r, c])
                slope = share * (ONE - share) * of_part
                grad[k, r, c] *= present[r, c] * (ONE - present[r, c])
                if k == 0:
                    total += of_part * (ONE - share)
                    grad[k, r, c] -= slope
                else:
                    through = np.float32(math.exp(-share * optical[r, c]))
                    total += of_part * (ONE - through)
                    grad[k, r, c] += slope * optical[r, c] * through
    return total


class Penalty(torch.autograd.Function):
    """The same as `plain_penalty`, with gradients of `presence` alone."""

    @staticmethod
    def forward(ctx: Any, presence: Tensor, half: Tensor, optical: Tensor) -> Tensor:
        """See `plain_penalty`, unitless."""
        _, rows, cols = presence.shape
        grad = np.zeros(presence.shape, np.float32)
        counts = (2 * rows * cols / STAY, 2 * (rows - 1) * cols / EDGES, 2 * rows * (cols - 1) / EDGES)
        arrays = (t.detach().contiguous().numpy() for t in (presence, half, optical[1]))
        value = _penalty(*arrays, tuple(np.float32(1 / count) for count in counts), grad)
        ctx.grad = torch.from_numpy(grad)
        return presence.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        """Gradient of the logits of shares, unitless."""
        return ctx.grad * grads[0], None, None


__all__ = ["EDGES", "STAY", "Penalty", "plain_penalty"]

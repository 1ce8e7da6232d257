"""Adam on a CPU for tensors of which most values are never reached: they are moved where something has come by.

Where no gradient has ever been, Adam's moments are 0 and so is its step. `torch.optim.Adam` is the twin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sattools.compiled import FASTMATH, njit
from sattools.render.columns import BLOCK, BlockGradient

FORGOTTEN = 1e-25  # moments below which they are 0: such steps are none, and such numbers take a hundred times as long


@njit(fastmath=FASTMATH)
def _move(values, grad, mean, square, keep, scale):
    """One step of a block's values."""
    least = np.float32(FORGOTTEN)
    for i in range(len(values)):
        g = grad[i]
        m = mean[i] + keep[1] * (g - mean[i])
        v = square[i] * keep[2] + keep[3] * g * g
        m = m if abs(m) > least else np.float32(0.0)
        v = v if v > least * np.float32(1e-10) else np.float32(0.0)
        mean[i], square[i] = m, v
        values[i] -= scale[0] * m / (np.sqrt(v) * scale[1] + scale[2])


@njit(fastmath=FASTMATH, cache=True, nogil=True)
def _move_blocks(values, gradient, moments, touched, keep, scale):
    mean, square = moments
    for block in range(len(touched)):
        if touched[block]:
            i = slice(block * BLOCK, min((block + 1) * BLOCK, len(values)))
            _move(values[i], gradient[i], mean[i], square[i], keep, scale)


class BlockAdam:
    """Adam's steps of one tensor, in place.

    Args:
        tensor: ``[K, ...]``, unbounded, dense in memory.
        group: of `torch.optim.Adam`, with ``lr``, ``betas`` and ``eps``.
        state: of it: ``step``, and ``exp_avg`` and ``exp_avg_sq`` that lie as the tensor; begun where it is empty.
        gradient: of the tensor, as it lies in memory; None: the one that automatic differentiation has left there.
    """

    def __init__(
        self,
        tensor: Tensor,
        group: Mapping[str, Any],
        state: MutableMapping[str, Any],
        gradient: BlockGradient | None = None,
    ) -> None:
        self.tensor, self.group, self.state, self.gradient = tensor, group, state, gradient
        self.touched = np.ones(math.ceil(tensor.numel() / BLOCK), np.uint8) if gradient is None else gradient.touched
        self.lying: list[np.ndarray] = []

    def _begin(self) -> None:
        if not self.state:
            self.state["step"] = torch.zeros((), device="cpu")
            self.state.update({name: torch.zeros_like(self.tensor).detach() for name in ("exp_avg", "exp_avg_sq")})
        self.lying = [flat(one) for one in (self.tensor, self.state["exp_avg"], self.state["exp_avg_sq"])]
        begun = (self.lying[1] != 0) | (self.lying[2] != 0)  # where an interrupted fit had been
        self.touched[np.add.reduceat(begun, np.arange(0, len(begun), BLOCK)) > 0] = 1

    def step(self) -> None:
        """Do one, if there is a gradient."""
        if self.gradient is not None:
            slopes = self.gradient.values.reshape(-1)
        elif self.tensor.grad is not None:
            slopes = flat(torch.empty_like(self.tensor).copy_(self.tensor.grad).detach())
        else:
            return
        if not self.lying:
            self._begin()
        self.state["step"] += 1
        step, (first, second) = int(self.state["step"]), self.group["betas"]
        keep = first, 1 - first, second, 1 - second
        scale = self.group["lr"] / (1 - first**step), 1 / math.sqrt(1 - second**step), self.group["eps"]
        values, mean, square = self.lying
        factors = (np.array(some, np.float32) for some in (keep, scale))
        _move_blocks(values, slopes, (mean, square), self.touched, *factors)


def flat(tensor: Tensor) -> np.ndarray:
    """The unbounded values of a tensor, dense in memory, in the order in which they lie there."""
    return torch.as_strided(tensor.detach(), (tensor.numel(),), (1,)).numpy()


__all__ = ["BlockAdam", "flat"]

"""Adam on the CPU for tensors of which most values are never reached: what was never touched is not looked at.

Where no gradient has ever been, Adam's moments are 0 and so is its step. `torch.optim.Adam` is the twin.
"""

from __future__ import annotations

import math
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
def _move_blocks(values, gradient, mean, square, touched, keep, scale):
    for block in range(len(touched)):
        if touched[block]:
            i = slice(block * BLOCK, min((block + 1) * BLOCK, len(values)))
            _move(values[i], gradient[i], mean[i], square[i], keep, scale)


def move(tensor: Tensor, gradient: BlockGradient, state: dict[str, Any], group: dict[str, Any]) -> None:
    """One step of Adam, in place.

    Args:
        tensor: ``[K, ...]`` of any unit, with its first axis innermost in memory.
        gradient: of it.
        state: of Adam: ``step``, and ``exp_avg`` and ``exp_avg_sq`` that lie as the tensor; begun where it is empty.
        group: of Adam: ``lr``, ``betas``, ``eps``.
    """
    if not state:
        state |= {"step": torch.zeros((), device="cpu")}
        state |= {name: torch.zeros_like(tensor).detach() for name in ("exp_avg", "exp_avg_sq")}
    state["step"] += 1
    step, (first, second) = int(state["step"]), group["betas"]
    scale = group["lr"] / (1 - first**step), 1 / math.sqrt(1 - second**step), group["eps"]
    _move_blocks(
        flat(tensor), gradient.values.reshape(-1), flat(state["exp_avg"]), flat(state["exp_avg_sq"]), gradient.touched,
        tuple(np.float32(x) for x in (first, 1 - first, second, 1 - second)), tuple(np.float32(x) for x in scale),
    )  # fmt: skip


def mark(gradient: BlockGradient, state: dict[str, Any]) -> None:
    """Count as touched what has moments of Adam."""
    for name in ("exp_avg", "exp_avg_sq"):
        some = flat(state[name])
        first = np.arange(0, len(some), BLOCK)
        gradient.touched[np.add.reduceat(some != 0, first) > 0] = 1


def flat(tensor: Tensor) -> np.ndarray:
    """The values ``[...]`` of a tensor ``[K, ...]`` of any unit as they lie in memory, its first axis innermost."""
    values = tensor.detach().movedim(0, -1)
    return values.view(-1).numpy()


__all__ = ["flat", "mark", "move"]

"""Evaluation in blocks: elementwise work on arrays that stay in the processor's cache."""

from __future__ import annotations

import torch
from torch import Tensor

# elements for each thread: PyTorch gives a thread no less than this, and about forty such arrays fit its caches
BLOCK = 65536


class Blocks:
    """Cuts a broadcast shape along its longest axis, and operands of any broadcastable shape alike.

    Args:
        shape: the broadcast shape of all operands (without the axis of vectors).
        whole: one block only (accelerators, where launching costs more than memory).
    """

    def __init__(self, shape: tuple[int, ...], whole: bool) -> None:
        self.shape = shape
        size = 1
        for length in shape:
            size *= length
        limit = BLOCK * torch.get_num_threads()
        if whole or size <= limit:
            self.axis, self.ranges = -1, [(0, shape[-1] if shape else 1)]
            return
        longest = max(range(len(shape)), key=lambda k: shape[k])
        self.axis = longest - len(shape)
        length = shape[longest]
        step = max(1, limit * length // size)
        self.ranges = [(start, min(step, length - start)) for start in range(0, length, step)]

    def is_cut(self, operand: Tensor, trailing: int = 0) -> bool:
        """Whether the operand differs from block to block; a bool."""
        axis = self.axis - trailing
        return len(self.ranges) > 1 and operand.ndim >= -axis and operand.shape[axis] > 1

    def cut(self, operand: Tensor, block: tuple[int, int], trailing: int = 0) -> Tensor:
        """The part of an operand that takes part in a block (a view).

        Args:
            operand: tensor, broadcastable.
            block: first and last row.
            trailing: number of axes that are not cut.
        """
        return operand.narrow(self.axis - trailing, *block) if self.is_cut(operand, trailing) else operand

"""Blocks of cells that count as independent of each other, and what is typical of them."""

from __future__ import annotations

import torch
from torch import Tensor

BLOCK = 8  # cells


def typical(values: Tensor, block: Tensor, *, strayed: bool = False) -> tuple[float, float]:
    """Median over blocks of each block's median, and its standard error from the blocks' spread.

    Where values may have ``strayed`` to one side only, the mean of the shortest half of the blocks' medians instead
    (Rousseeuw and Leroy 1988), which is where most of them lie.

    A phase function shows in every cell of a material. Wrong heights show in some places, but strongly, and their
    parallax drifts with the view as a phase function does: flattened relief moves bright slopes and dark ones towards
    each other, so that even its mean is not 0. A mean over cells would take that for reflectance.
    """
    medians = torch.stack([values[block == b].median() for b in torch.unique(block)])
    middle = medians.median()
    found = shortest_half(medians) if strayed else middle
    spread = 1.4826 * float((medians - middle).abs().median())  # of a normal distribution's standard deviation
    return float(found), 1.2533 * spread / len(medians) ** 0.5  # sqrt(pi / 2): of a median


def shortest_half(values: Tensor) -> Tensor:
    """Mean of those that lie closest together, half of ``[N]``; of several such halves the lowest."""
    ordered = values.sort().values
    count = len(ordered) // 2 + 1
    first = int((ordered[count - 1 :] - ordered[: len(ordered) - count + 1]).argmin())
    return ordered[first : first + count].mean()


def blocks_of(shape: tuple[int, int]) -> Tensor:
    """Number of the `BLOCK` x `BLOCK` block of every cell of a grid, flat; neighbours differ in parity along rows."""
    rows = torch.arange(shape[0])[:, None] // BLOCK
    cols = torch.arange(shape[1])[None] // BLOCK
    width = int(cols.max()) + 1
    width += 1 - width % 2
    return (rows * width + cols).reshape(-1)


__all__ = ["BLOCK", "blocks_of", "shortest_half", "typical"]

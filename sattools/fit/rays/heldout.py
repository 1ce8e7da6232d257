"""Rays that a field is not trained on, which say whether its heights are better than those it started from."""

from __future__ import annotations

import torch
from torch import Tensor

BLOCK_M = 8.0  # edge of what is held out together in an image: neighbouring pixels know each other's colours
ONE_IN = 10  # of the blocks is held out
STANDARD_ERRORS = 2.0  # as of reflectance models
LEAST_GAIN = 0.01  # share of the held-out error that changed heights must take away


def held_out(place: Tensor, view: Tensor) -> Tensor:
    """Whether rays are held out ``[R]``: all those of one block of an image in ten, wherever they are asked for.

    Args:
        place: ``[R, 2]`` (east, north) of the rays at one height [m].
        view: ``[R]`` numbers of the images.
    """
    return block_of(place, view) % ONE_IN == 0


def block_of(place: Tensor, view: Tensor) -> Tensor:
    """Numbers ``[R]`` of the blocks that rays belong to, scattered (Teschner et al. 2003); arguments as `held_out`'s.

    Args:
        place: ``[R, 2]`` [m].
        view: ``[R]``.
    """
    east, north = torch.floor(place / BLOCK_M).long().unbind(dim=1)
    mixed = (east * 73856093) ^ (north * 19349663) ^ (view.long() * 83492791)
    for _ in range(2):  # small numbers have small products
        mixed = ((mixed ^ (mixed >> 15)) * 0x2C1B3C6D) & 0x7FFFFFFF
    return mixed ^ (mixed >> 13)


def verdict(trained: Tensor, start: Tensor, block: Tensor) -> tuple[bool, str]:
    """Whether a field's heights explain held-out rays better than those it started from, and the words for it.

    Args:
        trained: ``[R]`` losses with the field's heights.
        start: ``[R]`` losses with the heights that it started from.
        block: ``[R]`` blocks of the rays, which count as independent of each other.
    """
    numbers, where = torch.unique(block, return_inverse=True)
    if len(numbers) < 2:
        return False, "no image has enough blocks of rays to hold some out; kept the heights it started from"
    gains = torch.zeros(len(numbers), dtype=torch.float64, device=where.device)
    gains = gains.index_add(0, where, (start - trained).double()) / torch.bincount(where)
    gain, error, before = float(gains.mean()), float(gains.std()) / len(numbers) ** 0.5, float(start.double().mean())
    better = gain > STANDARD_ERRORS * error and gain > LEAST_GAIN * before
    share = 100 / max(before, 1e-12)
    return better, (
        f"its heights change the error of held-out rays by {-share * gain:+.1f} % "
        f"(standard error {share * error:.1f} %): " + ("took them" if better else "kept those it started from")
    )


__all__ = ["ONE_IN", "block_of", "held_out", "verdict"]

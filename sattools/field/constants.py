"""Numbers as tensors that are made once: to bring them to a GPU waits for it, and a recorded step cannot wait."""

from __future__ import annotations

import functools

import torch
from torch import Tensor


def constant(values: tuple[float, ...], like: Tensor) -> Tensor:
    """Numbers ``[K]`` as a tensor of the type and on the device of another; not to be written to.

    Args:
        values: K of them.
        like: any shape.
    """
    return _made(values, like.dtype, like.device)


@functools.cache  # without a limit, as a recorded step goes on reading the memory that it has met
def _made(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)


__all__ = ["constant"]

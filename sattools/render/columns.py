"""Rays through the columns of the neural field on a CPU: field, compositing and shadows in one pass.

What `RayTrainer.predict` asks the field, `composite` and `towards_sun` for, one after the other and sample by sample,
is done here ray by ray by compiled kernels; that is the readable twin, and what other devices run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sattools.compiled import at_once
from sattools.field.kernels import CHUNKS, frame_of, frame_within, packed
from sattools.field.neural import NeuralField
from sattools.render import column_kernels as kernels
from sattools.render.column_kernels import BLOCK

COUNTER = {"forward": 0}  # samples of rays that were followed, of those to the sun too


@dataclass(frozen=True)
class ColumnRays:
    """Rays of several views and where to look along them.

    Attributes:
        places: ``[R, 2]`` (east, north) where they are at the height `top` [m].
        paths: ``[R, 3]`` from there to the lowest height [m].
        suns: ``[R, 3]`` unit vectors; all is lit where one is not above the horizon.
        free, near: ``[R, S]`` shares of the path in [0, 1], the free ones ascending.
        up: ``[R, S]`` shares of the way from the surface to the height `top` towards the sun; none: all is lit.
        top: highest height [m].
        skip: heights that the way to the sun has crossed when it begins [m].
    """

    places: Tensor
    paths: Tensor
    suns: Tensor
    free: Tensor
    near: Tensor
    up: Tensor
    top: float
    skip: float


@dataclass(frozen=True)
class BlockGradient:
    """Gradient of a tensor ``[K, ...]``, most of whose values no ray comes by.

    Attributes:
        values: ``[..., K]``, in the tensor's inverse units; what is in other blocks than touched ones is 0.
        touched: whether something was ever added to one of `BLOCK` values that follow each other, as 0 or 1.
    """

    values: np.ndarray
    touched: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, tensor: Tensor) -> BlockGradient:
        """An empty one of an unbounded tensor ``[K, ...]``."""
        shape = (*tensor.shape[1:], tensor.shape[0])
        return cls(np.zeros(shape, np.float32), np.zeros(math.ceil(tensor.numel() / BLOCK), np.uint8))

    def clear(self) -> None:
        """Take everything out of it."""
        kernels.clear(self.values.reshape(-1), self.touched)


def follow(columns: NeuralField, rays: ColumnRays, gradients: Sequence[BlockGradient]) -> tuple[Tensor, Tensor]:
    """Colours ``[R, C]`` that rays see, in [0, 1], and the visibility of the sun ``[R]`` in [0, 1] where they end.

    Gradients reach the shares of the columns as always. Those of the field's other tensors are added to ``gradients``,
    as nearly all of them are 0.

    Args:
        columns: the field, on the CPU.
        rays: to follow, in metres.
        gradients: of the colours of columns and of every grid of colours, in this order.
    """
    COUNTER["forward"] += len(rays.places) * (rays.free.shape[1] + rays.near.shape[1] + rays.up.shape[1])
    colour, visible = _Followed.apply(columns.presence + columns.half, columns, rays, gradients)
    return colour, visible


class _Followed(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, logits: Tensor, columns: NeuralField, rays: ColumnRays, gradients: Sequence[BlockGradient]
    ) -> Any:
        maps, shades = packed(torch.cat([columns.heights, logits])), [packed(columns.colour)]
        shades += [packed(grid) for grid in columns.grids]
        flat = [values.reshape(-1) for values in shades]
        frame = frame_of(columns.box, *logits.shape[1:])
        frames = (frame, *(frame_within(columns.box, values.shape[:3]) for values in shades[1:]))
        softness, bands = np.float32(columns.base.softness), columns.bands
        count, samples = len(rays.places), (rays.free.shape[1] + rays.near.shape[1], rays.up.shape[1])
        seen = np.empty((count, bands), np.float32), np.empty(count, np.float32)
        records = (
            np.empty((count * samples[0] + 1, kernels.COLOUR + 4 * bands), np.float32),
            np.empty((count * samples[1] + 1, kernels.SUN_RECORD), np.float32),
        )
        counts = np.empty((count, 2), np.int32)
        lines = tuple(t.contiguous().numpy() for t in (rays.places, rays.paths, rays.suns))
        kernels.follow(
            (*lines, np.float32(rays.top), np.float32(rays.skip)),
            tuple(t.contiguous().numpy() for t in (rays.free, rays.near, rays.up)),
            (maps.reshape(-1), frame, maps.shape, softness),
            (flat[0], tuple(flat[1:]), frames, shades[0].shape, tuple(values.shape for values in shades[1:])),
            seen, records, counts, (0,) * bands,
        )  # fmt: skip
        ctx.kept = records, counts, samples, softness, frames, seen[1], gradients
        return torch.from_numpy(seen[0]), torch.from_numpy(seen[1])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        records, counts, samples, softness, frames, visible, gradients = ctx.kept
        ctx.kept = None  # the records become gradients, once
        bands = (0,) * grads[0].shape[1]
        of_seen = tuple(grad.contiguous().numpy() for grad in grads)
        kernels.go_back(of_seen, visible, softness, records, counts, samples, bands)
        of_shares = np.zeros((*gradients[0].values.shape[:2], 2), np.float32)
        ends = [_ends(counts[:, kind], samples[kind]) for kind in range(2)]

        def shares() -> None:
            for kind in range(2):
                kernels.add_shares(records[kind], ends[kind], frames[0], of_shares.shape, of_shares.reshape(-1))

        def colours(gradient: BlockGradient, frame: np.ndarray) -> None:
            add = kernels.add_colours if gradient is gradients[0] else kernels.add_volume
            flat = gradient.values.reshape(-1)
            add(records[0], ends[0], frame, gradient.values.shape, flat, gradient.touched, bands)

        at_once(*(partial(colours, *one) for one in zip(gradients, frames, strict=True)), shares)
        return torch.from_numpy(of_shares).movedim(-1, 0), None, None, None


def _ends(counts: np.ndarray, samples: int) -> np.ndarray:
    """First record of every chunk and the one after its last, ``[CHUNKS, 2]``."""
    bounds = [chunk * len(counts) // CHUNKS for chunk in range(CHUNKS + 1)]
    first = np.array(bounds[:-1]) * samples
    total = [int(counts[a:b].sum()) for a, b in pairwise(bounds)]
    return np.stack([first, first + total], axis=1)


__all__ = ["BLOCK", "COUNTER", "BlockGradient", "ColumnRays", "follow"]

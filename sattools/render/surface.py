"""Rendering of the surface field: compiled on the CPU, plain torch elsewhere."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sattools.camera.view_direction import ViewDirection
from sattools.render.reference import render_planes
from sattools.render.view import ParallelRays, Quadrature


def render(
    height: Tensor,
    colour: Tensor,
    rays: ParallelRays,
    quadrature: Quadrature,
    cell_size: float,
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Composite a view of the surface; differentiable in height and colour.

    Args:
        height: ``[H, W]`` float32 [m], row 0 = north; all finite.
        colour: ``[H, W, C]`` float32, the radiance that leaves each cell towards this view.
        rays: parallel rays, one per cell.
        quadrature: softness and sampling.
        cell_size: [m].
        mask: ``[H, W]`` uint8, 0 = ray not wanted (its outputs are 0).

    Returns:
        rgb ``[H, W, C]``, depth ``[H, W]`` [m] (sum of weight times height), opacity ``[H, W]``.

    Raises:
        ValueError: maps of other shapes.
    """
    if height.ndim != 2 or colour.ndim != 3 or colour.shape[:2] != height.shape:
        raise ValueError(
            f"colour: found shape {tuple(colour.shape)} with heights {tuple(height.shape)}, expected "
            "[H, W, C] with [H, W]"
        )
    if mask is not None and mask.shape != height.shape:
        raise ValueError(f"mask: found shape {tuple(mask.shape)}, expected {tuple(height.shape)}")
    if height.device.type != "cpu":
        outputs = render_planes(height, colour, rays, quadrature, cell_size)
        if mask is None:
            return outputs
        keep = mask.to(height.dtype)
        return outputs[0] * keep[..., None], outputs[1] * keep, outputs[2] * keep
    return _Compiled.apply(height, colour, rays, quadrature, cell_size, mask)


class _Compiled(torch.autograd.Function):
    """March rays in a numba kernel; the backward pass marches again instead of storing every sample."""

    @staticmethod
    def forward(
        ctx: Any, height: Tensor, colour: Tensor, rays: ParallelRays, q: Quadrature, cell: float, mask: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        from sattools.compiled import chunk_count
        from sattools.render import blocks, kernels

        h = np.ascontiguousarray(height.detach().numpy(), dtype=np.float32)
        c = np.ascontiguousarray(colour.detach().numpy(), dtype=np.float32)
        keep = np.ones(h.shape, np.uint8) if mask is None else np.ascontiguousarray(mask.numpy())
        maps = np.empty((h.shape[0], blocks.COLOUR + c.shape[2], blocks.packed_width(h.shape[1])), np.float32)
        blocks.pack(h, c, maps)
        sampling = _sampling(rays, q, cell, float(h.max()))
        absorb = blocks.absorption(q.step / q.softness)
        rgb, depth, opacity = np.empty_like(c), np.empty_like(h), np.empty_like(h)
        spans = np.empty((h.shape[0], -(-h.shape[1] // blocks.LANES), 2), np.int32)
        arguments = (maps, sampling, absorb, keep, chunk_count(h.size), rgb, depth, opacity, spans)
        COUNTER["forward"] += int(_call(kernels.march, arguments))
        ctx.arguments = arguments
        return torch.from_numpy(rgb), torch.from_numpy(depth), torch.from_numpy(opacity)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        from sattools.render import kernels

        given = [np.ascontiguousarray(g.numpy(), dtype=np.float32) for g in grads]  # of rgb, depth, opacity
        height, colour = np.empty_like(given[1]), np.empty_like(given[0])
        _call(kernels.march_backward, (*ctx.arguments, *given, height, colour))
        return torch.from_numpy(height), torch.from_numpy(colour), None, None, None, None


# field samples evaluated by the compiled path, for benchmarks/throughput.py
COUNTER = {"forward": 0}


def _call(kernel: Any, arguments: tuple) -> Any:
    """Call a compiled kernel (the type checker knows nothing of its arguments)."""
    return kernel(*arguments)


def _sampling(rays: ParallelRays, q: Quadrature, cell: float, highest: float) -> Any:
    """`blocks.Sampling` of a view over a surface that is nowhere above `highest` [m]."""
    from sattools.render import blocks

    # nothing to see above the highest surface; whole steps, so that the samples stay where they would have been
    skipped = max(0, math.floor((q.z_top - (highest + blocks.EMPTY * q.softness)) / q.step))
    rows, columns = ViewDirection(*rays.slope).in_cells(cell)
    return blocks.Sampling(
        offset_x=np.float32(rays.offset[0] / cell),
        offset_y=np.float32(-rays.offset[1] / cell),  # rows run south
        slope_x=np.float32(columns),
        slope_y=np.float32(rows),
        z_ref=np.float32(rays.z_ref),
        z_top=np.float32(q.z_top - skipped * q.step),
        step=np.float32(q.step),
        softness=np.float32(q.softness),
        planes=max(0, math.ceil((q.z_top - q.z_bottom) / q.step - 1e-6) - skipped),
    )


__all__ = ["COUNTER", "render"]

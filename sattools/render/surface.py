"""Rendering of the surface field: compiled on the CPU, plain torch elsewhere."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from sattools.render.reference import render_planes
from sattools.render.view import Quadrature, Rays


def render(
    height: Tensor,
    colour: Tensor,
    rays: Rays,
    quadrature: Quadrature,
    cell_size: float,
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Composite a view of the surface; differentiable in height and colour.

    Args:
        height: ``[H, W]`` float32 [m], row 0 = north.
        colour: ``[H, W, C]`` float32, the radiance that leaves each cell towards this view.
        rays: parallel rays, one per cell.
        quadrature: softness and sampling.
        cell_size: [m].
        mask: ``[H, W]`` uint8, 0 = ray not wanted (its outputs are 0).

    Returns:
        rgb ``[H, W, C]``, depth ``[H, W]`` [m] (sum of weight times height), opacity ``[H, W]``.
    """
    if height.device.type != "cpu":
        outputs = render_planes(height, colour, rays, quadrature, cell_size)
        if mask is None:
            return outputs
        keep = mask.to(height.dtype)
        return outputs[0] * keep[..., None], outputs[1] * keep, outputs[2] * keep
    return _Compiled.apply(height, colour, rays, quadrature, cell_size, mask)


def chunk_count(cells: int) -> int:
    """Pieces of work of a kernel: by the size of the map alone, so that sums do not depend on the number of threads."""
    return min(8, max(1, cells // 16384))


class _Compiled(torch.autograd.Function):
    """March rays in a numba kernel; the backward pass marches again instead of storing every sample."""

    @staticmethod
    def forward(
        ctx: Any, height: Tensor, colour: Tensor, rays: Rays, q: Quadrature, cell: float, mask: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        from sattools.render import kernels

        h = np.ascontiguousarray(height.detach().numpy(), dtype=np.float32)
        c = np.ascontiguousarray(colour.detach().numpy(), dtype=np.float32)
        keep = np.ones(h.shape, np.uint8) if mask is None else np.ascontiguousarray(mask.numpy())
        geometry = _geometry(rays, q, cell)
        ceiling = max_pool2d(torch.from_numpy(h)[None], 2 * kernels.REACH + 1, 1, kernels.REACH)[0].numpy()
        rgb, depth, opacity = np.empty_like(c), np.empty_like(h), np.empty_like(h)
        chunks = chunk_count(h.size)
        # nothing to see above the highest surface; whole steps, so that the samples stay where they would have been
        spare = q.z_top - (float(h.max()) + kernels.EMPTY * q.softness)
        top = np.float32(q.z_top - max(0, math.floor(spare / q.step)) * q.step)
        arguments = (h, ceiling, c, *geometry[:3], top, *geometry[3:], keep, chunks, rgb, depth, opacity)
        COUNTER["forward"] += int(_call(kernels.march, arguments))
        ctx.arguments = arguments
        return torch.from_numpy(rgb), torch.from_numpy(depth), torch.from_numpy(opacity)

    @staticmethod
    def backward(ctx: Any, grad_rgb: Tensor, grad_depth: Tensor, grad_opacity: Tensor):
        from sattools.render import kernels

        h, _, c, *_, chunks, _, _, _ = ctx.arguments
        grads = [np.ascontiguousarray(g.numpy(), dtype=np.float32) for g in (grad_rgb, grad_depth, grad_opacity)]
        height_buffers = np.zeros((chunks, *h.shape), np.float32)
        colour_buffers = np.zeros((chunks, *c.shape), np.float32)
        _call(kernels.march_backward, (*ctx.arguments, *grads, height_buffers, colour_buffers))
        return torch.from_numpy(height_buffers.sum(0)), torch.from_numpy(colour_buffers.sum(0)), None, None, None, None


# field samples evaluated by the compiled path, for benchmarks/throughput.py
COUNTER = {"forward": 0}


def _call(kernel: Any, arguments: tuple) -> Any:
    """Call a compiled kernel (the type checker knows nothing of its arguments)."""
    return kernel(*arguments)


def _geometry(rays: Rays, q: Quadrature, cell: float) -> tuple:
    """Offset and slope in cells (column, row), reference height, bottom, softness, step, alpha table, as float32."""
    from sattools.render import kernels

    offset = np.array([rays.offset[0] / cell, -rays.offset[1] / cell], np.float32)
    slope = np.array([rays.slope[0] / cell, -rays.slope[1] / cell], np.float32)
    return (
        offset,
        slope,
        np.float32(rays.z_ref),
        np.float32(q.z_bottom),
        np.float32(q.softness),
        np.float32(q.step),
        kernels.tables(q.softness, q.step),
    )


__all__ = ["COUNTER", "render"]

"""Sun visibility of a height map: geometric cast shadows with a narrow penumbra, differentiable."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sattools.render.surface import chunk_count

SUN_RADIUS_DEG = 0.27


def sun_visibility(height: Tensor, cell_size: float, sun: Tensor | tuple[float, float, float]) -> Tensor:
    """Share of the sun's light that reaches every cell past the other cells.

    A cell's sun ray is followed cell by cell until it is above the highest surface or leaves the map (outside is
    open). The
    visibility is a ramp of the smallest clearance between ray and surface, over the width of the penumbra: half a
    cell's rise,
    below which the grid cannot tell, and the sun's radius at the caster's distance.

    Args:
        height: ``[H, W]`` heights [m], row 0 = north.
        cell_size: [m].
        sun: unit vector (east, north, up) from the ground to the sun.

    Returns:
        ``[H, W]`` in [0, 1], 1 = lit; all 0 with the sun at or below the horizon. Gradients reach the cell (higher =
        more light)
        and the cell that casts the deciding shadow (higher = less).
    """
    east, north, up = (float(v) for v in sun)
    horizontal = math.hypot(east, north)
    if up <= 0:
        return torch.zeros_like(height)
    if horizontal < 1e-6 * up:
        return torch.ones_like(height)
    heading = (east / horizontal, -north / horizontal)  # columns east, rows south
    visibility: Tensor = _Visibility.apply(height, cell_size, heading, up / horizontal)
    return visibility


class _Visibility(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, height: Tensor, cell: float, heading: tuple[float, float], tangent: float) -> Tensor:
        from sattools.render import kernels

        h = np.ascontiguousarray(height.detach().cpu().numpy(), dtype=np.float32)
        visibility = np.empty_like(h)
        caster = np.empty(h.shape, np.int64)
        distance = np.empty_like(h)
        rise = tangent * cell
        half_width = 0.5 * rise
        # width of the half shadow per metre along the ray's ground track: d(tan el) = d(el) / cos(el)^2
        growth = math.radians(SUN_RADIUS_DEG) * (1 + tangent**2) * cell
        kernels.shadow_march(
            h, np.array(heading, np.float32), np.float32(rise), np.float32(half_width), np.float32(growth),
            np.float32(h.max()), visibility, caster, distance, 4 * chunk_count(h.size),
        )  # fmt: skip
        ctx.widths = (half_width, growth)
        result = torch.from_numpy(visibility).to(height.device)
        ctx.save_for_backward(
            result, torch.from_numpy(caster).to(height.device), torch.from_numpy(distance).to(height.device)
        )
        return result.to(height.dtype)

    @staticmethod
    def backward(ctx: Any, grad: Tensor):
        visibility, caster, distance = ctx.saved_tensors
        half_width, growth = ctx.widths
        on_ramp = (visibility > 0) & (visibility < 1) & (caster >= 0)
        slope = torch.where(on_ramp, grad / (2 * (half_width + growth * distance)), 0.0)
        total = slope.clone().view(-1)
        total.index_add_(0, caster[on_ramp], -slope[on_ramp])
        return total.view_as(grad), None, None, None


__all__ = ["sun_visibility"]

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

    Cells are plates with steps between them, as a grid of houses wants it: a plate slopes as far as its neighbours on
    both sides agree (so slopes are smooth), else it is level (so a roof reaches to its edge and a wall is upright). A
    cell's sun ray is followed from plate to plate until it is above the highest surface or leaves the map (outside is
    open). The visibility is a ramp of the smallest clearance between ray and surface. Its width is that of the cell,
    of which a part may be lit, and of the sun's radius at the caster's distance.

    Args:
        height: ``[H, W]`` heights [m], row 0 = north.
        cell_size: [m].
        sun: unit vector (east, north, up) from the ground to the sun.

    Returns:
        ``[H, W]`` in [0, 1], 1 = lit; all 0 with the sun at or below the horizon. Gradients reach the cell (higher =
        more light) and the cell that casts the deciding shadow (higher = less).
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


def plate_slopes(height: Tensor) -> tuple[Tensor, Tensor]:
    """Rise of every cell per cell eastwards and southwards ``[H, W]`` [m].

    It holds as far as the neighbours on both sides agree, else it is 0 (minmod): a plane keeps its slope, and beside a
    wall the ground and the roof stay level.
    """
    from sattools.render import shadow_kernels

    h = np.ascontiguousarray(height.detach().cpu().numpy(), dtype=np.float32)
    east, south = np.empty_like(h), np.empty_like(h)
    shadow_kernels.limited_slopes(h, east, south)
    return torch.from_numpy(east).to(height), torch.from_numpy(south).to(height)


class _Visibility(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, height: Tensor, cell: float, heading: tuple[float, float], tangent: float) -> Tensor:
        from sattools.render import shadow_kernels

        h = np.ascontiguousarray(height.detach().cpu().numpy(), dtype=np.float32)
        visibility, width, slope_x, slope_y = (np.empty_like(h) for _ in range(4))
        caster = np.empty(h.shape, np.int64)
        shadow_kernels.limited_slopes(h, slope_x, slope_y)
        # width of the half shadow per metre along the ray's ground track: d(tan el) = d(el) / cos(el)^2
        growth = math.radians(SUN_RADIUS_DEG) * (1 + tangent**2) * cell
        top = h.max() + 0.5 * max(np.abs(slope_x).max(), np.abs(slope_y).max())
        shadow_kernels.shadow_march(
            h, slope_x, slope_y, np.array(heading, np.float32), np.float32(tangent * cell), np.float32(growth),
            np.float32(top), visibility, caster, width, 4 * chunk_count(h.size),
        )  # fmt: skip
        result = torch.from_numpy(visibility).to(height.device)
        ctx.save_for_backward(
            result, torch.from_numpy(caster).to(height.device), torch.from_numpy(width).to(height.device)
        )
        return result.to(height.dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = grads
        visibility, caster, width = ctx.saved_tensors
        on_ramp = (visibility > 0) & (visibility < 1) & (caster >= 0)
        slope = torch.where(on_ramp, grad / (2 * width), 0.0)
        total = slope.clone().view(-1)
        total.index_add_(0, caster[on_ramp], -slope[on_ramp])
        return total.view_as(grad), None, None, None


__all__ = ["plate_slopes", "sun_visibility"]

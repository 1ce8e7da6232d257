"""Sun visibility of a height map: geometric cast shadows with a narrow penumbra, differentiable."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sattools.arrays import numpy_too

#: `sun_visibility`, or what takes its place: heights ``[H, W]`` [m], edge of a cell [m], unit vector to the sun
Cast = Callable[[Tensor, float, tuple[float, float, float]], Tensor]


@numpy_too
def sun_visibility(height: Tensor, cell_size: float, sun: Tensor | tuple[float, float, float]) -> Tensor:
    """Share of the sun's light that reaches every cell past the other cells.

    Cells are plates with steps between them, as a grid of houses wants it: a plate slopes as far as its neighbours on
    both sides agree (so slopes are smooth), else it is level (so a roof reaches to its edge and a wall is upright). A
    cell's sun ray is followed from plate to plate until it is above the highest surface or leaves the map (outside is
    open). The visibility is a ramp of the smallest clearance between ray and surface. Its width is that of the cell,
    of which a part may be lit, and of the sun's radius at the caster's distance.

    Args:
        height: ``[H, W]`` heights [m], a tensor or a numpy array, row 0 = north; what is not finite counts as the
            lowest of them.
        cell_size: [m].
        sun: unit vector (east, north, up) from the ground to the sun.

    Returns:
        ``[H, W]`` in [0, 1], 1 = lit; all 0 with the sun at or below the horizon. Gradients reach the cell (higher =
        more light) and the cell that casts the deciding shadow (higher = less). An array where an array is given.

    Raises:
        TypeError: heights that are neither a tensor nor an array.
        ValueError: heights that have not two axes.
    """
    if not isinstance(height, Tensor):
        raise TypeError(f"height: found {type(height).__name__}, expected a tensor or an array")
    if height.ndim != 2:
        raise ValueError(f"height: found {tuple(height.shape)}, expected two axes: rows and columns")
    east, north, up = (float(v) for v in sun)
    if up <= 0:
        return torch.zeros_like(height)
    if math.hypot(east, north) < 1e-6 * up:
        return torch.ones_like(height)
    visibility: Tensor = _Visibility.apply(height, cell_size, (east, north, up))
    return visibility


def plate_slopes(height: Tensor) -> tuple[Tensor, Tensor]:
    """Rise of every cell per cell eastwards and southwards ``[H, W]`` [m].

    It holds as far as the neighbours on both sides agree, else it is 0 (minmod): a plane keeps its slope, and beside a
    wall the ground and the roof stay level.
    """
    from sattools.render.shadows import limited_slopes

    east, south = limited_slopes(height.detach().cpu().numpy())
    return torch.from_numpy(east).to(height), torch.from_numpy(south).to(height)


class _Visibility(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, height: Tensor, cell: float, sun: tuple[float, float, float]) -> Tensor:
        from sattools.render.shadows import cast_shadows

        found = cast_shadows(height.detach().cpu().numpy(), cell, sun)
        lit, caster, width = (torch.from_numpy(array).to(height.device) for array in found)
        ctx.save_for_backward(lit, caster, width)
        return lit.to(height.dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = grads
        visibility, caster, width = ctx.saved_tensors
        on_ramp = (visibility > 0) & (visibility < 1) & (caster >= 0)
        slope = torch.where(on_ramp, grad / (2 * width), 0.0)
        total = slope.clone().view(-1)
        total.index_add_(0, caster[on_ramp], -slope[on_ramp])
        return total.view_as(grad), None, None


__all__ = ["Cast", "plate_slopes", "sun_visibility"]

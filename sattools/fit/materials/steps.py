"""Smooth heights and normals between steps: what lies beyond a wall says nothing of a roof's slope, or of its shadow.

Heights are smoothed before light is computed with them. Across walls that would make slopes of several cells out of
every step, on both sides of it: roofs and streets would be lit as hillsides, and what the light does not explain would
go into the reflectance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sattools.compiled import njit, spread
from sattools.fit.materials.blur import blurred, gaussian_taps
from sattools.fit.materials.normals import surface_normals

NORMAL_CELLS = 2.0  # deviation of the smoothing of the heights that normals are taken from; more flattens slopes
STEP_SLOPE = 1.5  # metres of height per metre from which a rise between two cells is a step, and no slope ...
STEP_M = 1.5  # ... if it is as high as that [m]: noise of small cells is none
LEVEL = 0.5  # share of a step that the ground beside it may rise by from cell to cell
# 8 degrees: where more than half of what is no step is steeper, steep rises are hillsides, or blunders of the prior
LEVEL_SLOPE = 0.14


@dataclass(frozen=True)
class Steps:
    """Where a height map has steps.

    Attributes:
        east: ``[H, W - 1]`` bool, between a cell and its eastern neighbour.
        south: ``[H - 1, W]`` bool, between a cell and its southern neighbour.
    """

    east: Tensor
    south: Tensor


def smooth_heights(height: Tensor, cell_size: float) -> tuple[Tensor, Steps | None]:
    """Heights ``[H, W]`` that light is computed with, smooth between the steps, and the steps.

    Heights are noisier than slopes may be; and texture must not be taken for the shading of small bumps.
    """
    steps = find_steps(height, cell_size)
    smooth = blurred(height, NORMAL_CELLS) if steps is None else blurred_within(height, NORMAL_CELLS, steps)
    return smooth, steps


def smooth_normals(height: Tensor, cell_size: float) -> Tensor:
    """Unit normals ``[H, W, 3]`` of heights ``[H, W]`` [m], smooth between the steps."""
    smooth, steps = smooth_heights(height, cell_size)
    return surface_normals(smooth, cell_size) if steps is None else normals_within(smooth, cell_size, steps)


@torch.no_grad()
def find_steps(height: Tensor, cell_size: float) -> Steps | None:
    """Steps of a height map ``[H, W]`` [m], or None if it has none or is of hills.

    Args:
        height: row 0 = north.
        cell_size: [m].
    """
    if _hilly(height, cell_size):
        return None
    steps = Steps(_sudden(height, cell_size), _sudden(height.T, cell_size).T.contiguous())
    return steps if bool(steps.east.any()) or bool(steps.south.any()) else None


def _hilly(height: Tensor, cell_size: float) -> bool:
    """Whether most of the ground that is no step is no level ground, whichever way it falls."""
    around = torch.nn.functional.pad(height[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    east, south = around[1:-1, 2:] - around[1:-1, :-2], around[2:, 1:-1] - around[:-2, 1:-1]
    slope = torch.hypot(east, south) / (2 * cell_size)
    ground = slope < STEP_SLOPE
    return bool(2 * int((ground & (slope > LEVEL_SLOPE)).sum()) > int(ground.sum()))


def _sudden(height: Tensor, cell_size: float) -> Tensor:
    """Where a row ``[H, W]`` rises or falls by more than a slope between two cells ``[H, W - 1]``.

    A wall may take two cells, so that level ground or a roof is required on one of its sides only; a hillside goes on
    as steeply on both.
    """
    rise = (height[:, 1:] - height[:, :-1]).abs()
    beside = torch.nn.functional.pad(rise, (1, 1))  # nothing is known beyond the edge: level
    level = torch.minimum(beside[:, :-2], beside[:, 2:])
    return (rise > max(STEP_SLOPE * cell_size, STEP_M)) & (level < LEVEL * rise)


def blurred_within(height: Tensor, sigma: float, steps: Steps) -> Tensor:
    """Gaussian blur of ``[H, W]``, sigma in cells, along rows and columns as far as the next step.

    Beyond the edge the nearest cell goes on.
    """
    if height.device.type != "cpu":
        return plain_blurred_within(height, sigma, steps)
    taps = gaussian_taps(sigma, height)
    down: Tensor = _Along.apply(height.T.contiguous(), steps.south.T.contiguous(), taps)
    across: Tensor = _Along.apply(down.T.contiguous(), steps.east, taps)
    return across


def plain_blurred_within(height: Tensor, sigma: float, steps: Steps) -> Tensor:
    """`blurred_within` by operations of torch, on any device: the readable twin."""
    taps = gaussian_taps(sigma, height)
    return _plain_along(_plain_along(height.T, steps.south.T, taps).T, steps.east, taps)


def _plain_along(maps: Tensor, stop: Tensor, taps: Tensor) -> Tensor:
    """Weighted means along rows, as far as the next step on both sides."""
    radius, cols = len(taps) // 2, maps.shape[1]
    wide = torch.nn.functional.pad(maps[None], (radius, radius), mode="replicate")[0]
    passed = torch.nn.functional.pad(~stop, (radius, radius), value=True)  # `passed[:, radius + j]`: from j to j + 1
    total, mass = taps[radius] * maps, torch.full_like(maps, float(taps[radius]))
    for side in (1, -1):
        reached = torch.ones_like(maps, dtype=torch.bool)
        for k in range(1, radius + 1):
            first = radius + (k - 1 if side == 1 else -k)
            reached = reached & passed[:, first : first + cols]
            weight = taps[radius + k] * reached
            total = total + weight * wide[:, radius + side * k : radius + side * k + cols]
            mass = mass + weight
    return total / mass


def normals_within(height: Tensor, cell_size: float, steps: Steps) -> Tensor:
    """Unit normals ``[H, W, 3]`` (east, north, up) of smooth heights ``[H, W]`` [m], row 0 = north.

    Slopes are means of the differences to both neighbours; to what lies beyond a step, or the edge, there is none.

    Args:
        height: smooth between the steps, see `blurred_within`.
        cell_size: [m].
        steps: of the heights before smoothing.
    """
    east = _slope(height, steps.east) / cell_size
    south = _slope(height.T, steps.south.T).T / cell_size
    normal = torch.stack([-east, south, torch.ones_like(east)], dim=-1)
    return normal / normal.norm(dim=-1, keepdim=True)


def _slope(height: Tensor, stop: Tensor) -> Tensor:
    """Rise per cell along rows."""
    known = (~stop).to(height)
    rise = (height[:, 1:] - height[:, :-1]) * known
    both, counted = (torch.nn.functional.pad(m, (1, 0)) + torch.nn.functional.pad(m, (0, 1)) for m in (rise, known))
    return both / counted.clamp_min(1.0)


class _Along(torch.autograd.Function):
    """Weighted means along rows, as far as the next step on both sides."""

    @staticmethod
    def forward(ctx: Any, maps: Tensor, stop: Tensor, taps: Tensor) -> Tensor:
        """Maps ``[H, W]``."""
        ctx.given = stop.contiguous().numpy(), taps.numpy()
        out = torch.empty_like(maps)
        _means(maps.detach().numpy(), *ctx.given, out.numpy())
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Of the maps."""
        out = torch.zeros_like(grads[0], memory_format=torch.contiguous_format)
        _means_back(grads[0].contiguous().numpy(), *ctx.given, out.numpy())
        return out, None, None


@njit(cache=True, nogil=True)
def _reach(stop, col, taps):
    """How many cells to the west and to the east of one in a row count, those beyond the edge too, and their weight."""
    radius = len(taps) // 2
    west, east = 0, 0
    while west < radius and (col - west < 1 or not stop[col - west - 1]):
        west += 1
    while east < radius and (col + east >= len(stop) or not stop[col + east]):
        east += 1
    mass = 0.0  # in double precision: single ones would tilt level roofs
    for k in range(radius - west, radius + east + 1):
        mass += taps[k]
    return west, east, mass


@spread(lambda maps, *_: len(maps))
@njit(cache=True, nogil=True)
def _means(maps, stop, taps, out, first, end):
    """Weighted means of some rows."""
    cols, radius = maps.shape[1], len(taps) // 2
    for row in range(first, end):
        for col in range(cols):
            west, east, mass = _reach(stop[row], col, taps)
            total = 0.0
            for k in range(-west, east + 1):
                total += taps[radius + k] * maps[row, min(max(col + k, 0), cols - 1)]
            out[row, col] = total / mass


@spread(lambda grad, *_: len(grad))
@njit(cache=True, nogil=True)
def _means_back(grad, stop, taps, out, first, end):
    """Transposed `_means` of some rows, added to the result."""
    cols, radius = grad.shape[1], len(taps) // 2
    for row in range(first, end):
        for col in range(cols):
            west, east, mass = _reach(stop[row], col, taps)
            part = grad[row, col] / mass
            for k in range(-west, east + 1):
                out[row, min(max(col + k, 0), cols - 1)] += part * taps[radius + k]


__all__ = [
    "NORMAL_CELLS",
    "STEP_M",
    "STEP_SLOPE",
    "Steps",
    "blurred_within",
    "find_steps",
    "normals_within",
    "plain_blurred_within",
    "smooth_heights",
    "smooth_normals",
]

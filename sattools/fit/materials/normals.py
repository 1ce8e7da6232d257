"""Normals of a height map, compiled for processors with their way back; on other devices by operations of torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sattools.compiled import njit, spread


def surface_normals(height: Tensor, cell_size: float) -> Tensor:
    """Unit normals ``[H, W, 3]`` (east, north, up) of a height map ``[H, W]``, row 0 = north; Sobel differences.

    The averaging across the direction of the difference keeps noise of single cells out.
    """
    if height.device.type != "cpu":
        return plain_surface_normals(height, cell_size)
    value: Tensor = _Normals.apply(height.contiguous(), cell_size)
    return value


def plain_surface_normals(height: Tensor, cell_size: float) -> Tensor:
    """`surface_normals` by operations of torch, on any device: the readable twin."""
    padded = torch.nn.functional.pad(height[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    # a mirrored slope beyond the edge instead of a halved one
    padded[0, :], padded[-1, :] = 2 * padded[1, :] - padded[2, :], 2 * padded[-2, :] - padded[-3, :]
    padded = padded.clone()
    padded[:, 0], padded[:, -1] = 2 * padded[:, 1] - padded[:, 2], 2 * padded[:, -2] - padded[:, -3]
    down = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    east = (down[:, 2:] - down[:, :-2]) / (8 * cell_size)
    along = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
    north = (along[:-2] - along[2:]) / (8 * cell_size)
    normal = torch.stack([-east, -north, torch.ones_like(east)], dim=-1)
    return normal / normal.norm(dim=-1, keepdim=True)


class _Normals(torch.autograd.Function):
    """Heights ``[H, W]`` to normals ``[H, W, 3]``."""

    @staticmethod
    def forward(ctx: Any, height: Tensor, cell_size: float) -> Tensor:
        """The normals."""
        padded = np.pad(height.detach().numpy(), 1, mode="edge")
        for axis in (padded, padded.T):  # a mirrored slope beyond the edge
            axis[0], axis[-1] = 2 * axis[1] - axis[2], 2 * axis[-2] - axis[-3]
        normal = height.new_empty(*height.shape, 3)
        _normals(padded, cell_size, normal.numpy())
        ctx.cell_size = cell_size
        ctx.save_for_backward(normal)
        return normal

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Of the heights."""
        (normal,) = ctx.saved_tensors
        rows, cols, _ = normal.shape
        grad = grads[0].contiguous().numpy()
        slopes = np.zeros((2, rows + 4, cols + 4), grad.dtype)  # of every cell, two cells of nothing around
        _slope_gradients(normal.numpy(), grad, ctx.cell_size, slopes)
        padded = np.empty((rows + 2, cols + 2), grad.dtype)
        _spread_back(slopes, padded)
        # the columns beyond the edge were written last, so they go back first
        for axis, count in ((padded.T, cols), (padded, rows)):
            inner = 2 if count > 1 else 1
            axis[1] += 2 * axis[0]
            axis[inner] -= axis[0]
            axis[-2] += 2 * axis[-1]
            axis[-1 - inner] -= axis[-1]
        return torch.from_numpy(padded[1:-1, 1:-1].copy()), None


@spread(lambda padded, cell_size, normal: len(normal))
@njit(cache=True, nogil=True)
def _normals(padded, cell_size, normal, first, end):
    """Normals of some rows from heights with one cell more around."""
    per = 1 / (8 * cell_size)
    for row in range(first, end):
        above, here, below = padded[row], padded[row + 1], padded[row + 2]
        for col in range(normal.shape[1]):
            corner = below[col + 2] - above[col]
            other = above[col + 2] - below[col]
            east = (corner + other + 2 * (here[col + 2] - here[col])) * per
            north = (other - corner + 2 * (above[col + 1] - below[col + 1])) * per
            up = 1 / np.sqrt(east * east + north * north + 1)
            normal[row, col, 0], normal[row, col, 1], normal[row, col, 2] = -east * up, -north * up, up


@spread(lambda normal, *_: len(normal))
@njit(cache=True, nogil=True)
def _slope_gradients(normal, grad, cell_size, slopes, first, end):
    """Gradients of a cell's slopes to east and north, over the 8 cells of its differences, from those of its normal."""
    per = 1 / (8 * cell_size)
    for row in range(first, end):
        for col in range(normal.shape[1]):
            x, y, z = normal[row, col, 0], normal[row, col, 1], normal[row, col, 2]
            along = x * grad[row, col, 0] + y * grad[row, col, 1] + z * grad[row, col, 2]
            slopes[0, row + 2, col + 2] = -(grad[row, col, 0] - x * along) * z * per
            slopes[1, row + 2, col + 2] = -(grad[row, col, 1] - y * along) * z * per


@spread(lambda slopes, padded: len(padded))
@njit(cache=True, nogil=True)
def _spread_back(slopes, padded, first, end):
    """Gradients of the padded heights: every height's part in the slopes of the cells around it."""
    for row in range(first, end):
        for col in range(padded.shape[1]):
            east = slopes[0, row : row + 3, col : col + 3]
            north = slopes[1, row : row + 3, col : col + 3]
            padded[row, col] = (
                (east[0, 0] + 2 * east[1, 0] + east[2, 0])
                - (east[0, 2] + 2 * east[1, 2] + east[2, 2])
                + (north[2, 0] + 2 * north[2, 1] + north[2, 2])
                - (north[0, 0] + 2 * north[0, 1] + north[0, 2])
            )


__all__ = ["plain_surface_normals", "surface_normals"]

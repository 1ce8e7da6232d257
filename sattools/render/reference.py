"""The renderer in plain torch and the cast shadows in plain numpy: readable twins of the compiled kernels.

`render_planes` is also the path for CUDA devices.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from sattools.render.view import ParallelRays, Quadrature


def render_planes(
    height: Tensor, colour: Tensor, rays: ParallelRays, quadrature: Quadrature, cell_size: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Composite the surface field along parallel rays, height plane by height plane, from the top.

    The density per metre of height is sigma(z) = sigmoid((h - z) / s) / s, so that a vertical ray's transmittance is
    sigmoid((z - h) / s) and crosses 1/2 at z = h for every softness s; alpha = 1 - exp(-sigma * step).

    Args:
        height: ``[H, W]`` [m].
        colour: ``[H, W, C]``.
        rays: parallel rays, one per cell.
        quadrature: planes.
        cell_size: [m].

    Returns:
        rgb ``[H, W, C]``, depth ``[H, W]`` (sum of weights times height [m]), opacity ``[H, W]``.
    """
    rows, cols = height.shape
    maps = torch.cat([height[None], colour.permute(2, 0, 1)])[None]  # [1, 1 + C, H, W]
    col = torch.arange(cols, dtype=height.dtype, device=height.device)
    row = torch.arange(rows, dtype=height.dtype, device=height.device)
    transmittance = torch.ones_like(height)
    rgb = torch.zeros_like(colour)
    depth = torch.zeros_like(height)
    planes = int((quadrature.z_top - quadrature.z_bottom) / quadrature.step - 1e-6) + 1
    for k in range(planes):
        z = quadrature.z_top - k * quadrature.step
        dz = z - rays.z_ref
        x = col + (rays.offset[0] + rays.slope[0] * dz) / cell_size
        y = row - (rays.offset[1] + rays.slope[1] * dz) / cell_size  # rows run south
        where = torch.stack(
            [
                (2 * x / max(cols - 1, 1) - 1).expand(rows, cols),
                (2 * y / max(rows - 1, 1) - 1)[:, None].expand(rows, cols),
            ],
            dim=-1,
        )[None]
        read = grid_sample(maps, where, mode="bilinear", padding_mode="border", align_corners=True)[0]
        sigma = torch.sigmoid((read[0] - z) / quadrature.softness) / quadrature.softness
        weight = transmittance * (1 - torch.exp(-sigma * quadrature.step))
        rgb = rgb + weight[..., None] * read[1:].permute(1, 2, 0)
        depth = depth + weight * z
        transmittance = transmittance - weight
    return rgb, depth, 1 - transmittance


def minmod_slopes(height: np.ndarray, axis: int) -> np.ndarray:
    """Rise of every cell per cell along an axis ``[H, W]`` [m].

    It is the flatter of that to both neighbours; 0 where these differ in sign, and at the map's edge.
    """
    slope = np.zeros_like(height)  # [H, W]
    back, ahead = np.diff(height, axis=axis), np.diff(height, axis=axis)
    back, ahead = (
        np.take(d, range(d.shape[axis])[part], axis) for d, part in ((back, slice(-1)), (ahead, slice(1, None)))
    )
    flatter = np.where(np.abs(back) < np.abs(ahead), back, ahead) * (back * ahead > 0)
    inner = [slice(None), slice(None)]
    inner[axis] = slice(1, -1)
    slope[tuple(inner)] = flatter
    return slope


def sun_visibility(height: np.ndarray, cell_size: float, sun: tuple[float, float, float]) -> np.ndarray:
    """Share of the sun's light that reaches every cell past the other cells; see `sattools.render.sun_visibility`.

    Args:
        height: ``[H, W]`` [m], row 0 = north.
        cell_size: edge of a cell [m].
        sun: unit vector (east, north, up) to the sun, neither in the zenith nor below the horizon.

    Returns:
        ``[H, W]`` in [0, 1], 1 = lit.
    """
    east, north, up = sun
    across = math.hypot(east, north)
    dx, dy = east / across, -north / across  # columns east, rows south
    rise = up / across * cell_size  # [m] of the ray per cell
    growth = math.radians(0.27) * (1 + (up / across) ** 2) * cell_size  # [m per cell] of half the penumbra's width
    slope_x, slope_y = minmod_slopes(height, 1), minmod_slopes(height, 0)  # [H, W] m per cell
    visibility = np.ones(height.shape)  # [H, W]
    for row, col in np.ndindex(height.shape):
        own = float(0.5 * (rise - slope_x[row, col] * dx - slope_y[row, col] * dy))  # [m] over the cell's own plate
        visibility[row, col] = 1.0 if own > 0 else 0.0  # turned away from the sun
        own = max(own, 0.05 * rise)
        for c, r, enter, leave in cells_passed(col, row, dx, dy, height.shape):
            for t in (enter, leave):  # [cells] along the ray
                ray = height[row, col] + t * rise
                plate = height[r, c] + slope_x[r, c] * (col - c + t * dx) + slope_y[r, c] * (row - r + t * dy)
                ramp = own + growth * (t - 0.5)
                visibility[row, col] = min(visibility[row, col], 0.5 + (ray - plate) / (2 * ramp))
    return np.maximum(visibility, 0.0)


def cells_passed(
    col: int, row: int, dx: float, dy: float, shape: tuple[int, int]
) -> list[tuple[int, int, float, float]]:
    """(column, row, path lengths at which it is entered and left) of the cells on a ray from a cell's middle [cells].

    Args:
        col: column of the first cell, which is not among them.
        row: its row.
        dx: columns per unit of path.
        dy: rows per unit of path.
        shape: (rows, columns) of the map.
    """
    next_c, next_r = 0.5 / max(abs(dx), 1e-30), 0.5 / max(abs(dy), 1e-30)
    passed: list[tuple[int, int, float, float]] = []
    while True:
        enter = min(next_c, next_r)
        if next_c < next_r:
            next_c, col = next_c + 1 / abs(dx), col + (1 if dx > 0 else -1)
        else:
            next_r, row = next_r + 1 / abs(dy), row + (1 if dy > 0 else -1)
        if not (0 <= row < shape[0] and 0 <= col < shape[1]):
            return passed
        passed.append((col, row, enter, min(next_c, next_r)))


__all__ = ["cells_passed", "minmod_slopes", "render_planes", "sun_visibility"]

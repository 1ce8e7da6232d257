"""Plain torch renderer: the readable twin of the compiled kernels, and the path for CUDA devices."""

from __future__ import annotations

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


__all__ = ["render_planes"]

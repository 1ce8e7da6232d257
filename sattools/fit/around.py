"""Fits of an area that know what stands around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sattools.fit.surface.trainer import make_quadrature
from sattools.render import ParallelRays, render, sun_visibility
from sattools.render.around import Around
from sattools.render.visibility import Cast
from sattools.views import View

SOFTNESS_M = 0.5  # of the surface on which rays end


def casting(around: Around | None) -> Cast:
    """`sun_visibility`, where it is known with what stands around to cast shadows, too (and without gradients then)."""
    if around is None:
        return sun_visibility

    def cast(height: Tensor, cell_size: float, sun: tuple[float, float, float]) -> Tensor:
        return torch.from_numpy(around.light_from(height.detach().cpu().numpy(), cell_size, sun)).to(height)

    return cast


def of_the_area(
    views: Sequence[View], around: Around | None, height: Tensor | None, cell_size: float, z_range: tuple[float, float]
) -> list[View]:
    """Views without the pixels whose rays end on what stands around the area; one that would lose all stays as it is.

    Args:
        views: on the area's cells.
        around: the ground around; None = nothing is known of it.
        height: ``[H, W]`` of the area [m]; None = unknown.
        cell_size: edge of a cell [m].
        z_range: lowest and highest height [m].
    """
    if around is None or height is None:
        return list(views)
    heights = height.detach().cpu().numpy()
    low, high = around.range(heights)
    quadrature = make_quadrature(SOFTNESS_M, z_range)
    found = []
    for view in views:
        # where rays are at the highest and at the lowest of all
        ends = [(view.slope.east * (z - view.z_ref), view.slope.north * (z - view.z_ref)) for z in (low, high)]
        wide, rows, cols = around.widened(heights, cell_size, *ends)
        own = torch.zeros(*wide.shape, 1)
        own[rows, cols] = 1.0
        rays = ParallelRays(view.slope, view.z_ref, (0.0, 0.0))
        wanted = own[..., 0].to(torch.uint8)
        share, _, _ = render(torch.from_numpy(wide), own, rays, quadrature, cell_size, wanted)
        mask = view.mask * (share[rows, cols, 0] > 0.5).numpy().astype(view.mask.dtype)
        found.append(replace(view, mask=mask) if mask.any() else view)
    return found


__all__ = ["casting", "of_the_area"]

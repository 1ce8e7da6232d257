"""Lambert's law: the same radiance into every direction."""

from __future__ import annotations

import torch
from torch import Tensor

from sattools.reflectance.angles import as_tensors, dot


def lambert(normal: Tensor, sun: Tensor, view: Tensor, albedo: Tensor | float) -> Tensor:
    """BRF of a Lambertian surface: its albedo, with the horizon rule of `sattools.reflectance.angles`.

    Args:
        normal: unit vectors ``[..., 3]`` away from the surface.
        sun: unit vectors ``[..., 3]`` away from the surface.
        view: unit vectors ``[..., 3]`` away from the surface.
        albedo: broadcastable to ``[...]``.

    Returns:
        Bidirectional reflectance factor pi L / E, E the irradiance *of the facet* (beam irradiance times cos i), so
        that white is 1 at every incidence. Multiply by cos i for pi L over the irradiance of a plane across the beam.

    Raises:
        TypeError, ValueError: see `sattools.reflectance.angles.as_tensors`.
    """
    normal, sun, view, albedo = as_tensors(normal, sun, view, albedo)
    mu0, mu = dot(normal.detach(), sun.detach()), dot(normal.detach(), view.detach())
    beyond = (mu0 < 0) | (mu < 0)
    return torch.where(beyond, torch.zeros((), dtype=albedo.dtype, device=albedo.device), albedo)

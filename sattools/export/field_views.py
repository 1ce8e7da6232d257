"""A fitted volume as cameras and suns show it: its own rays, not a height map of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from sattools.field.mlp import MlpField
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.illumination import level_towards
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.rays.scene import ALL_IN, RayScene
from sattools.fit.rays.start import ray_set, restored_field
from sattools.fit.surface.trainer import make_quadrature
from sattools.render import ParallelRays, render
from sattools.views import View

SAMPLES, AROUND = 48, 32  # along a ray, and around the surface that was read off
RAYS = 512  # at once: a wide network keeps megabytes of each


@torch.no_grad()
def field_picture(
    model: FittedModel, view: View, known: int | None, z_range: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a view shows of a volume, on the ground grid at the view's reference height.

    Args:
        model: of a field that was trained ray by ray.
        view: its line of sight, its sun; the pixels do not matter.
        known: number of the training image, None for a view that the fit has not seen: it has the mean embedding, no
            gain and no offset.
        z_range: lowest and highest height [m].

    Returns:
        ``[H, W, C]`` radiance, ``[H, W]`` height of the ray's surface point [m], ``[H, W]`` opacity.
    """
    grid, bands = model.grid, model.albedo.shape[-1]
    everywhere = replace(
        view, target=np.zeros((*grid.shape, bands), np.float32), mask=np.ones(grid.shape, np.uint8)
    )  # fmt: skip
    found = DepthPrior(model.height, torch.ones_like(model.height), grid, model.extra.get("normal"))
    rays = ray_set([everywhere], grid, z_range, found, normals=model.brdf != "lambert")
    gain, offset = torch.ones(1, bands), torch.zeros(1, bands)
    ambient, embedding = model.ambient.mean(0, keepdim=True), model.extra["embedding"].mean(0, keepdim=True)
    if known is not None:
        one = slice(known, known + 1)
        gain, offset, ambient = model.gain[one], model.offset[one], model.ambient[one]
        embedding = model.extra["embedding"][one]
    if model.absolute:  # the sun may be another one than the image's
        gain = torch.full_like(gain, level_towards(model, model.gain, view.sun))
    scene = RayScene(restored_field(model), rays, _options(model), gain, offset, radiance=model.radiance)
    scene.colour["ambient"].copy_(ambient)
    scene.embedding.copy_(embedding)
    scene.at_rest = isinstance(scene.field, MlpField) and scene.field.rests()
    colours, depths, opacities = [], [], []
    for part in torch.arange(len(rays.target)).split(RAYS):
        seen = scene.predict(part, ALL_IN, 1.0, None)
        colours.append(seen.colour)
        depths.append(seen.depth)
        opacities.append(seen.weights.sum(dim=1))
    low, high = z_range
    shape = grid.shape
    height = high - (high - low) * torch.cat(depths).reshape(shape)
    return (
        torch.cat(colours).reshape(*shape, bands).numpy(),
        height.numpy(),
        torch.cat(opacities).reshape(shape).numpy(),
    )


def _options(model: FittedModel) -> FitOptions:
    """Of the fit, as far as they say how the field is shown."""
    return FitOptions(
        field=model.field,  # type: ignore[arg-type]
        network=model.network or "eonerf",  # type: ignore[arg-type]
        shadow=model.shadow,
        transient=model.transient,
        brdf=model.brdf,
        brdf_at="sample" if "brdf_at_sample" in model.extra else "ray",
        pretrain=0.0,
        samples=SAMPLES,
        guided=AROUND,
        depth_weight=0.0,
        solar_weight=0.0,
        shadow_weight=0.0,
    )


@torch.no_grad()
def surface_picture(
    model: FittedModel,
    height: torch.Tensor,
    light: torch.Tensor,
    rays: ParallelRays,
    z_range: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a view shows of a surface; see `field_picture`.

    Args:
        model: of a surface.
        height: ``[H, W]`` [m].
        light: ``[H, W, C]`` of every cell towards the view.
        rays: of the view.
        z_range: lowest and highest height [m].
    """
    # the fit needs a soft surface for its gradients, a picture does not
    quadrature = make_quadrature(model.softness / 2, z_range)
    rgb, depth, opacity = render(height, light.contiguous(), rays, quadrature, model.grid.cell_size)
    solid = opacity.clamp_min(1e-3)
    return (rgb / solid[..., None]).numpy(), (depth / solid).numpy(), opacity.numpy()


__all__ = ["field_picture", "surface_picture"]

"""The training loop of the surface scene."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sattools.fit.losses import photometric
from sattools.fit.options import FitOptions
from sattools.fit.pose import image_shift, remove_gauge
from sattools.fit.regularise import roughness
from sattools.fit.surface import SurfaceScene
from sattools.fit.views import View
from sattools.render import Quadrature, Rays, render, sun_visibility

# epochs between refreshes of the sun visibility and of the poses; checkpoints are written right before one
REFRESH = 4
# Adam steps: albedo and colour relations are radiances in [0, 1]
ALBEDO_RATE = 0.02
COLOUR_RATE = 0.004


@dataclass
class Prior:
    """Depth supervision on the stage's grid: height ``[H, W]`` [m] (NaN = none) and confidence ``[H, W]`` in [0, 1]."""

    height: Tensor
    confidence: Tensor


@dataclass
class StageSettings:
    """One grid of the coarse-to-fine schedule."""

    cell_size: float
    epochs: int
    softness: tuple[float, float]
    z_range: tuple[float, float]


def train_stage(
    scene: SurfaceScene,
    views: Sequence[View],
    settings: StageSettings,
    options: FitOptions,
    prior: Prior | None,
    stage_index: int,
    on_epoch: Callable[[int, float], bool] = lambda epoch, loss: True,
) -> None:
    """Fit the scene to the views in place.

    Args:
        scene: start values on the stage's grid.
        views: images on the stage's grid.
        settings: the stage.
        options: of the fit.
        prior: depth supervision or None.
        stage_index: for the random order.
        on_epoch: called after every epoch with its number and mean loss; False stops.
    """
    targets = [torch.from_numpy(v.target) for v in views]
    masks = [torch.from_numpy(v.mask) for v in views]
    parameters = scene.trainable()
    for p in parameters.values():
        p.requires_grad_(True)
    rates = {"height": 0.0, "albedo": ALBEDO_RATE, "gain": COLOUR_RATE, "offset": COLOUR_RATE, "ambient": COLOUR_RATE}
    adam = torch.optim.Adam([{"params": [p], "lr": rates[n], "name": n} for n, p in parameters.items()], betas=(0.9, 0.99))
    visibility: list[Tensor | None] = [None] * len(views)
    s0, s1 = settings.softness
    for epoch in range(settings.epochs):
        share = epoch / max(1, settings.epochs - 1)
        softness = s0 * (s1 / s0) ** share
        for group in adam.param_groups:
            # steps shrink towards the end of a stage, so that the noise of single views averages out
            decay = 1 - 0.7 * share
            group["lr"] = decay * (options.height_rate * softness if group["name"] == "height" else rates[group["name"]])
        quadrature = make_quadrature(softness, settings.z_range)
        if epoch % REFRESH == 0:
            if options.shadow == "geometric":
                visibility = [
                    sun_visibility(scene.height.detach(), settings.cell_size, v.sun) if v.sun else None for v in views
                ]
            if options.pose and epoch:
                refine_poses(scene, views, visibility, quadrature, settings.cell_size)
        order = np.random.default_rng([options.seed, stage_index, epoch]).permutation(len(views))
        losses = []
        for j in order:
            adam.zero_grad(set_to_none=True)
            rgb, _, _ = render(
                scene.height, scene.colour(j, visibility[j]), rays_of(scene, views[j], j), quadrature, settings.cell_size, masks[j]
            )
            loss = photometric(options.loss, rgb, targets[j], options.robust).mean(-1)
            loss = (loss * masks[j]).sum() / masks[j].sum() / (options.robust**2 or 1)
            total = loss + options.smooth * roughness(scene.height, settings.cell_size)
            if prior is not None:
                total = total + options.prior_weight * prior_loss(scene.height, prior)
            total.backward()
            parameters["gain"].grad[0] = 0  # the first view is the gauge
            parameters["offset"].grad[0] = 0
            adam.step()
            with torch.no_grad():
                scene.ambient.clamp_(0.02, 1.0)
                scene.gain.clamp_(0.05, 20.0)
                scene.height.clamp_(*settings.z_range)
            losses.append(float(loss.detach()))
        if not on_epoch(epoch, float(np.mean(losses))):
            break
    for p in parameters.values():
        p.requires_grad_(False)


def prior_loss(height: Tensor, prior: Prior, limit: float = 1.0) -> Tensor:
    """Mean of confidence * min(|h - prior|, limit): where rendering disagrees by more than the limit, the prior lets go."""
    known = torch.isfinite(prior.height)
    difference = torch.where(known, height - torch.nan_to_num(prior.height), 0.0).abs()
    return (prior.confidence * difference.clamp_max(limit)).mean()


def rays_of(scene: SurfaceScene, view: View, index: int) -> Rays:
    """The view's rays with its refined pose."""
    east, north = scene.pose[index].tolist()
    return Rays(view.slope, view.z_ref, (east, north))


def make_quadrature(softness: float, z_range: tuple[float, float], samples: float = 1.5) -> Quadrature:
    """Samples every softness / ``samples`` from above the highest to below the lowest height."""
    return Quadrature(softness, softness / samples, z_range[1] + 6 * softness, z_range[0] - 10 * softness)


@torch.no_grad()
def refine_poses(
    scene: SurfaceScene, views: Sequence[View], visibility: Sequence[Tensor | None], quadrature: Quadrature, cell: float
) -> None:
    """One damped least-squares step of every view's shift, without the common part that the images cannot tell."""
    steps = np.zeros((len(views), 2))
    for j, view in enumerate(views):
        mask = torch.from_numpy(view.mask)
        rgb, _, _ = render(scene.height, scene.colour(j, visibility[j]), rays_of(scene, view, j), quadrature, cell, mask)
        residual = np.abs(rgb.numpy() - view.target).mean(-1)
        scale = np.median(residual[view.mask > 0]) * 3 + 1e-6
        weight = view.mask / (1 + (residual / scale) ** 2) ** 2
        inner = np.zeros_like(weight)
        inner[2:-2, 2:-2] = weight[2:-2, 2:-2]
        d = np.clip(image_shift(rgb.numpy(), view.target, inner), -1, 1) * cell
        steps[j] = 0.7 * d[0], -0.7 * d[1]
    pose = scene.pose.numpy() + steps
    scene.pose.copy_(torch.from_numpy(remove_gauge(pose, [v.slope for v in views])).float())


__all__ = ["Prior", "StageSettings", "make_quadrature", "prior_loss", "rays_of", "train_stage"]

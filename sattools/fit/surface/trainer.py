"""One stage of the fit: the training loop of the surface scene on one grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from sattools.fit.adam import Adam
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.losses import CALIBRATED_SHARE, UNIT, photometric, robust_scale, typical_radiance
from sattools.fit.options import FitOptions
from sattools.fit.surface.light import IlluminationModel
from sattools.fit.surface.pose import image_shift, remove_gauge
from sattools.fit.surface.scene import SurfaceScene
from sattools.fit.surface.smoothness import EdgeWeights, edge_weights, smoothness_penalty
from sattools.render import ParallelRays, Quadrature, render
from sattools.render.visibility import Cast, sun_visibility
from sattools.views import View

# epochs between refreshes of the sun visibility and of the poses; a checkpoint can only be taken right before one
REFRESH = 4
# Adam steps of radiances, which lie in [0, 1]
RATES = {"albedo": 0.02, "gain": 0.004, "offset": 0.004, "ambient": 0.004, "amplitude": 0.04}
BETAS = (0.9, 0.99)
KNEE_M = 1.0
PRIOR_LIMIT_M = 1.0  # difference from the prior above which it costs no more
SAMPLES = 1.5  # along a ray, per softness
PROBES, LEAST_STD_M = 2, 0.05  # random signs per image, and the least standard deviation of a height
WALL_SLOPE = 1.5  # metres of height per metre from which a slope is taken for a wall


@dataclass(frozen=True)
class StageSettings:
    """One step of the schedule.

    Attributes:
        cell_size: of the grid [m].
        epochs: passes over all views.
        softness: of the surface at the start and the end [m].
        z_range: lowest and highest height [m].
        reflective: whether the surface has a reflectance model.
    """

    cell_size: float
    epochs: int
    softness: tuple[float, float]
    z_range: tuple[float, float]
    reflective: bool = False


def _prior_loss(height: Tensor, prior: DepthPrior) -> Tensor:
    """Mean of confidence * min(|h - prior|, 1 m): where rendering disagrees by more, the prior lets go.

    Args:
        height: ``[H, W]`` [m].
        prior: on the same grid.
    """
    known = torch.isfinite(prior.height)
    difference = torch.where(known, height - torch.nan_to_num(prior.height), 0.0).abs()
    return (prior.confidence * difference.clamp_max(PRIOR_LIMIT_M)).mean()


def make_quadrature(softness: float, z_range: tuple[float, float]) -> Quadrature:
    """Samples every two thirds of the softness from above the highest to below the lowest height.

    Args:
        softness: of the surface [m].
        z_range: lowest and highest height [m].
    """
    return Quadrature(softness, softness / SAMPLES, z_range[1] + 6 * softness, z_range[0] - 10 * softness)


class StageTrainer:
    """Fits a surface scene to views on one grid, in place.

    Args:
        scene: start values on the stage's grid.
        views: images on the stage's grid, on the reference plane.
        settings: the stage.
        options: of the fit.
        prior: depth supervision or None.
        index: number of the stage, for the random order of the views.
        illumination: learned shadows and transients; None = neither.
        cast: sun visibility of heights ``[H, W]`` on cells [m] under a sun.
    """

    def __init__(
        self,
        scene: SurfaceScene,
        views: Sequence[View],
        settings: StageSettings,
        options: FitOptions,
        prior: DepthPrior | None,
        index: int,
        *,
        illumination: IlluminationModel | None = None,
        cast: Cast = sun_visibility,
    ) -> None:
        self.cast = cast
        self.scene, self.views, self.settings, self.options, self.prior, self.index = (
            scene, views, settings, options, prior, index,
        )  # fmt: skip
        # a good start may have its slopes steepened into walls; from a flat one, walls would freeze before they are
        # found
        self.knee = math.inf if prior is None else KNEE_M
        self.smooth = options.smooth if options.smooth is not None else (0.05 if prior is None else 0.4)
        device = scene.height.device
        self.targets = [torch.from_numpy(v.target).to(device) for v in views]
        self.masks = [torch.from_numpy(v.mask).to(device) for v in views]
        self.illumination = illumination or IlluminationModel({})
        self.parameters = scene.trainable() | {f"illumination.{n}": t for n, t in self.illumination.tensors.items()}
        typical = typical_radiance(
            torch.cat([t[m > 0].flatten() for t, m in zip(self.targets, self.masks, strict=True)])
        )
        unit = UNIT * (CALIBRATED_SHARE if scene.absolute else 1.0)  # as of `calibrated` options
        self.scale = robust_scale(options.loss, options.robust, typical, unit=unit)
        for p in self.parameters.values():
            p.requires_grad_(True)
        groups = [{"params": [p], "name": n} for n, p in self.parameters.items()]
        self.adam = Adam(groups, lr=0.0, betas=BETAS)
        # colours take steps in proportion to the brightness of the images, where that is not stretched to [0, 1]
        self.brightness = min(1.0, 3 * typical) if scene.absolute else 1.0
        self.visibility: list[Tensor | None] = [None] * len(views)
        self.weights = [m.to(scene.height.dtype) for m in self.masks]
        self.quadrature = make_quadrature(settings.softness[0], settings.z_range)

    def run(self, start: int, on_epoch: Callable[[int, float], bool]) -> bool:
        """Train from epoch ``start`` (a multiple of REFRESH) to the end of the stage.

        ``on_epoch(done, loss)`` is called after every epoch with the number of finished epochs; False stops.

        Returns:
            False if stopped.
        """
        if start % REFRESH:
            raise ValueError(f"start epoch {start}: expected a multiple of {REFRESH}")
        for epoch in range(start, self.settings.epochs):
            self._prepare(epoch)
            edge_aware = edge_weights(self.scene.albedo)
            order = np.random.default_rng([self.options.seed, self.index, epoch]).permutation(len(self.views))
            losses = [self._step(int(j), edge_aware, epoch) for j in order]
            if not on_epoch(epoch + 1, float(np.mean(losses))):
                return False
        for p in self.parameters.values():
            p.requires_grad_(False)
        return True

    def _rate(self, name: str) -> float:
        return (
            self.illumination.rate(name.removeprefix("illumination."))
            if name.startswith("illumination.")
            else RATES[name]
        )

    def _prepare(self, epoch: int) -> None:
        """Softness, step lengths and, every REFRESH epochs, sun visibility and poses."""
        share = epoch / max(1, self.settings.epochs - 1)
        first, last = self.settings.softness
        softness = first * (last / first) ** share
        self.quadrature = make_quadrature(softness, self.settings.z_range)
        # steps shrink towards the end of a stage, so that the noise of single views averages out
        decay = 1 - 0.7 * share
        for group in self.adam.param_groups:
            rate = self.options.height_rate * softness if group["name"] == "height" else self._rate(group["name"])
            rate *= self.brightness if group["name"] == "albedo" else 1.0
            group["lr"] = decay * rate
        if epoch % REFRESH == 0:
            if self.options.shadow != "none":
                height = self.scene.casting().detach()
                suns = {v.sun for v in self.views if v.sun}
                cast = {sun: self.cast(height, self.settings.cell_size, sun) for sun in suns}
                self.visibility = [cast[v.sun] if v.sun else None for v in self.views]
            self._weigh_walls()
            if self.options.pose and epoch and not self.scene.held:
                self._refine_poses()
            if epoch:
                self.scene.refresh(self.views, self.visibility)

    @torch.no_grad()
    def _weigh_walls(self) -> None:
        """Rays that meet a wall do not count: a height map has no room for a facade's colours.

        Left in, the facades that oblique views show would be painted on cells beside the wall, and the wall would move
        out to make room for them.
        """
        height = self.scene.height.detach()[None]
        span = max_pool2d(height, 3, 1, 1) + max_pool2d(-height, 3, 1, 1)
        wall = (span > WALL_SLOPE * 2 * self.settings.cell_size).to(height.dtype)[0][..., None].contiguous()
        for j, view in enumerate(self.views):
            east, north = self.scene.pose[j].tolist()
            rays = ParallelRays(view.slope, view.z_ref, (east, north))
            share, _, _ = render(self.scene.height, wall, rays, self.quadrature, self.settings.cell_size, self.masks[j])
            self.weights[j] = self.masks[j] * (1 - share[..., 0]).clamp(0, 1)

    def _render(self, j: int) -> Tensor:
        view = self.views[j]
        east, north = self.scene.pose[j].tolist()
        rays = ParallelRays(view.slope, view.z_ref, (east, north))
        colour = self.scene.colour(j, self.illumination.visibility(j, view.sun, self.visibility[j]))
        rgb, _, _ = render(self.scene.height, colour, rays, self.quadrature, self.settings.cell_size, self.masks[j])
        return rgb

    def _step(self, j: int, edge_aware: EdgeWeights, epoch: int) -> float:
        options = self.options
        self.adam.zero_grad(set_to_none=True)
        error = photometric(options.loss, self._render(j), self.targets[j], self.scale if options.robust else 0.0).mean(
            -1
        )
        # in units of the robust scale, so that the other weights mean the same for every loss
        loss = (error * self.weights[j]).sum() / self.masks[j].sum().clamp_min(1) / self.scale**2
        bending = smoothness_penalty(self.scene.height, self.settings.cell_size, edge_aware, knee=self.knee)
        total = loss + self.smooth * bending + self.scene.penalty()
        if self.prior is not None:
            total = total + options.prior_weight * _prior_loss(self.scene.height, self.prior)
        epoch_of_all = epoch + 1 + self.index * self.settings.epochs
        illumination_cost = self.illumination.cost(
            j, self.views[j].sun, self.visibility[j], epoch_of_all, options, self.scale
        )
        if illumination_cost is not None:
            total = total + illumination_cost
        total.backward()
        for name in {"gain", "offset"} & self.parameters.keys():
            self.parameters[name].grad[0] = 0  # type: ignore[index]  # the first view is the gauge
        self.adam.step()
        with torch.no_grad():
            self.scene.ambient.clamp_(0.02, 1.0)
            self.scene.gain.clamp_(0.05, 20.0)
            self.scene.height.clamp_(*self.settings.z_range)
        self.illumination.clamp()
        return float(loss.detach())

    @torch.no_grad()
    def _refine_poses(self) -> None:
        """One damped least-squares step of every view's shift, less the common part that the images cannot tell."""
        cell = self.settings.cell_size
        steps = np.zeros((len(self.views), 2))
        for j, view in enumerate(self.views):
            rgb = self._render(j).cpu().numpy()
            residual = np.abs(rgb - view.target).mean(-1)
            seen = view.mask > 0
            scale = 3 * float(np.median(residual[seen])) + 1e-6 if seen.any() else 1.0
            weight = seen / (1 + (residual / scale) ** 2) ** 2
            weight[:2], weight[-2:], weight[:, :2], weight[:, -2:] = 0, 0, 0, 0
            d = np.clip(image_shift(rgb, view.target, weight), -1, 1) * cell
            steps[j] = 0.7 * d[0], -0.7 * d[1]
        pose = remove_gauge(self.scene.pose.cpu().numpy() + steps, [v.slope for v in self.views])
        self.scene.pose.copy_(torch.from_numpy(pose))

    def height_std(self) -> Tensor:
        """Standard deviation of the heights ``[H, W]`` [m] from the curvature of the photometric loss.

        The Gauss-Newton diagonal sum_j J_j^T J_j is estimated with random signs z (E[(J^T z)^2] = diag J^T J; Bekas et
        al. 2007, "An estimator for the diagonal of a matrix"), averaged over 3 x 3 cells; the noise is each image's
        robust residual, and the prior's confidence counts as one observation of a cell's accuracy. Errors of matching
        (a filled courtyard) are not in it.
        """
        height = self.scene.height
        generator = torch.Generator().manual_seed(self.options.seed)
        information = torch.zeros_like(height)
        height.requires_grad_(True)
        for j in range(len(self.views)):
            rgb = self._render(j)
            residual = (rgb.detach() - self.targets[j])[self.masks[j] > 0].abs()
            variance = max(float(1.4826 * residual.median()) ** 2, 1e-6) if residual.numel() else 1.0
            for _ in range(PROBES):
                signs = torch.randint(0, 2, rgb.shape, generator=generator).to(rgb) * 2 - 1
                signs = signs * self.masks[j][..., None]
                # the gradient of a sum: for that of a map times signs torch imports sympy
                (gradient,) = torch.autograd.grad((rgb * signs).sum(), height, retain_graph=True)
                information += gradient**2 / (PROBES * variance * rgb.shape[-1])
        height.requires_grad_(False)
        if self.prior is not None:
            information += self.prior.confidence.nan_to_num(0.0) / self.settings.cell_size**2
        information = avg_pool2d(information[None], 3, 1, 1, count_include_pad=False)[0]
        z_span = self.settings.z_range[1] - self.settings.z_range[0]
        return (1 / information.clamp_min(1e-9).sqrt()).clamp(LEAST_STD_M, z_span)

    # ---- checkpoints ------------------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """Everything that a continued run needs, as flat tensors: heights [m], colours, Adam's moments."""
        tensors = {f"scene.{n}": t.detach().cpu().clone() for n, t in self.scene.tensors().items()}
        tensors |= {f"illumination.{n}": t.detach().cpu().clone() for n, t in self.illumination.tensors.items()}
        for name, p in self.parameters.items():
            for key, value in self.adam.state.get(p, {}).items():
                tensors[f"adam.{name}.{key}"] = torch.as_tensor(value).detach().cpu().clone()
        return tensors

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Inverse of `state`."""
        with torch.no_grad():
            for name, tensor in self.scene.tensors().items():
                tensor.copy_(state[f"scene.{name}"])
            for name, tensor in self.illumination.tensors.items():
                tensor.copy_(state[f"illumination.{name}"])
        for name, p in self.parameters.items():
            prefix = f"adam.{name}."
            saved = {k[len(prefix) :]: v for k, v in state.items() if k.startswith(prefix)}
            if saved:
                self.adam.state[p] = {k: v if k == "step" else v.to(p.device) for k, v in saved.items()}


__all__ = ["REFRESH", "WALL_SLOPE", "StageSettings", "StageTrainer", "make_quadrature"]

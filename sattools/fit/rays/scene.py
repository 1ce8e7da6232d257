"""A field as rays see it: samples, light of the sun, reflectance."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

from sattools.field.constants import constant
from sattools.field.mlp import MlpField
from sattools.field.networks import EMBEDDING
from sattools.field.protocol import Field
from sattools.fit.described import Radiance
from sattools.fit.options import FitOptions
from sattools.fit.rays.losses import solar_correction
from sattools.fit.rays.rays import SKIP_M, SUN_SAMPLES, RaySet
from sattools.fit.surface.light import FIRST_EPOCH, WARM_UP_EPOCHS, shadow_regularisation, shadow_weight
from sattools.reflectance import hapke, rpv
from sattools.render.volume import RayBatch, composite, guided, seen_shares, stratified, towards_sun

HAPKE_B_MAX = 0.95
ALL_IN = 10**6  # epochs after which everything that comes in late is in
SEEN, SHOWN = 2, 4  # samples of a ray that a network at rest is asked for in training, and to be shown


@dataclass(frozen=True)
class Prediction:
    """What a field shows along R rays.

    Attributes:
        colour: ``[R, C]`` as the images have it.
        weights, t: ``[R, S]`` of the samples whose colours are seen, see `composite`.
        depth: ``[R]`` share of the path.
        mean: every head's answer along the ray, ``[R, outputs]``.
        penalty: what the losses hold against its shadows.
    """

    colour: Tensor
    weights: Tensor
    t: Tensor
    depth: Tensor
    mean: dict[str, Tensor]
    penalty: Tensor | float


class RayScene:
    """A field, and what its images have of their own.

    Args:
        field: the volume.
        rays: the pixels.
        options: of the fit.
        gain, offset: ``[V, C]`` colour relations.
        radiance: what the images' numbers are.

    Attributes:
        colour: ``gain``, ``offset`` and ``ambient``, ``[V, C]`` each.
        embedding: ``[V, E]`` of the images.
        at_rest: whether the field's density is known to be that of the surface it starts from.
    """

    def __init__(
        self,
        field: Field,
        rays: RaySet,
        options: FitOptions,
        gain: Tensor,
        offset: Tensor,
        *,
        radiance: Radiance = "relative",
    ) -> None:
        self.field, self.rays, self.options, self.radiance = field, rays, options, radiance
        self.at_rest = False
        # a surface to start from casts its shadows at once, and is told of them; from noise, the trainer plans when
        self.shaded_from, self.first_told = 0.0, 1 if field.start_density() else FIRST_EPOCH
        self.device = rays.target.device
        gain, offset = gain.to(self.device), offset.to(self.device)
        self.colour = {"gain": gain.clone(), "offset": offset.clone(), "ambient": torch.full_like(gain, 0.2)}
        random = torch.Generator("cpu").manual_seed(options.seed)  # the same beginning on every device
        self.embedding = 0.01 * torch.randn(len(rays.suns), EMBEDDING, generator=random, device="cpu").to(gain)

    def phase(self, epoch: int, share: float) -> Hashable:
        """What of a training comes in late and has; in one phase `predict` does the same with all numbers of rays.

        Args:
            epoch: from 1.
            share: of the training that is done, in [0, 1].
        """
        late = epoch >= self.first_told, epoch > FIRST_EPOCH + WARM_UP_EPOCHS
        return self.at_rest, *late, share >= self.shaded_from, share >= self.options.pretrain

    def predict(self, chosen: Tensor, epoch: int, share: float, random: torch.Generator | None) -> Prediction:
        """What the field shows along rays.

        Args:
            chosen: ``[R]`` numbers of the rays.
            epoch: from 1; what is held against learned shadows and uncertainties come in later than the first.
            share: of the training that is done; cast shadows come in after `shaded_from`, the reflectance model after
                `FitOptions.pretrain`.
            random: where along the rays to look; None = evenly.
        """
        options, rays = self.options, self.rays
        view = rays.view[chosen].long()
        batch = rays.batch(chosen)
        t = stratified(len(chosen), options.samples, random)
        if options.guided:
            near = guided(rays.depth[chosen], rays.depth_std(chosen), options.guided, random)
            t = torch.cat([t, near], dim=1).sort(dim=1).values
        t, weights, features, depth = self._seen(batch, t, random)
        sun = rays.suns[view]
        known = torch.isfinite(sun).all(dim=1)
        sun = torch.where(known[:, None], sun, constant((0.0, 0.0, 1.0), sun))

        asks = bool(self.field.heads - {"albedo"})

        def per_sample(values: Tensor) -> Tensor | None:
            return values[:, None].expand(-1, t.shape[1], -1).reshape(-1, values.shape[1]) if asks else None

        look = self.field.look(features, per_sample(sun), per_sample(self.embedding[view]))
        look = {name: value.reshape(*t.shape, -1) for name, value in look.items()}
        # fewer weights would make an uncertainty smaller
        parts = {name: weights.detach() if name == "beta" else weights for name in look}
        mean = {name: (parts[name][..., None] * value).sum(dim=1) for name, value in look.items()}
        surface = batch.start + depth.detach()[:, None] * batch.path
        s, penalty = self._sunlight(mean, surface, sun, known, epoch=epoch, share=share, random=random)
        # no albedo depends on it, whatever it is, where there is none
        normal = torch.zeros_like(sun) if rays.normal is None else rays.normal[chosen]
        geometry = normal, sun, rays.view_vectors[view]
        if options.brdf_at == "sample":
            normal, to_sun, sight = (v[:, None] for v in geometry)
            albedo = (weights[..., None] * self._reflected(look, normal, to_sun, sight, share)).sum(dim=1)
        else:
            albedo = self._reflected(mean, *geometry, share)
        if s is None:
            lit = albedo
        elif "sky" in look:  # Sat-NeRF shades every sample
            visible = look["sun"] if options.shadow == "learned" else s[:, None]
            lit = (weights[..., None] * look["albedo"] * (visible + (1 - visible) * look["sky"])).sum(dim=1)
        else:
            ambient = mean["ambient"] if "ambient" in mean else self.colour["ambient"][view]
            lit = albedo * (s + (1 - s) * ambient)
        colour = self.colour["gain"][view] * lit + self.colour["offset"][view]
        return Prediction(colour, weights, t, depth, mean, penalty)

    def _seen(
        self, batch: RayBatch, t: Tensor, random: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Samples ``[R, S]`` whose colours are seen, their weights and features ``[R S, F]``, and depths ``[R]``."""
        field = self.field
        if self.at_rest:
            weights, _ = composite(self.density(batch.points(t)), t, batch.rise)
            total, depth = weights.sum(dim=1), _depth(weights, t)
            t = seen_shares(weights, t, SEEN if random is not None else SHOWN, random)
            _, features = field.density(batch.points(t).reshape(-1, 3))
            return t, (total[:, None] / t.shape[1]).expand_as(t), features, depth
        sigma, features = field.density(batch.points(t).reshape(-1, 3))
        weights, transmittance = composite(sigma.reshape(t.shape), t, batch.rise)
        return t, weights, field.shown(features, transmittance.detach().flatten()), _depth(weights, t)

    def density(self, points: Tensor) -> Tensor:
        """Densities ``[R, S]`` [1/m] at points ``[R, S, 3]`` [m]: at rest, no network is asked."""
        flat = points.reshape(-1, 3)
        if self.at_rest and isinstance(self.field, MlpField):
            return self.field.at_rest(flat).reshape(points.shape[:-1])
        return self.field.density(flat)[0].reshape(points.shape[:-1])

    def _sunlight(
        self,
        mean: dict[str, Tensor],
        surface: Tensor,
        sun: Tensor,
        known: Tensor,
        *,
        epoch: int,
        share: float,
        random: torch.Generator | None,
    ) -> tuple[Tensor | None, Tensor | float]:
        """Visibility of the sun ``[R, 1]`` (None = all lit), and what the losses hold against it."""
        options = self.options
        extra: Tensor | float = 0.0
        tau = mean["tau"] if options.transient == "on" and "tau" in mean else None
        if options.shadow == "none":
            return tau, extra
        if options.shadow == "learned" and "sun" in mean:
            s = mean["sun"]
            weight = shadow_weight(options)
            if weight > 0 and epoch >= self.first_told:
                with torch.no_grad():
                    cast = self._towards_sun(surface, sun, random)
                only = epoch > FIRST_EPOCH + WARM_UP_EPOCHS
                extra = extra + weight * shadow_regularisation(s[:, 0], cast[:, 0], only, counted=known)
            if options.solar_weight > 0:
                # at rest all other losses ask for a fraction of what this one does
                some = slice(options.rays)
                extra = extra + options.solar_weight * self._solar_correction(surface[some], sun[some], random)
        elif share >= self.shaded_from:
            s = self._towards_sun(surface, sun, random)
        else:
            return tau, extra
        s = torch.where(known[:, None], s, 1.0)
        return (s if tau is None else tau * s), extra

    def _towards_sun(self, surface: Tensor, sun: Tensor, random: torch.Generator | None) -> Tensor:
        """Geometric visibility ``[R, 1]``: transmittance from the surface point to the highest height (EO-NeRF)."""
        batch = towards_sun(surface, sun, self.rays.top, SKIP_M)
        t = stratified(len(surface), SUN_SAMPLES, random)
        weights, _ = composite(self.density(batch.points(t)), t, batch.rise)
        return 1 - weights.sum(dim=1, keepdim=True)

    def _solar_correction(self, surface: Tensor, sun: Tensor, random: torch.Generator | None) -> Tensor:
        """Sat-NeRF, eq. 10: sum (T - s)^2 + 1 - sum T alpha s along rays of the sun through the surface points."""
        up = towards_sun(surface, sun, self.rays.top)
        batch = RayBatch(up.start + up.path, -1.5 * up.path)
        t = stratified(len(surface), SUN_SAMPLES, random)
        sigma, features = self.field.density(batch.points(t).reshape(-1, 3))
        directions = sun[:, None].expand(-1, SUN_SAMPLES, -1).reshape(-1, 3)
        s = self.field.look(features, directions, None)["sun"].reshape(t.shape)
        weights, transmittance = composite(sigma.reshape(t.shape), t, batch.rise)
        return solar_correction(weights.detach(), transmittance.detach(), s)

    def _reflected(
        self, found: dict[str, Tensor], normal: Tensor, sun: Tensor, view_vector: Tensor, share: float
    ) -> Tensor:
        """Albedo ``[..., C]``, or after the pre-training the reflectance model times cos(incidence).

        It is divided by cos(sun zenith), as top-of-atmosphere reflectance is, unless images are reflectance factors.
        """
        brdf = self.options.brdf
        if brdf == "lambert" or share < self.options.pretrain:
            return found["albedo"]
        n, s, v = (x[..., None, :] for x in (normal, sun, view_vector))
        level = 1.0 if self.radiance == "reflectance_factor" else sun[..., 2:].clamp_min(0.05)
        cosine = (normal * sun).sum(dim=-1, keepdim=True).clamp_min(0) / level
        if brdf == "rpv":
            return rpv(n, s, v, found["albedo"], found["k"], found["theta"], found["rhoc"]) * cosine
        b = found["b"].clamp_max(HAPKE_B_MAX)
        return hapke(n, s, v, found["albedo"], b, found["c"], found["theta"].clamp_min(0.1)) * cosine


def _depth(weights: Tensor, t: Tensor) -> Tensor:
    """Share ``[R]`` of the path at which a ray ends in the mean."""
    return (weights * t).sum(dim=1) + (1 - weights.sum(dim=1))


__all__ = ["ALL_IN", "HAPKE_B_MAX", "SEEN", "SHOWN", "Prediction", "RayScene"]

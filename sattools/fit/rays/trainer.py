"""Training of a field ray by ray: batches, shading, losses."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sattools.field.networks import EMBEDDING
from sattools.field.protocol import Field
from sattools.fit.adam import Adam
from sattools.fit.described import Radiance
from sattools.fit.losses import photometric
from sattools.fit.options import FitOptions
from sattools.fit.rays.followed import ColumnSteps
from sattools.fit.rays.heldout import held_out
from sattools.fit.rays.losses import beta_loss, depth_loss, solar_correction
from sattools.fit.rays.rays import SKIP_M, SUN_SAMPLES, RaySet
from sattools.fit.surface.light import FIRST_EPOCH, WARM_UP_EPOCHS, shadow_regularisation, shadow_weight
from sattools.reflectance import hapke, rpv
from sattools.render.volume import RayBatch, composite, guided, stratified, towards_sun

BETA_MIN, BETA_EPOCH = 0.05, 3  # Sat-NeRF: beta = softplus + 0.05, from the third epoch
DECAY = 0.9  # of the rate, per epoch
COLOUR_RATE, EMBEDDING_RATE = 0.004, 5e-4
HAPKE_B_MAX = 0.95
ADAM_EPSILON = 1e-8  # torch's own


@dataclass(frozen=True)
class FieldSteps:
    """How Adam moves a field's tensors.

    Attributes:
        rates: steps of those that do not take `FitOptions.rate`, by name.
        begin: share of the training before which a tensor stays as it is, by name.
        epsilon: of Adam, in the unit of a gradient.
    """

    rates: Mapping[str, float] = dataclasses.field(default_factory=dict)
    begin: Mapping[str, float] = dataclasses.field(default_factory=dict)
    epsilon: float = ADAM_EPSILON


@dataclass(frozen=True)
class Prediction:
    """What a field shows along R rays.

    Attributes:
        colour: ``[R, C]`` as the images have it.
        weights, t: ``[R, S]`` of the samples, see `composite`.
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


class RayTrainer:
    """Fits a field to rays, in place; step k is the same whenever it is taken.

    Args:
        field: what is fitted.
        rays: the pixels.
        options: of the fit.
        gain, offset: ``[V, C]`` first colour relations; the first view's stay.
        field_steps: how the field's tensors move.
        radiance: what the images' numbers are; gain and offset stay where they have one scale.
    """

    def __init__(
        self,
        field: Field,
        rays: RaySet,
        options: FitOptions,
        gain: Tensor,
        offset: Tensor,
        field_steps: FieldSteps = FieldSteps(),
        *,
        radiance: Radiance = "relative",
    ) -> None:
        self.field, self.rays, self.options = field, rays, options
        self.radiance = radiance
        self.judged = bool(field.start_density())  # whether some rays are held out
        self.at_rest = False  # whether the field's density is known to be that of the surface it starts from
        self.first_lit = 1 if self.judged else FIRST_EPOCH  # a surface to start from casts its shadows at once
        self.gauge = slice(1) if radiance == "relative" else slice(None)  # images whose gain and offset stay
        views = len(rays.suns)
        self.device = rays.target.device
        gain, offset = gain.to(self.device), offset.to(self.device)
        random = torch.Generator("cpu").manual_seed(options.seed)  # the same beginning on every device
        self.colour = {"gain": gain.clone(), "offset": offset.clone(), "ambient": torch.full_like(gain, 0.2)}
        self.columns = ColumnSteps.where_possible(field, rays, options, self.colour)
        self.embedding = 0.01 * torch.randn(views, EMBEDDING, generator=random, device="cpu").to(gain)
        self.tensors: dict[str, Tensor] = {f"field.{n}": t for n, t in field.named_tensors().items()}
        self.tensors |= {f"colour.{n}": t for n, t in self.colour.items()} | {"embedding": self.embedding}
        groups = []
        for name, tensor in self.tensors.items():
            tensor.requires_grad_(True)
            own = field_steps.rates.get(name.removeprefix("field."), options.rate)
            rate = own if name.startswith("field.") else EMBEDDING_RATE if name == "embedding" else COLOUR_RATE
            begin = field_steps.begin.get(name.removeprefix("field."), 0.0)
            groups.append({"params": [tensor], "lr": rate, "initial": rate, "begin": begin})
        fused = self.device.type == "cpu"  # in one pass over a tensor
        self.adam = Adam(groups, eps=field_steps.epsilon, fused=fused)
        self.unsaid = torch.zeros(
            2, dtype=torch.float64, device="cpu"
        )  # loss and steps since the last row of the trace
        self.plan(options.steps)

    def plan(self, steps: int) -> None:
        """Settle how many steps there will be: rates, and what comes in late, are shares of them."""
        self.steps = steps
        pixels = max(1, len(self.rays.target) // self.options.rays)
        self.epoch_steps = max(1, min(pixels, steps // 10))

    def step(self, number: int) -> float:
        """One step; its photometric loss."""
        options = self.options
        random = torch.Generator(self.device).manual_seed(options.seed * 1_000_003 + number)
        epoch = number // self.epoch_steps + 1
        for group in self.adam.param_groups:
            begun = number >= group["begin"] * self.steps
            group["lr"] = group["initial"] * DECAY ** (epoch - 1) if begun else 0.0
        chosen = self._draw(random)
        self.adam.zero_grad(set_to_none=True)
        if self.columns:
            self.columns.begin()
        loss, extra = self.losses(chosen, epoch, number / self.steps, random)
        (loss + extra).backward()
        for name in ("gain", "offset"):
            grad = self.colour[name].grad
            if grad is not None:
                grad[self.gauge] = 0
        if self.columns:
            self.columns.move(self.adam)
        else:
            self.adam.step()
        with torch.no_grad():
            self.colour["ambient"].clamp_(0.02, 1.0)
            self.colour["gain"].clamp_(0.05, 20.0)
        return float(loss.detach())

    def _draw(self, random: torch.Generator) -> Tensor:
        """Numbers ``[R]`` of the rays of a step: none that is held out, where a start is there to be judged against."""
        count, rays = self.options.rays, self.rays
        drawn = torch.randint(len(rays.target), ((1 + self.judged) * count,), generator=random, device=self.device)
        if self.judged:
            drawn = torch.cat([drawn[~held_out(rays.place[drawn], rays.view[drawn])], drawn])
        return drawn[:count]

    def losses(
        self, chosen: Tensor, epoch: int, share: float, random: torch.Generator | None
    ) -> tuple[Tensor, Tensor | float]:
        """Photometric loss of rays, and everything else that is held against the field; arguments as of `predict`."""
        options, rays = self.options, self.rays
        if self.columns and random is not None:
            shown = self.columns.colours(chosen, random)
            return photometric(options.loss, shown, rays.target[chosen], options.robust).mean(), self.field.penalty()
        seen = self.predict(chosen, epoch, share, random)
        error = photometric(options.loss, seen.colour, rays.target[chosen], options.robust)
        if options.beta and "beta" in seen.mean and epoch >= BETA_EPOCH:
            loss = beta_loss(error, seen.mean["beta"] + BETA_MIN)
        else:
            loss = error.mean()
        extra, confidence = seen.penalty, rays.confidence[chosen]
        if options.depth_weight > 0 and rays.with_depth:
            depths = (seen.depth, rays.depth[chosen])
            extra = extra + options.depth_weight * depth_loss(
                seen.weights, seen.t, *depths, confidence, rays.depth_std(chosen)
            )
        return loss, extra + self.field.penalty()

    def predict(self, chosen: Tensor, epoch: int, share: float, random: torch.Generator | None) -> Prediction:
        """What the field shows along rays.

        Args:
            chosen: ``[R]`` numbers of the rays.
            epoch: from 1; shadows and uncertainties come in later than the first.
            share: of the training that is done; the reflectance model comes in after `FitOptions.pretrain`.
            random: where along the rays to look; None = evenly.
        """
        options, rays = self.options, self.rays
        view = rays.view[chosen].long()
        batch = rays.batch(chosen)
        t = stratified(len(chosen), options.samples, random)
        if options.guided:
            near = guided(rays.depth[chosen], rays.depth_std(chosen), options.guided, random)
            t = torch.cat([t, near], dim=1).sort(dim=1).values
        points = batch.points(t)
        sigma, features = self.field.density(points.reshape(-1, 3))
        weights, transmittance = composite(sigma.reshape(t.shape), t, batch.rise)
        features = self.field.shown(features, transmittance.detach().flatten())
        sun = rays.suns[view]
        known = torch.isfinite(sun).all(dim=1)
        sun = torch.where(known[:, None], sun, sun.new_tensor([0.0, 0.0, 1.0]))

        asks = bool(self.field.heads - {"albedo"})

        def per_sample(values: Tensor) -> Tensor | None:
            return values[:, None].expand(-1, t.shape[1], -1).reshape(-1, values.shape[1]) if asks else None

        look = self.field.look(features, per_sample(sun), per_sample(self.embedding[view]))
        look = {name: value.reshape(*t.shape, -1) for name, value in look.items()}
        # fewer weights would make an uncertainty smaller
        parts = {name: weights.detach() if name == "beta" else weights for name in look}
        mean = {name: (parts[name][..., None] * value).sum(dim=1) for name, value in look.items()}
        depth = (weights * t).sum(dim=1) + (1 - weights.sum(dim=1))
        surface = batch.start + depth.detach()[:, None] * batch.path
        s, penalty = self._sunlight(look, mean, surface, sun, known, epoch=epoch, random=random)
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
            visible = look["sun"]
            lit = (weights[..., None] * look["albedo"] * (visible + (1 - visible) * look["sky"])).sum(dim=1)
        else:
            ambient = mean["ambient"] if "ambient" in mean else self.colour["ambient"][view]
            lit = albedo * (s + (1 - s) * ambient)
        colour = self.colour["gain"][view] * lit + self.colour["offset"][view]
        return Prediction(colour, weights, t, depth, mean, penalty)

    def _sunlight(
        self,
        look: dict[str, Tensor],
        mean: dict[str, Tensor],
        surface: Tensor,
        sun: Tensor,
        known: Tensor,
        *,
        epoch: int,
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
            if weight > 0 and epoch >= self.first_lit:
                with torch.no_grad():
                    cast = self._towards_sun(surface, sun, random)
                only = epoch > FIRST_EPOCH + WARM_UP_EPOCHS
                extra = extra + weight * shadow_regularisation(s[:, 0], cast[:, 0], only, counted=known)
            if options.solar_weight > 0:
                extra = extra + options.solar_weight * self._solar_correction(surface, sun, random)
        elif epoch >= self.first_lit:
            s = self._towards_sun(surface, sun, random)
        else:
            return tau, extra
        s = torch.where(known[:, None], s, 1.0)
        return (s if tau is None else tau * s), extra

    def _towards_sun(self, surface: Tensor, sun: Tensor, random: torch.Generator | None) -> Tensor:
        """Geometric visibility ``[R, 1]``: transmittance from the surface point to the highest height (EO-NeRF)."""
        batch = towards_sun(surface, sun, self.rays.top, SKIP_M)
        t = stratified(len(surface), SUN_SAMPLES, random)
        sigma, _ = self.field.density(batch.points(t).reshape(-1, 3))
        weights, _ = composite(sigma.reshape(t.shape), t, batch.rise)
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

    # ---- checkpoints ------------------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """Everything that a continued run needs, as flat tensors: weights, colours and Adam's moments."""
        tensors = {n: t.detach().cpu().clone() for n, t in self.tensors.items()}
        tensors |= {"planned": torch.tensor(self.steps, device="cpu"), "unsaid": self.unsaid.clone()}
        for name, tensor in self.tensors.items():
            for key, value in self.adam.state.get(tensor, {}).items():
                tensors[f"adam.{name}.{key}"] = torch.as_tensor(value).detach().cpu().clone()
        return tensors

    @torch.no_grad()
    def load(self, state: Mapping[str, Tensor]) -> None:
        """Inverse of `state`."""
        self.plan(int(state["planned"]))
        self.unsaid = state["unsaid"]
        for name, tensor in self.tensors.items():
            tensor.copy_(state[name])
            prefix = f"adam.{name}."
            saved = {k[len(prefix) :]: v for k, v in state.items() if k.startswith(prefix)}
            if saved:
                moments = {k: torch.empty_like(tensor).copy_(v) for k, v in saved.items() if k != "step"}
                self.adam.state[tensor] = {**saved, **moments}
        if self.columns:
            self.columns.go_on()


__all__ = ["Prediction", "RaySet", "RayTrainer"]

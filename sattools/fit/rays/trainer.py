"""Training of a field ray by ray: batches, shading, losses."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sattools.field.mlp import MlpField
from sattools.field.protocol import Field
from sattools.fit.adam import Adam
from sattools.fit.described import Radiance
from sattools.fit.losses import RADIANCES, photometric, robust_scale, typical_radiance
from sattools.fit.options import FitOptions
from sattools.fit.rays.followed import ColumnSteps
from sattools.fit.rays.heldout import held_out
from sattools.fit.rays.losses import BETA_MIN, beta_loss, depth_loss
from sattools.fit.rays.precision import multiplied
from sattools.fit.rays.rays import RaySet
from sattools.fit.rays.recorded import RecordedSteps
from sattools.fit.rays.scene import ALL_IN, SEEN, RayScene

# From noise a field is haze at first, which shades itself everywhere, and an empty scene has no shadows: it is lit
# until it has a surface. EO-NeRF's authors light two epochs, 9000 steps of 300,000.
LIT_STEPS = 10_000
LIT_SHARE = 0.5  # of the steps, at most
BETA_EPOCH = 3  # of Sat-NeRF, the first with an uncertainty
DECAY = 0.9  # of the rate, per epoch
COLOUR_RATE, EMBEDDING_RATE = 0.004, 5e-4
ADAM_EPSILON = 1e-8  # torch's own
RATE_AT_REST = 5.0  # times that of a network whose heights could drift
MOST_RAYS = 16  # times as many as before, at rest


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


class RayTrainer(RayScene):
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
        super().__init__(field, rays, options, gain, offset, radiance=radiance)
        self.robust = options.robust
        if self.robust and options.loss in RADIANCES:
            self.robust = robust_scale(options.loss, self.robust, typical_radiance(rays.target))
        self.judged = bool(field.start_density())  # whether some rays are held out
        self.asked = False  # whether it is known if its heights are better than those
        self.told = False  # whether that has been told since the training began or went on
        self.rest_from: int | None = None  # the step from which it is at rest
        self.put_back = False  # whether its heights are those that it started from
        self.gauge = slice(1) if radiance == "relative" else slice(None)  # images whose gain and offset stay
        self.columns = ColumnSteps.where_possible(field, rays, options, self.colour)
        self.tensors: dict[str, Tensor] = {f"field.{n}": t for n, t in field.named_tensors().items()}
        self.tensors |= {f"colour.{n}": t for n, t in self.colour.items()} | {"embedding": self.embedding}
        groups = []
        for name, tensor in self.tensors.items():
            tensor.requires_grad_(True)
            own = field_steps.rates.get(name.removeprefix("field."), options.rate)
            rate = own if name.startswith("field.") else EMBEDDING_RATE if name == "embedding" else COLOUR_RATE
            begin = field_steps.begin.get(name.removeprefix("field."), 0.0)
            at_rest = RATE_AT_REST if name.startswith("field.") else 1.0
            groups.append({"params": [tensor], "lr": rate, "initial": rate, "begin": begin, "at_rest": at_rest})
        # in one pass over a tensor; with a pass per operation it took a quarter of a step of `eonerf` on an H200
        cuda = self.device.type == "cuda"
        self.adam = Adam(groups, eps=field_steps.epsilon, fused=cuda or self.device.type == "cpu", capturable=cuda)
        self.recorded = RecordedSteps(self.device, self.adam) if cuda else None
        # loss and steps since the last row of the trace
        self.unsaid = torch.zeros(2, dtype=torch.float64, device="cpu")
        self.plan(options.steps)

    def rest(self, number: int) -> None:
        """From this step on, train what the surface looks like, with the rates that the training began with.

        Nothing but the few samples that a ray sees is then asked of the network, so a step has many more rays.

        Args:
            number: of the step.

        Raises:
            TypeError: the field cannot be at rest.
        """
        if not isinstance(self.field, MlpField):
            raise TypeError(f"{type(self.field).__name__}: found no surface that it could rest on")
        self.at_rest, self.rest_from, self.put_back = True, number, True
        self.plan(self.steps)

    @property
    def count(self) -> int:
        """Rays of a step."""
        options = self.options
        asked = (options.samples + options.guided) // SEEN
        return options.rays * (min(max(1, asked), MOST_RAYS) if self.at_rest else 1)

    def plan(self, steps: int) -> None:
        """Settle how many steps there will be: rates, and what comes in late, are shares of them."""
        self.steps = steps
        pixels = max(1, len(self.rays.target) // self.count)
        self.epoch_steps = max(1, min(pixels, (steps - (self.rest_from or 0)) // 10))
        if not self.field.start_density():
            self.shaded_from = min(LIT_SHARE, LIT_STEPS / max(steps, 1))

    @functools.cached_property
    def random(self) -> torch.Generator:
        """Of all steps, set anew for each: where steps are recorded, they go on drawing from the one they met."""
        return torch.Generator(self.device)

    def step(self, number: int) -> float:
        """One step; its photometric loss."""
        random = self.random.manual_seed(self.options.seed * 1_000_003 + number)
        epoch = (number - (self.rest_from or 0)) // self.epoch_steps + 1
        rates = []
        for group in self.adam.param_groups:
            begun = number >= group["begin"] * self.steps
            faster = group["at_rest"] if self.at_rest else 1.0
            rates.append(faster * group["initial"] * DECAY ** (epoch - 1) if begun else 0.0)
        chosen = self._draw(random)
        epoch, share = (ALL_IN, 1.0) if self.at_rest else (epoch, number / self.steps)
        if self.recorded:
            descend = functools.partial(self._descend, epoch=epoch, share=share, random=random)
            return float(self.recorded.step(self.phase(epoch, share), chosen, rates, descend, random))
        for group, rate in zip(self.adam.param_groups, rates, strict=True):
            group["lr"] = rate
        return float(self._descend(chosen, epoch, share, random))

    def phase(self, epoch: int, share: float) -> Hashable:
        """See `RayScene.phase`; shares of the training in [0, 1]."""
        return super().phase(epoch, share), epoch >= BETA_EPOCH

    def _descend(self, chosen: Tensor, epoch: int, share: float, random: torch.Generator) -> Tensor:
        """One step with rays and rates that are settled; its photometric loss."""
        self.adam.zero_grad(set_to_none=True)
        if self.columns:
            self.columns.begin()
        with self.multiplied():
            loss, extra = self.losses(chosen, epoch, share, random)
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
        return loss.detach()

    def multiplied(self) -> contextlib.AbstractContextManager[None]:
        """The field with layers that are multiplied as in training; what it is asked outside of it is float32."""
        return multiplied(self.field, self.options.precision)

    def _draw(self, random: torch.Generator) -> Tensor:
        """Numbers ``[R]`` of the rays of a step: none that is held out, where a start is there to be judged against."""
        count, rays = self.count, self.rays
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
            return photometric(options.loss, shown, rays.target[chosen], self.robust).mean(), self.field.penalty()
        seen = self.predict(chosen, epoch, share, random)
        error = photometric(options.loss, seen.colour, rays.target[chosen], self.robust)
        if options.beta and "beta" in seen.mean and epoch >= BETA_EPOCH:
            loss = beta_loss(error, seen.mean["beta"] + BETA_MIN)
        else:
            loss = error.mean()
        extra, confidence = seen.penalty, rays.confidence[chosen]
        if options.depth_weight > 0 and rays.with_depth and not self.at_rest:
            depths = (seen.depth, rays.depth[chosen])
            extra = extra + options.depth_weight * depth_loss(
                seen.weights, seen.t, *depths, confidence, rays.depth_std(chosen)
            )
        return loss, extra + self.field.penalty()

    # ---- checkpoints ------------------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """Everything that a continued run needs, as flat tensors: weights, colours and Adam's moments."""
        tensors = {n: t.detach().cpu().clone() for n, t in self.tensors.items()}
        where = [self.steps, self.asked, -1 if self.rest_from is None else self.rest_from]
        tensors |= {"planned": torch.tensor(where, device="cpu"), "unsaid": self.unsaid.clone()}
        for name, tensor in self.tensors.items():
            for key, value in self.adam.state.get(tensor, {}).items():
                tensors[f"adam.{name}.{key}"] = torch.as_tensor(value).detach().cpu().clone()
        return tensors

    @torch.no_grad()
    def load(self, state: Mapping[str, Tensor]) -> None:
        """Inverse of `state`."""
        planned = state["planned"].reshape(-1).tolist()
        steps, asked, rest_from = [*planned, 0, -1][:3]  # older checkpoints have but the first
        self.asked, self.at_rest = bool(asked), rest_from >= 0
        self.rest_from = rest_from if self.at_rest else None
        self.put_back = self.at_rest
        self.plan(steps)
        self.unsaid = state["unsaid"]
        for name, tensor in self.tensors.items():
            tensor.copy_(state[name])
            prefix = f"adam.{name}."
            saved = {k[len(prefix) :]: v for k, v in state.items() if k.startswith(prefix)}
            if saved:
                moments = {k: torch.empty_like(tensor).copy_(v) for k, v in saved.items() if k != "step"}
                self.adam.state[tensor] = {"step": saved["step"].to(tensor.device), **moments}
        if self.columns:
            self.columns.go_on()
        if self.recorded:
            self.recorded.forget()


__all__ = ["FieldSteps", "RayTrainer"]

"""Steps of the neural field on a CPU: rays are followed in one pass, tensors moved where a ray has ever come by."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import embedding

from sattools.field.kernels import runs_here
from sattools.field.neural import NeuralField
from sattools.field.protocol import Field
from sattools.fit.adam import Adam
from sattools.fit.options import FitOptions
from sattools.fit.rays.block_adam import BlockAdam
from sattools.fit.rays.rays import SKIP_M, SUN_SAMPLES, RaySet
from sattools.render.columns import BlockGradient, ColumnRays, follow
from sattools.render.volume import guided, stratified


class ColumnSteps:
    """What `RayTrainer` leaves to compiled kernels; without them it does the same with the field's answers.

    Args:
        field: on the CPU.
        rays: the pixels.
        options: of the fit.
        colour: relations of the views, ``gain``, ``offset`` and ``ambient`` ``[V, C]``.
    """

    def __init__(self, field: NeuralField, rays: RaySet, options: FitOptions, colour: Mapping[str, Tensor]) -> None:
        self.field, self.rays, self.options, self.colour = field, rays, options, colour
        self.suns = rays.suns.nan_to_num(0.0)  # not above the horizon: all is lit
        self.movers: list[BlockAdam] = []
        self.gradients = {n: BlockGradient.of(t) for n, t in field.named_tensors().items() if n != "presence"}

    @classmethod
    def where_possible(
        cls, field: Field, rays: RaySet, options: FitOptions, colour: Mapping[str, Tensor]
    ) -> ColumnSteps | None:
        """None where there are no kernels for these.

        Args:
            field: perhaps another than the neural one, or on another device.
            rays: the pixels.
            options: of the fit.
            colour: relations of the views' radiance.
        """
        if not isinstance(field, NeuralField) or not runs_here(rays.target, field.colour):
            return None
        plain = options.depth_weight == 0 and options.brdf == "lambert"
        return cls(field, rays, options, colour) if plain else None

    def colours(self, chosen: Tensor, random: torch.Generator) -> Tensor:
        """What rays ``[R]`` show, radiance ``[R, C]`` as the images have it, see `RayTrainer.predict`.

        Args:
            chosen: their numbers.
            random: where along the rays to look.
        """
        options, rays = self.options, self.rays
        view = rays.view[chosen].long()
        free = stratified(len(chosen), options.samples, random)
        near = guided(rays.depth[chosen], rays.depth_std(chosen), options.guided, random)
        up = free[:, :0] if options.shadow == "none" else stratified(len(chosen), SUN_SAMPLES, random)
        where = rays.place[chosen], rays.path[view], self.suns[view], free, near, up
        gradients = list(self.gradients.values())
        albedo, visible = follow(self.field, ColumnRays(*where, top=rays.top, skip=SKIP_M), gradients)
        relations = torch.cat([self.colour[name] for name in ("gain", "offset", "ambient")], dim=1)
        gain, offset, ambient = embedding(view, relations).chunk(3, dim=1)  # the way back of an index takes long
        if options.shadow != "none":
            s = visible[:, None]
            albedo = albedo * (s + (1 - s) * ambient)
        return torch.addcmul(offset, gain, albedo)

    def begin(self) -> None:
        """Forget the gradients of the last step."""
        for gradient in self.gradients.values():
            gradient.clear()

    def move(self, adam: Adam) -> None:
        """Do a step of `adam`, with its rates and moments."""
        if not self.movers:
            names = {id(tensor): name for name, tensor in self.field.named_tensors().items()}
            for group in adam.param_groups:
                for tensor in group["params"]:
                    gradient = self.gradients.get(names.get(id(tensor), ""))
                    self.movers.append(BlockAdam(tensor, group, adam.state[tensor], gradient))
        for mover in self.movers:
            mover.step()

    def go_on(self) -> None:
        """Take the moments that Adam has been given from a checkpoint."""
        self.movers.clear()


__all__ = ["ColumnSteps"]

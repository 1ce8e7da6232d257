"""Steps of the neural field on a CPU: rays are followed in one pass, tensors moved where a ray has ever come by."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sattools.field.kernels import runs_here
from sattools.field.neural import NeuralField
from sattools.field.protocol import Field
from sattools.fit.adam import Adam
from sattools.fit.options import FitOptions
from sattools.fit.rays import block_adam
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
        self.gradients = {n: BlockGradient.of(t) for n, t in field.named_tensors().items() if n != "presence"}

    @classmethod
    def where_possible(
        cls, field: Field, rays: RaySet, options: FitOptions, colour: Mapping[str, Tensor]
    ) -> ColumnSteps | None:
        """None where there are no kernels for these; arguments as of the class."""
        if not isinstance(field, NeuralField) or not runs_here(rays.target, field.colour) or options.depth_weight > 0:
            return None
        return cls(field, rays, options, colour)

    def colours(self, chosen: Tensor, random: torch.Generator) -> Tensor:
        """What rays ``[R]`` show ``[R, C]`` as the images have it, see `RayTrainer.predict`.

        Args:
            chosen: their numbers.
            random: where along the rays to look.
        """
        options, rays = self.options, self.rays
        view = rays.view[chosen].long()
        free = stratified(len(chosen), options.samples, random)
        near = guided(rays.depth[chosen], rays.depth_std(chosen), options.guided, random)
        lit = options.shadow == "none"
        up = free[:, :0] if lit else stratified(len(chosen), SUN_SAMPLES, random)
        suns = rays.suns.nan_to_num(0.0)[view]
        where = rays.place[chosen], rays.path[view], suns, free, near, up
        albedo, visible = follow(
            self.field, ColumnRays(*where, top=rays.top, skip=SKIP_M), list(self.gradients.values())
        )
        if not lit:
            s, ambient = visible[:, None], self.colour["ambient"][view]
            albedo = albedo * (s + (1 - s) * ambient)
        return self.colour["gain"][view] * albedo + self.colour["offset"][view]

    def begin(self) -> None:
        """Forget the gradients of the last step."""
        for gradient in self.gradients.values():
            gradient.clear()

    def move(self, adam: Adam) -> None:
        """Move the tensors whose gradients are kept here by the rates and moments of `adam`."""
        tensors = self.field.named_tensors()
        groups = {id(group["params"][0]): group for group in adam.param_groups}
        for name, gradient in self.gradients.items():
            tensor = tensors[name]
            block_adam.move(tensor, gradient, adam.state[tensor], groups[id(tensor)])

    def go_on(self, adam: Adam) -> None:
        """Take moments of `adam` that come from a checkpoint."""
        for name, gradient in self.gradients.items():
            if state := adam.state.get(self.field.named_tensors()[name]):
                block_adam.mark(gradient, state)


__all__ = ["ColumnSteps"]

"""Whether a trained field keeps its heights: only if rays that were held out say so."""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

from sattools.field.mlp import MlpField
from sattools.fit.losses import photometric
from sattools.fit.rays.heldout import ONE_IN, block_of, held_out, verdict
from sattools.fit.rays.losses import BETA_MIN
from sattools.fit.rays.scene import ALL_IN
from sattools.fit.rays.trainer import RayTrainer

log = logging.getLogger(__name__)
RAYS = 1024  # that are asked
AT_ONCE = 256
LEAST_BETA = 0.01  # above Sat-NeRF's least, where a softplus still has a gradient


@torch.no_grad()
def judge_heights(trainer: RayTrainer, number: int) -> list[str]:
    """Put the heights that a field started from back where it explains held-out rays no better; says which it took.

    Its colours stay as they were trained, so that the heights alone are compared. Free of heights to start from, it
    keeps its own. A network that takes those of the start is at rest, and not asked again: a run that goes on with it
    says so.

    Args:
        trainer: of the field.
        number: steps that are done.
    """
    start = {f"field.{name}": tensor for name, tensor in trainer.field.start_density().items()}
    if not start:
        return []
    told, trainer.asked, trainer.told = trainer.told, True, True
    if trainer.rest_from is not None:
        at_rest = f"{trainer.options.field}: its colours alone were trained from step {trainer.rest_from} on"
        return [] if told else [at_rest]
    rays, chosen = trainer.rays, _some(trainer)
    trained = {name: trainer.tensors[name].detach().clone() for name in start}
    with_own = held_out_losses(trainer, chosen)
    _put(trainer, start)
    block = block_of(rays.place[chosen], rays.view[chosen])
    better, text = verdict(with_own, held_out_losses(trainer, chosen), block)
    trainer.put_back = not better
    if better:
        _put(trainer, trained)
    elif isinstance(trainer.field, MlpField):
        trainer.rest(number)
        text += f"; its colours alone from step {number} on" if number < trainer.steps else ""
    text = f"{trainer.options.field}: {text}"
    log.warning(text)
    return [text]


@torch.no_grad()
def held_out_losses(trainer: RayTrainer, chosen: Tensor) -> Tensor:
    """Photometric loss ``[R]`` of rays with numbers ``[R]``, each looked at where its surface is thought to be."""
    options, target = trainer.options, trainer.rays.target
    losses = []
    for part in chosen.split(AT_ONCE) if len(chosen) else ():  # of none, one empty part would be asked for
        colour = trainer.predict(part, ALL_IN, 1.0, None).colour
        losses.append(photometric(options.loss, colour, target[part], trainer.robust).mean(dim=1))
    return torch.cat(losses) if losses else target.new_zeros(0)


def begin_uncertainty(trainer: RayTrainer) -> None:
    """Let a learned uncertainty begin at what the losses are least with, for the residuals that there are at the start.

    squared / (2 beta^2) + log(beta) / 2 is least at beta^2 = 2 squared.
    """
    field = trainer.field
    if not trainer.options.beta or not trainer.judged or not isinstance(field, MlpField):
        return
    if len(chosen := _some(trainer)):
        squared = held_out_losses(trainer, chosen).mean()
        field.begin_beta(max(math.sqrt(2 * float(squared)) - BETA_MIN, LEAST_BETA))


def _some(trainer: RayTrainer) -> Tensor:
    """Numbers of `RAYS` held-out rays, fewer in small scenes."""
    rays = trainer.rays
    random = torch.Generator(trainer.device).manual_seed(trainer.options.seed)
    drawn = torch.randint(len(rays.target), (2 * ONE_IN * RAYS,), generator=random, device=trainer.device)
    return drawn[held_out(rays.place[drawn], rays.view[drawn])][:RAYS]


def _put(trainer: RayTrainer, values: dict[str, Tensor]) -> None:
    for name, value in values.items():
        trainer.tensors[name].copy_(value)


__all__ = ["AT_ONCE", "RAYS", "begin_uncertainty", "held_out_losses", "judge_heights"]

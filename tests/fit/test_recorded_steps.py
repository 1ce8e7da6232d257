"""Steps that are recorded once and replayed do what they would have done: within a phase only rays and rates differ."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any

import pytest
import torch
from four_sides import house_trainer

from sattools.fit.presets import resolve
from sattools.fit.rays.trainer import RayTrainer

STEPS = 24


class Replayed:
    """On a CPU: the first step of a phase, done again and again with other rays, rates and random numbers."""

    def __init__(self, trainer: RayTrainer) -> None:
        self.adam = trainer.adam
        self.first: dict[Hashable, Callable[[torch.Tensor], torch.Tensor]] = {}

    def step(
        self,
        phase: Hashable,
        chosen: torch.Tensor,
        rates: Sequence[float],
        descend: Callable[[torch.Tensor], torch.Tensor],
        random: torch.Generator,
    ) -> torch.Tensor:
        for group, rate in zip(self.adam.param_groups, rates, strict=True):
            group["lr"] = rate
        return self.first.setdefault((phase, len(chosen)), descend)(chosen)


def trainer(preset: str, **given: Any) -> RayTrainer:
    return house_trainer(resolve(preset, {"width": 16, "steps": STEPS, "rays": 32, **given}))


@pytest.mark.parametrize(
    ("preset", "given", "phases"),
    [
        ("eonerf", {}, 2),  # shadows after the warm-up count where it may be dark alone
        ("satnerf", {}, 3),  # and an uncertainty comes in
        ("hapke-nerf", {"shadow": "geometric"}, 3),  # and the reflectance model
    ],
)
def test_within_a_phase_a_step_is_one_function_of_its_rays(preset: str, given: dict[str, Any], phases: int) -> None:
    one, other = trainer(preset, **given), trainer(preset, **given)
    replayed = Replayed(other)
    other.recorded = replayed
    losses = []
    for number in range(STEPS):
        if number == STEPS - 4:
            for each in (one, other):
                each.rest(number)
        losses.append((one.step(number), other.step(number)))
    assert all(found == expected for found, expected in losses)
    assert len(replayed.first) > phases  # and one at rest
    assert all(torch.equal(other.tensors[name], tensor) for name, tensor in one.tensors.items())


def test_two_steps_of_one_phase_differ() -> None:
    """Or the same loss would say nothing about the rays."""
    one = trainer("eonerf")
    assert one.step(0) != one.step(1)

"""The neural field's steps on a CPU, ray by ray in compiled kernels, are those that torch takes sample by sample."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from four_sides import house_trainer

from sattools import compiled
from sattools.field import neural
from sattools.fit.presets import resolve
from sattools.fit.rays.trainer import RayTrainer


def house(bands: int = 3, **given: Any) -> RayTrainer:
    """A house of 10 m under noise: shares, colours and relations are nowhere near where they begin."""
    options = resolve("fast", {"field": "neural", "rays": 160, "steps": 40, **given})
    trainer = house_trainer(options, bands)
    noise = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for name, tensor in trainer.tensors.items():
            tensor += (1.5 if name == "field.presence" else 0.1) * torch.randn(tensor.shape, generator=noise)
    return trainer


def answers(trainer: RayTrainer, plain: bool) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Losses of rays of all images, and the gradients of all tensors that have one."""
    columns = trainer.columns
    assert columns is not None
    trainer.columns = None if plain else columns
    trainer.adam.zero_grad(set_to_none=True)
    columns.begin()
    loss, extra = trainer.losses(torch.arange(0, len(trainer.rays.target), 3), 5, 0.5, torch.Generator().manual_seed(3))
    (loss + extra).backward()
    grads = {n: t.grad.clone() for n, t in trainer.tensors.items() if t.grad is not None}
    if not plain:
        found = columns.gradients.items()
        grads |= {f"field.{n}": torch.from_numpy(g.values.copy()).movedim(-1, 0) for n, g in found}
    trainer.columns = columns
    return torch.stack([loss.detach(), torch.as_tensor(extra).detach()]), grads


def apart(one: torch.Tensor, other: torch.Tensor) -> float:
    """Largest difference, as a share of the largest value."""
    return float((one - other).abs().max() / other.abs().max().clamp_min(1e-30))


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"shadow": "none"},
        {"guided": 0},
        {"samples": 3, "guided": 40},
        {"loss": "raw-log", "shadow": "none"},
        {"bands": 1},
        {"bands": 5, "shadow": "none"},
    ],
    ids=str,
)
def test_losses_and_gradients_are_those_of_the_twin(given: Any) -> None:
    """Without shadows to the sums' rounding.

    With them to a few thousandths of the largest: a ray ends where a thousandth of its light is left, so that those to
    the sun begin up to a millimetre elsewhere, and see none where it is less than a ten thousandth.
    """
    trainer = house(**given)
    losses, grads = answers(trainer, plain=False)
    expected, twins = answers(trainer, plain=True)
    assert losses.tolist() == pytest.approx(expected.tolist(), rel=1e-4)
    assert set(twins) <= set(grads)
    assert {"field.presence", "field.colour", "field.grid.0", "field.grid.2", "colour.gain"} <= set(twins)
    for name, twin in twins.items():
        assert apart(grads[name], twin) < (1e-5 if given.get("shadow") == "none" else 6e-3), name


def test_every_gradient_lies_in_a_block_that_is_marked() -> None:
    trainer = house()
    answers(trainer, plain=False)
    assert trainer.columns is not None
    for gradient in trainer.columns.gradients.values():
        values, marked = gradient.values.reshape(-1), gradient.touched
        reached = np.unique(np.flatnonzero(values) // 64)
        assert len(reached) > 0
        assert marked[reached].all()
        gradient.clear()
        assert not gradient.values.any()


def test_steps_are_those_of_torchs_adam() -> None:
    """Ten of them lead no value further apart than a tenth of one step of a colour, the field's smallest rate."""
    one, other = house(), house()
    other.columns = None
    for number in range(30, 40):
        assert one.step(number) == pytest.approx(other.step(number), rel=1e-4)
    for name, tensor in one.tensors.items():
        assert torch.allclose(tensor, other.tensors[name], rtol=0, atol=2e-3), name


def test_gradients_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(compiled, "MOST_THREADS", threads)
        found.append(answers(house(), plain=False))
    (losses, grads), (others, twins) = found
    assert torch.equal(losses, others)
    assert all(torch.equal(grads[name], twins[name]) for name in grads)


def test_a_continued_run_takes_the_same_steps() -> None:
    whole, broken = house(), house()
    for number in range(12):
        whole.step(number)
    for number in range(5):
        broken.step(number)
    later = house()
    later.load({name: tensor.contiguous() for name, tensor in broken.state().items()})
    for number in range(5, 12):
        later.step(number)
    assert all(torch.equal(tensor, later.tensors[name]) for name, tensor in whole.tensors.items())


def test_what_the_kernels_do_not_know_is_left_to_torch() -> None:
    assert house(depth_weight=0.1).columns is None
    trainer = house()
    assert trainer.columns is not None
    double = replace(trainer.rays, target=trainer.rays.target.double())
    assert type(trainer.columns).where_possible(trainer.field, double, trainer.options, trainer.colour) is None


def test_the_penalty_is_its_twin() -> None:
    trainer = house()
    field = trainer.field
    assert isinstance(field, neural.NeuralField)
    values, grads = [], []
    for penalty in (field.penalty, lambda: neural.plain_penalty(field.presence, field.half, field.optical)):
        field.presence.grad = None
        value = penalty()
        (3 * value).backward()
        values.append(float(value.detach()))
        grads.append(field.presence.grad)
    assert values[0] == pytest.approx(values[1], rel=1e-5)
    assert apart(*grads) < 1e-5

"""A budget of a field that is trained ray by ray: what counts, and what is said where it cannot be kept."""

import dataclasses
import logging
from typing import Any

import pytest
import torch

from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.model import FittedModel
from sattools.fit.presets import resolve
from sattools.fit.rays import job as rays_job
from sattools.fit.stage import fit

TINY = {"width": 16, "rays": 64, "steps": 40, "resolution": 2.0}


@pytest.mark.parametrize("preset", ["satnerf", "eonerf", "hapke-nerf"])
def test_a_budget_without_room_for_a_step_leaves_the_surface_that_a_network_starts_from(
    make_matched_hamlet: Any, caplog: pytest.LogCaptureFixture, preset: str
) -> None:
    scene = make_matched_hamlet()
    with caplog.at_level(logging.WARNING):
        notes = fit(scene, resolve(preset, {**TINY, "budget": 0.001}))["notes"]
    assert "stopped by the budget of 0.001 s at step 0 of 40" in notes
    assert "the budget of 0.001 s has no room to try heights of its own" in notes
    assert "the budget of 0.001 s was exceeded: " in caplog.text
    assert "held-out rays" not in caplog.text  # no step, nothing to judge
    model = FittedModel.load(scene.path(scene.products["model"]))
    assert not any(bool(model.extra[f"field.sigma.{part}"].any()) for part in ("weight", "bias"))
    assert (model.height - model.extra["base.height"]).abs().median() < 0.02
    export(scene, ExportOptions())


def test_an_interrupted_network_that_has_used_its_budget_is_judged_and_read_off_without_another_step(
    make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rays_job, "SAVE_EVERY_S", 0.0)
    monkeypatch.setattr(rays_job, "TELL_EVERY_S", 0.0)
    scene, options = make_matched_hamlet(), resolve("satnerf", TINY)

    def stop(fraction: float, message: str) -> None:
        if message.startswith("step 12/"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(scene, options, stop)
    weights = rays_job.Interrupted.load
    saved: list[Any] = []
    monkeypatch.setattr(rays_job.Interrupted, "load", lambda *given: saved.append(weights(*given)) or saved[0])
    notes = fit(scene, dataclasses.replace(options, resume=True, budget=0.001))["notes"]
    assert f"stopped by the budget of 0.001 s at step {saved[0].step} of 40" in notes
    assert saved[0].step == 11  # the one that had been saved
    model = FittedModel.load(scene.path(scene.products["model"]))
    for name, tensor in saved[0].tensors.items():
        if name.startswith("field.") and "sigma" not in name:  # whose heights are put back where they are no better
            assert torch.equal(model.extra[name], tensor), name


def test_how_long_a_fit_takes_is_not_foretold_by_the_step_that_compiles(
    make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The first fit of an installation was said to take 21 minutes, and took 20 seconds."""
    monkeypatch.setattr(rays_job, "TELL_EVERY_S", 0.0)
    now, step = [0.0], rays_job.RayTrainer.step

    def timed(self: Any, number: int) -> float:
        now[0] += 1.0 if number else 1000.0
        return step(self, number)

    monkeypatch.setattr(rays_job.RayTrainer, "step", timed)
    monkeypatch.setattr(rays_job.Trace, "seconds", lambda self: now[0])
    told: list[str] = []
    with caplog.at_level(logging.WARNING):
        fit(make_matched_hamlet(), resolve("satnerf", TINY), lambda fraction, message: told.append(message))
    steps = [text for text in told if text.startswith("step ")]
    assert steps[0].startswith("step 1/40, loss ")
    assert steps[1].startswith("step 2/40, about 38 s left, ")
    assert "this fit takes about" not in caplog.text


@pytest.mark.parametrize("step_s", [0.01, 100.0])
def test_a_long_fit_is_foretold_once_however_short_its_steps(
    make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, step_s: float
) -> None:
    """Steps of less than 0.2 s went on for hours without a word, longer ones told it four times."""
    now, step = [0.0], rays_job.RayTrainer.step

    def timed(self: Any, number: int) -> float:
        if now[0] > 10 * max(step_s, 1.0):
            raise KeyboardInterrupt
        now[0] += step_s
        return step(self, number)

    monkeypatch.setattr(rays_job.RayTrainer, "step", timed)
    monkeypatch.setattr(rays_job.Trace, "seconds", lambda self: now[0])
    options = resolve("fast", {"field": "voxel", "rays": 4, "samples": 2, "steps": 360_001, "resolution": 8.0})
    with caplog.at_level(logging.WARNING), pytest.raises(KeyboardInterrupt):
        fit(make_matched_hamlet(), options)
    assert caplog.text.count("this fit takes about") == 1
    assert f"this fit takes about {'60 min' if step_s == 0.01 else '417 days'}; --budget" in caplog.text

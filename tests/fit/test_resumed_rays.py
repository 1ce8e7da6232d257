"""Fields of rays that were interrupted early, or whose budget changed on the way."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from sattools.fit.checkpoint import load
from sattools.fit.presets import resolve
from sattools.fit.rays import job as rays_job
from sattools.fit.stage import fit
from sattools.fit.trace import Trace
from sattools.scene import Scene

TINY = resolve("satnerf", {"width": 16, "rays": 64, "steps": 60, "resolution": 2.0})


@pytest.fixture(autouse=True)
def _saved_and_told_after_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rays_job, "SAVE_EVERY_S", 0.0)
    monkeypatch.setattr(rays_job, "TELL_EVERY_S", 0.0)


def interrupt(scene: Scene, options: Any, words: str) -> None:
    def progress(fraction: float, message: str) -> None:
        if message.startswith(words):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(scene, options, progress)


def told_by(scene: Scene, options: Any) -> list[str]:
    told: list[str] = []
    fit(scene, options, lambda fraction, message: told.append(message))
    return told


def test_a_network_that_was_interrupted_before_its_first_row_goes_on(make_matched_hamlet: Any) -> None:
    """It ends as one that was not; a slow one has none for minutes, but a checkpoint every half minute."""
    whole, scene = make_matched_hamlet("WHOLE"), make_matched_hamlet("CUT")
    fit(whole, TINY)
    interrupt(scene, TINY, "step 2/")  # of 60; every third has a row
    assert load(scene.path("fit/checkpoint.safetensors"))[1]["rows"] == []
    fit(scene, replace(TINY, resume=True))
    one, other = (load(s.path("fit/model.safetensors"))[0] for s in (whole, scene))
    assert one.keys() == other.keys()
    for name, tensor in one.items():
        assert torch.equal(tensor, other[name]), name


def test_seconds_since_the_last_row_count_when_a_fit_goes_on(make_matched_hamlet: Any) -> None:
    scene = make_matched_hamlet()
    interrupt(scene, TINY, "step 5/")
    saved = load(scene.path("fit/checkpoint.safetensors"))[1]
    assert saved["step"] == 4
    assert saved["seconds"] > saved["rows"][-1]["seconds"]
    trace = Trace()
    trace.go_on(saved["rows"], 40.0)
    assert trace.offset == 40.0
    trace.go_on(saved["rows"])  # an older checkpoint does not say
    assert trace.offset == saved["rows"][-1]["seconds"]


def test_without_the_budget_of_before_all_steps_are_planned_for(
    make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rates of the steps beyond the plan would have been next to nothing."""
    scene = make_matched_hamlet()
    monkeypatch.setattr(rays_job.RayJob, "_plan_within", lambda job, *given: job.trainer.plan(20))
    interrupt(scene, replace(TINY, budget=1000.0), "step 9/20")
    told = told_by(scene, replace(TINY, resume=True))
    assert any(message.startswith("step 60/60, about 0 s left") for message in told)


def test_a_budget_that_comes_with_the_resuming_plans_what_is_left(
    make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a reflectance model, and whatever else comes in late, would never come in."""
    scene = make_matched_hamlet()
    interrupt(scene, TINY, "step 9/60")
    planned: list[int] = []
    monkeypatch.setattr(rays_job.RayJob, "_plan_within", lambda job, options, number, *given: planned.append(number))
    fit(scene, replace(TINY, resume=True, budget=1000.0))
    assert planned[0] == 13  # five steps after the eighth, which had been saved

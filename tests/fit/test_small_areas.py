"""Areas so small that no block of rays can be held out."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from sattools import api
from sattools.fit.checkpoint import load
from sattools.fit.presets import resolve
from sattools.fit.stage import fit


@pytest.mark.parametrize(("preset", "given"), [("fast", {"field": "neural"}), ("eonerf", {"width": 16})])
def test_an_area_of_eight_metres_keeps_the_heights_that_a_field_starts_from(
    make_hamlet: Any, preset: str, given: dict[str, Any]
) -> None:
    scene = make_hamlet()
    whole = scene.require_grid()
    scene = api.match(replace(scene, grid=whole.part(slice(10, 26), slice(12, 28))))
    notes = fit(scene, resolve(preset, {"steps": 10, "rays": 64, **given}))["notes"]
    field = given.get("field", "mlp")
    told = f"{field}: no image has enough blocks of rays to hold some out; kept the heights it started from"
    assert any(note.startswith(told) for note in notes)
    tensors = load(scene.path("fit/model.safetensors"))[0]
    assert tensors["height"].shape == (16, 16)
    assert bool(torch.isfinite(tensors["height"]).all())

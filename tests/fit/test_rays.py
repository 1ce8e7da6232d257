"""Fields that are trained ray by ray: losses, presets, and the way from images to a surface."""

import json
import math
import tomllib
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from towns import copied

from sattools.cli import main
from sattools.compare import compare_dsm, read_reference
from sattools.errors import SattoolsError, SceneError
from sattools.fit.checkpoint import load
from sattools.fit.options import FitOptions
from sattools.fit.presets import PRESETS, resolve
from sattools.fit.rays.losses import beta_loss, depth_loss, solar_correction
from sattools.fit.stage import fit
from sattools.scene import Grid, Scene

PAPERS = [name for name in PRESETS if name != "fast"]
TINY = {"width": 16, "rays": 64, "samples": 12, "steps": 20, "resolution": 2.0, "rate": 2e-3}


def tiny(preset: Any, **more: Any) -> Any:
    few = {"guided": 8} if PRESETS[preset].get("guided") else {}
    return resolve(preset, {**TINY, **few, **more})


def test_beta_loss_by_hand() -> None:
    """0.02 / (2 * 0.1^2) + (3 + ln 0.1) / 2 and 0.08 / (2 * 0.2^2) + (3 + ln 0.2) / 2, averaged."""
    found = beta_loss(torch.tensor([[0.02], [0.08]]), torch.tensor([[0.1], [0.2]]))
    assert float(found) == pytest.approx(((1 + (3 + math.log(0.1)) / 2) + (1 + (3 + math.log(0.2)) / 2)) / 2)
    # least at the root mean square of the residual: d/dbeta = 0 where beta^2 = 2 * squared
    beta = torch.linspace(0.05, 1, 2000)
    losses = torch.stack([beta_loss(torch.tensor([[0.02]]), b.reshape(1, 1)) for b in beta])
    assert float(beta[losses.argmin()]) == pytest.approx(0.2, abs=0.001)


def test_solar_correction_by_hand() -> None:
    """(1 - 0.8)^2 + (0.5 - 0.4)^2 + 1 - (0.5 * 0.8 + 0.5 * 0.4)."""
    found = solar_correction(torch.tensor([[0.5, 0.5]]), torch.tensor([[1.0, 0.5]]), torch.tensor([[0.8, 0.4]]))
    assert float(found) == pytest.approx(0.04 + 0.01 + 0.4)


def test_depths_count_only_where_ray_and_prior_disagree_or_the_ray_is_unsure() -> None:
    t = torch.tensor([[0.40, 0.42], [0.40, 0.42], [0.1, 0.9]])
    weights = torch.full((3, 2), 0.5)
    depth = (weights * t).sum(dim=1)
    prior, confidence, std = torch.tensor([0.45, 0.8, 0.5]), torch.tensor([1.0, 0.5, 1.0]), torch.tensor([0.1] * 3)
    found = depth_loss(weights, t, depth, prior, confidence, std)
    # the first agrees within 0.1; the second is 0.39 off with half the confidence; the third is right but spread
    assert float(found) == pytest.approx(0.5 * (2 * 0.39) ** 2 / 3, rel=1e-4)


@pytest.mark.parametrize("preset", PAPERS)
def test_presets_take_the_papers_values_from_noise_and_what_is_given_wins(preset: Any) -> None:
    options = resolve(preset, {"start": "noise"})
    assert (options.field, options.rate, options.rays, options.steps) == ("mlp", 5e-4, 1024, 300000)
    assert options.samples + options.guided == (64 if preset == "satnerf" else 128)
    assert resolve(preset, {"samples": 7}).samples == 7


@pytest.mark.parametrize("preset", PAPERS)
def test_from_a_surface_few_samples_and_steps_do(preset: Any) -> None:
    options = resolve(preset, {})
    assert options.start == "surface"
    assert (options.samples, options.guided, options.rays, options.steps) == (8, 16, 256, 2000)
    assert options.prior_weight > 0  # there must be a prior
    assert options.shadow == ("learned" if preset in ("satnerf", "eonerf-learned-shadow") else "geometric")
    assert resolve(preset, {"shadow": "none"}).shadow == "none"
    # losses stay the paper's: dense depths only where it has them
    assert (options.depth_weight > 0) == (preset in ("spsnerf", "rpv-nerf", "hapke-nerf"))


def test_papers_weights() -> None:
    sat, shadow, sps = (resolve(name, {"start": "noise"}) for name in ("satnerf", "eonerf-learned-shadow", "spsnerf"))
    assert (sat.solar_weight, sat.beta, sat.loss) == (0.05, True, "mse")
    assert (shadow.shadow_weight, shadow.loss, shadow.beta, shadow.transient) == (0.01, "raw-log", False, "off")
    assert (sps.samples, sps.guided, sps.depth_weight) == (64, 64, 1 / 3)


def test_the_command_prints_the_resolved_preset() -> None:
    printed = CliRunner().invoke(main, ["fit", "--preset", "satnerf", "--loss", "raw-gamma", "--print-config"]).output
    assert 'network = "satnerf"' in printed
    assert "solar-weight = 0.05" in printed
    assert 'loss = "raw-gamma"' in printed
    assert printed.startswith("# What differs from the papers")
    assert tomllib.loads(printed)["fit"]["network"] == "satnerf"
    assert 'field = "surface"' in CliRunner().invoke(main, ["fit", "--print-config"]).output


def test_a_voxel_field_stays_by_the_prior(make_matched_hamlet: Any) -> None:
    """A free density grid drifts away from it: 300 steps took the error of such a town from 1.2 to 2.1 m."""
    scene = make_matched_hamlet()
    fit(scene, FitOptions(field="voxel", resolution=2.0, rays=256, samples=32, steps=40))
    tensors, meta = load(scene.path("fit/model.safetensors"))
    truth = read_reference(str(scene.path(scene.products["truth_dsm"])))
    grid = Grid.from_dict(meta["grid"])
    error = compare_dsm(tensors["height"].numpy(), truth, grid).figures["mae"]
    flat = compare_dsm(np.full(grid.shape, np.nanmean(truth.heights), np.float32), truth, grid).figures["mae"]
    assert error < 0.4 * flat


def test_a_budget_stops_the_training(make_matched_hamlet: Any) -> None:
    scene = make_matched_hamlet()
    found = fit(scene, tiny("eonerf", steps=100000, budget=0.5))
    assert found["notes"][0].startswith("stopped by the budget of 0.5 s at step ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "eonerf", "start": "noise", "guided": 8}, "--guided: found no prior"),
        ({"preset": "eonerf", "prior_weight": 0.0, "guided": 0}, "--start surface: found no prior"),
        ({"preset": "eonerf", "shadow": "learned"}, "network eonerf has no head for it"),
        ({"preset": "spsnerf", "solar_weight": 0.1}, "--solar-weight: expected a network with learned shadows"),
        ({"preset": "eonerf", "transient": "auto"}, "expected --field surface"),
        ({"preset": "hapke-nerf", "brdf": "auto"}, "--brdf auto: expected --field surface"),
        ({"preset": "eonerf", "brdf": "hapke"}, "network eonerf has no head for it, expected --network hapke"),
        ({"preset": "rpv-nerf", "brdf": "hapke"}, "network rpv has no head for it, expected --network hapke"),
        ({"preset": "hapke-nerf", "start": "noise", "prior_weight": 0.0, "guided": 0}, "no prior for its normals"),
        ({"preset": "hapke-nerf", "normals": "analytic"}, "expected --normals prior"),
        ({"preset": "hapke-nerf", "field": "voxel"}, "--brdf hapke: a voxel field has no head for it"),
    ],
)
def test_what_cannot_work_is_refused(make_matched_hamlet: Any, options: Any, message: Any) -> None:
    with pytest.raises(SceneError, match=message):
        fit(make_matched_hamlet(), tiny(**options))


@pytest.mark.parametrize("preset", ["eonerf", "fast"])
def test_steps_of_more_samples_than_memory_holds_are_refused(make_matched_hamlet: Any, preset: Any) -> None:
    field = "mlp" if preset == "eonerf" else "voxel"
    options = FitOptions(preset=preset, field=field, rays=1 << 20, samples=4096)
    with pytest.raises(SattoolsError, match=r"--rays 1048576: 4294967296 samples a step: .*fewer --rays or --samples"):
        fit(make_matched_hamlet(), options)


@pytest.fixture(scope="module")
def theta_at_the_start(matched_hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> torch.Tensor:
    scene = copied(matched_hamlet_source, tmp_path_factory.mktemp("start") / "HAMLET")
    fit(scene, tiny("hapke-nerf", steps=1, rate=0.0))
    return theta(scene)


def theta(scene: Scene) -> torch.Tensor:
    """Weights of a head of Hapke's model."""
    return load(scene.path("fit/model.safetensors"))[0]["field.theta.0.weight"]


@pytest.mark.parametrize(
    ("options", "moved"),
    [
        ({}, True),  # the first of two steps is the pre-training's fifth
        ({"brdf": "lambert"}, False),
        ({"pretrain": 0.9}, False),
        ({"pretrain": 0.0}, True),
    ],
)
def test_a_head_of_the_reflectance_model_learns_only_while_the_model_is_asked_for(
    theta_at_the_start: torch.Tensor, make_matched_hamlet: Any, options: Any, moved: Any
) -> None:
    scene = make_matched_hamlet()
    fit(scene, tiny("hapke-nerf", steps=2, **options))
    assert torch.equal(theta(scene), theta_at_the_start) != moved


@pytest.mark.slow
@pytest.mark.parametrize("preset", PAPERS)
def test_every_preset_learns_the_town(make_town: Any, preset: Any) -> None:
    """A minute on one core from noise: the photometric loss falls and the surface beats a level plane."""
    scene = make_town()
    few = {"guided": 16} if PRESETS[preset].get("guided") else {}
    options = resolve(
        preset,
        {
            "start": "noise",
            "width": 64,
            "rays": 256,
            "samples": 24,
            "steps": 250,
            "resolution": 1.0,
            "rate": 2e-3,
            "beta": False,
            **few,
        },
    )
    losses = []
    fit(scene, options, lambda share, text: losses.append(text))
    steps = [float(text.split("loss ")[1]) for text in losses if "loss" in text]
    assert steps[-1] < 0.7 * steps[1]
    tensors, meta = load(scene.path("fit/model.safetensors"))
    truth = read_reference(str(scene.path(scene.products["truth_dsm"])))
    grid = Grid.from_dict(meta["grid"])
    error = compare_dsm(tensors["height"].numpy(), truth, grid).figures["mae"]
    flat = compare_dsm(np.full(grid.shape, np.nanmean(truth.heights), np.float32), truth, grid).figures["mae"]
    assert error < 0.85 * flat, json.dumps({"error": error, "flat": flat})

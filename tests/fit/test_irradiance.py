"""Learned shadows, their tie to the geometric ones, transients, and the choice between models of the light."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from towns import copied

from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.checkpoint import load
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.losses import GAMMA, photometric, robust_scale
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.fit.surface import light, light_selection
from sattools.fit.surface.light import (
    FIRST_EPOCH,
    WARM_UP_EPOCHS,
    IlluminationModel,
    shadow_regularisation,
    shadow_weight,
)
from sattools.fit.surface.light_selection import Shown, transient_share
from sattools.prior.files import read_prior
from sattools.render import sun_visibility
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster
from sattools.simulate import SimulateOptions, simulate

QUICK = FitOptions(resolution=2.0, coarsest=2.0, epochs=[4])
SUN = (0.0, 0.6, 0.8)


def test_the_regularisation_of_a_case_done_by_hand() -> None:
    """Shadowed: 0.2^2 and 0.9^2; lit (s_geo = 0.5 counts as lit): (1 - 0.6)^2 and (1 - 0.3)^2."""
    net, geometric = torch.tensor([0.2, 0.9, 0.6, 0.3]), torch.tensor([0.0, 0.49, 0.5, 1.0])
    assert float(shadow_regularisation(net, geometric, False)) == pytest.approx((0.04 + 0.81 + 0.16 + 0.49) / 4)
    # after the warm-up: only the first and the last, whose s_net is at most 0.5
    assert float(shadow_regularisation(net, geometric, True)) == pytest.approx((0.04 + 0.49) / 2)
    assert float(shadow_regularisation(net[1:3], geometric[1:3], True)) == 0.0


def test_the_geometric_shadow_gets_no_gradient() -> None:
    net, geometric = torch.tensor([0.2, 0.7], requires_grad=True), torch.tensor([0.1, 0.9], requires_grad=True)
    shadow_regularisation(net, geometric, False).backward()
    assert net.grad.tolist() == pytest.approx([0.2, -0.3])
    assert geometric.grad is None


def test_the_weight_is_the_papers_unless_one_is_given() -> None:
    assert [shadow_weight(FitOptions(loss=name)) for name in ("raw-log", "raw-gamma", "mse", "mse-gamma")] == [
        0.01, 0.01, 0.0005, 0.0005,
    ]  # fmt: skip
    assert shadow_weight(FitOptions(shadow_weight=0.3)) == 0.3


def test_the_regularisation_begins_in_the_second_epoch_and_narrows_after_the_warm_up() -> None:
    options = FitOptions(shadow="learned", shadow_weight=2.0)
    model = IlluminationModel.start(options, (3, 4), 1, torch.device("cpu"))
    dark = torch.zeros(3, 4)
    costs = [model.cost(0, SUN, dark, epoch, options, 1.0) for epoch in range(1, 20)]
    assert costs[0] is None
    net = model.net(SUN).detach()
    assert float(net.min()) > 0.5
    assert float(costs[FIRST_EPOCH - 1]) == pytest.approx(2 * float(net.square().mean()))
    assert float(costs[FIRST_EPOCH + WARM_UP_EPOCHS]) == 0.0
    assert model.cost(0, None, dark, 5, options, 1.0) is None  # a sun that is unknown


def test_a_learned_shadow_is_within_0_and_1_and_depends_on_the_sun() -> None:
    model = IlluminationModel.start(FitOptions(shadow="learned"), (8, 8), 1, torch.device("cpu"))
    model.tensors["features"].mul_(1000)
    morning, evening = model.net((0.7, 0.1, 0.7)), model.net((-0.7, 0.1, 0.7))
    for net in (morning, evening):
        assert float(net.min()) >= 0
        assert float(net.max()) <= 1
    assert not torch.allclose(morning, evening)


def test_a_learned_shadow_begins_as_the_surface_casts_it_under_every_sun() -> None:
    """Two suns and opposite shadows of a wall; before, everything is lit (0.88)."""
    model = IlluminationModel.start(FitOptions(shadow="learned"), (6, 8), 2, torch.device("cpu"))
    west = torch.ones(6, 8)
    west[:, 3:5] = 0
    suns = (SUN, (0.0, -0.6, 0.8))
    assert float(model.net(suns[0]).min()) > 0.8
    model.follow(suns, (west, west.flip(1).roll(2, dims=1)), seed=0)
    for sun, cast in zip(suns, (west, west.flip(1).roll(2, dims=1)), strict=True):
        assert float((model.net(sun) - cast).abs().max()) < 0.1
    assert not any(tensor.requires_grad for tensor in model.tensors.values())


def test_transients_only_darken_and_are_the_images_own() -> None:
    options = FitOptions(transient="on")
    model = IlluminationModel.start(options, (2, 2), 2, torch.device("cpu"))
    half = torch.full((2, 2), 0.5)
    assert model.visibility(0, SUN, half).tolist() == half.tolist()
    model.tensors["transient"][1] = torch.tensor([[0.4, 0.0], [1.7, -0.2]])
    model.clamp()
    assert model.visibility(1, SUN, half).tolist() == [[pytest.approx(0.3), 0.5], [0.0, 0.5]]
    assert model.visibility(0, SUN, None).tolist() == [[1.0, 1.0], [1.0, 1.0]]
    assert model.visibility(1, SUN, None)[0].tolist() == pytest.approx([0.6, 1.0])
    assert float(model.cost(1, SUN, None, 1, options, 1.0)) > float(model.cost(0, SUN, None, 1, options, 1.0)) == 0


def test_without_learned_shadows_and_transients_the_light_is_the_geometric_one() -> None:
    model = IlluminationModel.start(FitOptions(), (2, 2), 1, torch.device("cpu"))
    geometric = torch.rand(2, 2)
    assert model.tensors == {}
    assert model.visibility(0, SUN, geometric) is geometric
    assert model.cost(0, SUN, geometric, 9, FitOptions(), 1.0) is None


def test_the_light_on_a_finer_grid_keeps_its_values() -> None:
    model = IlluminationModel.start(FitOptions(shadow="learned", transient="on"), (4, 4), 2, torch.device("cpu"))
    model.tensors["features"] = torch.ones(4, 4, 8) * torch.arange(8.0)
    model.tensors["transient"][1] = 0.25
    finer = model.resized((8, 8), 0.5)
    assert finer.tensors["features"].shape == (8, 8, 8)
    assert finer.net(SUN)[3, 3] == pytest.approx(float(model.net(SUN)[1, 1]), abs=1e-6)
    assert finer.tensors["transient"][1].unique().tolist() == [0.25]


@pytest.mark.parametrize("name", ["mse", "mse-gamma", "raw-gamma", "raw-log"])
def test_all_losses_weigh_a_pixel_of_typical_brightness_the_same(name: Any) -> None:
    """A small residual at the median radiance, in units of the loss's scale; raw-gamma's is the tone-mapped one."""
    typical = 0.2
    predicted, target = torch.tensor([typical]), torch.tensor([typical + 1e-4], dtype=torch.float32)
    found = float(photometric(name, predicted, target)) ** 0.5 / robust_scale(name, 0.1, typical)
    slope = typical ** (1 / GAMMA - 1) / GAMMA
    assert found == pytest.approx(1e-4 * slope / 0.1, rel=2e-3)


LEARNED = replace(QUICK, epochs=[12], shadow="learned", transient="on")


@pytest.fixture
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few steps begin learned shadows and choose a model of the light: nothing here asks how well."""
    monkeypatch.setattr(light, "FOLLOW_STEPS", 60)
    monkeypatch.setattr(light_selection, "STEPS", 10)


@pytest.fixture(scope="module")
def learned(matched_hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene fitted with learned shadows and transients; tests must leave its files alone."""
    scene = copied(matched_hamlet_source, tmp_path_factory.mktemp("learned") / "HAMLET")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(light, "FOLLOW_STEPS", 60)
        fit(scene, LEARNED)
    return scene


def test_the_fit_learns_shadows_and_the_model_and_the_export_hold_them(learned: Scene, tmp_path: Path) -> None:
    scene = copied(learned, tmp_path / "HAMLET")
    tensors, meta = load(scene.path("fit/model.safetensors"))
    assert (meta["shadow"], meta["transient"]) == ("learned", "on")
    assert tensors["s_net"].shape == tensors["tau"].shape == (4, 16, 16)
    assert 0 <= float(tensors["s_net"].min()) < 0.5 < float(tensors["s_net"].max()) <= 1
    assert 0 <= float(tensors["tau"].min()) < 1
    export(scene, ExportOptions())
    array, _ = read_raster(scene.path(scene.items[2].assets["s_net"].href))
    assert np.array_equal(array[0], tensors["s_net"][2].numpy())
    assert "shadow" in scene.items[0].assets


def test_the_start_of_learned_shadows_is_an_option(make_matched_hamlet: Any) -> None:
    """After one epoch s_net lies nearer to the shadows that the prior's surface casts where it began at them."""
    apart = []
    for start in ("geometric", "lit"):
        scene = make_matched_hamlet(start.upper())
        del scene.products["prior_surroundings"]  # nothing else casts any
        fit(scene, replace(QUICK, epochs=[1], shadow="learned", shadow_start=start))
        tensors, meta = load(scene.path("fit/model.safetensors"))
        prior = DepthPrior.from_arrays(*read_prior(scene)).on(Grid.from_dict(meta["grid"]))
        cast = torch.stack([sun_visibility(prior.height, 2.0, tuple(sun)) for sun in meta["suns"]])
        apart.append(float((tensors["s_net"] - cast).abs().mean()))
    assert apart[0] < 0.5 * apart[1]


@pytest.mark.usefixtures("few_steps")
def test_a_fit_with_learned_shadows_can_be_resumed(learned: Scene, make_matched_hamlet: Any) -> None:
    broken = make_matched_hamlet("BROKEN")

    def stop(fraction: Any, message: Any) -> None:
        if "epoch 5/" in message:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(broken, LEARNED, stop)
    fit(broken, replace(LEARNED, resume=True))
    for name in ("height", "s_net", "tau"):
        assert torch.equal(*(load(s.path("fit/model.safetensors"))[0][name] for s in (learned, broken))), name


@pytest.mark.usefixtures("few_steps")
def test_auto_settles_the_light_and_says_why(tmp_path: Path) -> None:
    # six views: of fewer too few would be left to learn from
    scene = simulate(SimulateOptions(id="SIX", size=32.0, views=6, dates=3), tmp_path / "SIX")
    found = fit(scene, replace(QUICK, epochs=[1], shadow="auto", transient="auto"))
    meta = load(scene.path("fit/model.safetensors"))[1]
    shadow, transient = found["notes"][:2]
    assert shadow.startswith(f"shadow {meta['shadow']}: geometric ")
    assert shadow.endswith("(tone-mapped error of held-out views)")
    assert transient.startswith(f"transient {meta['transient']}: ")


def test_objects_that_one_image_alone_shows_are_counted() -> None:
    """Eight images of 60 x 60 level cells of random texture; one holds a dark object of 6 x 4 cells."""
    random = torch.Generator().manual_seed(0)
    texture = 0.2 + 0.1 * torch.rand(60, 60, generator=random)
    gains = torch.linspace(0.7, 1.4, 8)[:, None, None]
    images = gains * texture + 0.02 + 0.002 * torch.randn(8, 60, 60, generator=random)
    images[3, 20:26, 30:34] *= 0.3
    shown = Shown(images[..., None], torch.ones(8, 60, 60), torch.ones(8, 60, 60))
    share = transient_share(shown, torch.zeros(60, 60))
    # corners have too few odd neighbours
    assert share == pytest.approx(20 / (8 * 3600), rel=0.3)
    # not on a slope, not in the shade
    assert transient_share(shown, torch.arange(60.0).repeat(60, 1)) == 0
    assert transient_share(Shown(shown.colour, shown.weight, torch.zeros(8, 60, 60)), torch.zeros(60, 60)) == 0
    assert math.isfinite(share)

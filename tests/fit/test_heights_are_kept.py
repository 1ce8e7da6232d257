"""A field that starts from a surface shows it where it is, and leaves it only for what held-out rays confirm."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from sattools.camera.view_direction import ViewDirection
from sattools.field.mlp import MlpField
from sattools.field.networks import AGAIN
from sattools.field.surface_base import SurfaceBase
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.presets import PRESETS, resolve
from sattools.fit.rays.heldout import block_of, held_out, verdict
from sattools.fit.rays.judge import begin_uncertainty, judge_heights
from sattools.fit.rays.losses import BETA_MIN
from sattools.fit.rays.maps import read_maps
from sattools.fit.rays.scene import ALL_IN
from sattools.fit.rays.stage import STEPS
from sattools.fit.rays.start import box_over, known_light, make_field, ray_set
from sattools.fit.rays.trainer import FieldSteps, RayTrainer
from sattools.render.volume import median_share
from sattools.scene import Grid
from sattools.views import View

PAPERS = [name for name in PRESETS if name != "fast"]
FIELDS = [*PAPERS, "neural"]
CELLS = 24
GRID = Grid("EPSG:32633", 0.0, 0.0, 1.0, CELLS, CELLS)
Z_RANGE, HEIGHT = (-5.0, 25.0), 7.0
SUN = (0.0, 0.6, 0.8)
SLOPES = ((0.45, 0.1), (-0.4, 0.2), (0.1, -0.45), (0.0, 0.0), (-0.2, -0.3))


def texture() -> np.ndarray:
    """Waves of a few metres."""
    row, col = np.mgrid[:CELLS, :CELLS]
    waves = 0.35 + 0.15 * np.sin(col / 1.2) * np.cos(row / 1.4)
    return (waves[..., None] * np.array([1.0, 0.8, 0.6])).astype(np.float32)


def plane(preset: str, start: float = HEIGHT, **given: Any) -> RayTrainer:
    """A field that starts from a plane of this height [m], and five images of one of `HEIGHT`, all of it lit."""
    few = {"rays": 128, "steps": 40, **given}
    few |= {"field": "neural"} if preset == "neural" else {"width": 16}
    options = resolve("fast" if preset == "neural" else preset, few)
    views = views_from(SLOPES)
    prior = DepthPrior(torch.full(GRID.shape, start), torch.full(GRID.shape, 0.5), GRID)
    base = SurfaceBase(box_over(GRID, Z_RANGE), prior.height, torch.from_numpy(texture()), 0.5)
    if options.field == "mlp" and options.shadow != "none":
        light = known_light(views, base, torch.full((len(views), 3), 0.2), learned=options.shadow == "learned")
        base = replace(base, light=light)
    field = make_field(options, GRID, Z_RANGE, HEIGHT, 3, prior, base=base)
    ones = torch.ones(len(views), 3)
    steps = STEPS.get(options.field, FieldSteps())
    return RayTrainer(field, ray_set(views, GRID, Z_RANGE, prior), options, ones, 0 * ones, steps)


def views_from(slopes: Any) -> list[View]:
    """Images of the texture on the plane, all of it lit and seen."""
    colour, seen = texture(), np.ones(GRID.shape, np.uint8)
    return [View(str(k), colour, seen, ViewDirection(*slope), HEIGHT, SUN, 0.0) for k, slope in enumerate(slopes)]


OFF_NADIR, AZIMUTH = (0, 20, 40, 60, 75), (0, 45, 160, 270, 330)  # degrees, of five new views


@torch.no_grad()
def heights_seen(trainer: RayTrainer) -> list[float]:
    """Heights [m] at which rays from `OFF_NADIR` through the middle of the plane have lost half of their light."""
    runs = [math.tan(math.radians(angle)) for angle in OFF_NADIR]
    turns = [math.radians(angle) for angle in AZIMUTH]
    slopes = [(run * math.sin(turn), run * math.cos(turn)) for run, turn in zip(runs, turns, strict=True)]
    rays, options = trainer.rays, trainer.options
    trainer.rays = ray_set(views_from(slopes), GRID, Z_RANGE, None)
    trainer.options = replace(options, samples=600, guided=0)
    middle = CELLS // 2 * CELLS + CELLS // 2
    seen = trainer.predict(torch.arange(len(slopes)) * CELLS**2 + middle, 5, 0.5, None)
    trainer.rays, trainer.options = rays, options
    return (Z_RANGE[1] + (Z_RANGE[0] - Z_RANGE[1]) * median_share(seen.weights, seen.t)).tolist()


@pytest.mark.parametrize("name", FIELDS)
def test_a_field_that_begins_as_a_plane_has_its_height_from_any_angle(name: str) -> None:
    """3 cm: a sixteenth of its softness, half of what 600 samples in 30 m are apart."""
    trainer = plane(name)
    assert heights_seen(trainer) == pytest.approx([HEIGHT] * 5, abs=0.03)
    height = read_maps(trainer, GRID, Z_RANGE, per_image=False).height
    assert float(height.mean()) == pytest.approx(HEIGHT, abs=0.03)


def alike_at_all_heights(trainer: RayTrainer) -> None:
    """Let a network have the same colours all along a column: those of a soft surface are means over its thickness."""
    field = trainer.field
    assert isinstance(field, MlpField)
    octaves = field.network.frequencies
    upward = [2, *range(3 + 2 * octaves, 3 + 3 * octaves), *range(3 + 5 * octaves, 3 + 6 * octaves)]
    for layer in (field.trunk[0], field.trunk[AGAIN]):  # the coordinates come first
        layer.weight.data[:, upward] = 0


@pytest.mark.parametrize("name", [name for name in FIELDS if name != "neural"])
def test_a_network_that_keeps_the_heights_it_starts_from_is_read_off_as_any_other(name: str) -> None:
    """Its density asks no network then, and few samples are asked for colours."""
    trainer = plane(name, rate=1e-3)
    for number in range(5):
        trainer.step(number)
    for part, tensor in trainer.field.start_density().items():
        trainer.tensors[f"field.{part}"].data.copy_(tensor)
    alike_at_all_heights(trainer)
    some = torch.nonzero(trainer.rays.view == SLOPES.index((0.0, 0.0)))[:64, 0]  # cross one column each
    slowly, from_afar = read_maps(trainer, GRID, Z_RANGE), trainer.predict(some, ALL_IN, 1.0, None)
    trainer.rest(5)
    quickly, seen = read_maps(trainer, GRID, Z_RANGE), trainer.predict(some, ALL_IN, 1.0, None)
    torch.testing.assert_close(quickly.height, slowly.height, rtol=0, atol=1e-4)  # float32 of 30 m
    torch.testing.assert_close(quickly.height_std, slowly.height_std, rtol=0, atol=1e-4)
    torch.testing.assert_close(quickly.albedo, slowly.albedo, rtol=0, atol=1e-5)
    for own, other in ((quickly.heads, slowly.heads), (quickly.images, slowly.images)):
        assert own.keys() == other.keys()
        for part in own:
            torch.testing.assert_close(own[part], other[part], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(seen.depth, from_afar.depth, rtol=0, atol=1e-5)
    torch.testing.assert_close(seen.colour, from_afar.colour, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", FIELDS)
def test_images_of_a_plane_leave_it_where_it_is(name: str) -> None:
    """Forty steps ten times as long as the default's, from every term of the preset's loss."""
    trainer = plane(name) if name == "neural" else plane(name, rate=1e-3)
    for number in range(40):
        trainer.step(number)
    assert heights_seen(trainer) == pytest.approx([HEIGHT] * 5, abs=0.05)


@pytest.mark.parametrize("name", PAPERS)
def test_a_network_at_rest_learns_colours_alone_from_more_rays(name: str) -> None:
    trainer = plane(name, rate=1e-3, samples=8, guided=16)
    trainer.rest(0)
    assert len(trainer._draw(torch.Generator().manual_seed(0))) == 128 * 12
    before = {n: t.detach().clone() for n, t in trainer.tensors.items()}
    asked: list[int] = []
    density = trainer.field.density
    trainer.field.density = lambda points: asked.append(len(points)) or density(points)
    trainer.options = replace(trainer.options, solar_weight=0.0)  # it asks along rays to the sun
    for number in range(2):  # heads that begin at zero pass nothing on in the first
        trainer.step(number)
    assert asked == [128 * 12 * 2] * 2
    moved = {n for n, t in trainer.tensors.items() if not torch.equal(t, before[n])}
    assert {"field.trunk.0.weight", "field.albedo.1.weight", "colour.gain"} <= moved
    assert not {"field.sigma.weight", "field.sigma.bias"} & moved


def test_a_checkpoint_from_before_networks_could_rest_goes_on() -> None:
    trainer = plane("eonerf")
    state = trainer.state() | {"planned": torch.tensor(30)}
    trainer.load(state)
    assert (trainer.steps, trainer.asked, trainer.at_rest) == (30, False, False)


def test_what_only_a_network_can_do_no_other_field_is_asked_for() -> None:
    with pytest.raises(TypeError, match="NeuralField: found no surface that it could rest on"):
        plane("neural").rest(0)


def test_what_is_sure_of_nothing_does_not_sink() -> None:
    """A transient or uncertain pixel is no reason to move the surface: nothing of it reaches what the density reads."""
    for name in ("eonerf", "satnerf"):
        trainer = plane(name)
        seen = trainer.predict(torch.arange(64), 5, 0.5, None)
        seen.mean["beta"].log().mean().backward()
        grads = {name: tensor.grad for name, tensor in trainer.tensors.items() if tensor.grad is not None}
        reached = {name for name, grad in grads.items() if grad.abs().max() > 0}
        assert reached
        assert not {n for n in reached if n.startswith(("field.trunk", "field.sigma", "field.bottleneck"))}


def test_an_uncertainty_begins_where_the_loss_is_least_for_the_residuals_of_the_start() -> None:
    """The field is 0.1 too bright everywhere: sqrt(2 * 0.01) = 0.141."""
    trainer = plane("eonerf")
    trainer.rays.target -= 0.1
    begin_uncertainty(trainer)
    beta = trainer.predict(torch.arange(64), 5, 0.5, None).mean["beta"].detach() + BETA_MIN
    assert float(beta.mean()) == pytest.approx(0.141, abs=0.02)


@pytest.mark.parametrize("elevation_deg", [15, 35, 60, 90])
def test_a_plane_does_not_shade_itself(elevation_deg: float) -> None:
    trainer = plane("eonerf")
    angle = math.radians(elevation_deg)
    sun = torch.tensor([[0.0, math.cos(angle), math.sin(angle)]]).expand(64, 3)
    surface = torch.tensor([[CELLS / 2, -CELLS / 2, HEIGHT]]).expand(64, 3)
    with torch.no_grad():
        visible = trainer._towards_sun(surface, sun, torch.Generator().manual_seed(0))
    assert float(visible.mean()) > 0.97


def test_rays_of_whole_blocks_of_an_image_are_held_out() -> None:
    east, north = torch.meshgrid(torch.arange(400.0), torch.arange(400.0), indexing="ij")
    place = torch.stack([east.ravel(), -north.ravel()], dim=1)
    one, other = (held_out(place, torch.full((len(place),), view)) for view in (1, 2))
    assert float(one.float().mean()) == pytest.approx(0.1, abs=0.03)
    blocks = one.reshape(50, 8, 50, 8).float().mean(dim=(1, 3))
    # a block 8 m wide is held out as a whole, but for the row that its northern edge belongs to
    assert set(blocks[:, 1:].unique().tolist()) <= {0.0, 0.125, 0.875, 1.0}
    assert float((one & other).float().mean()) < 0.05  # in another image it is another one


def test_no_step_sees_a_ray_that_is_held_out() -> None:
    trainer = plane("eonerf")
    rays = trainer.rays
    for number in range(5):
        chosen = trainer._draw(torch.Generator().manual_seed(number))
        assert len(chosen) == 128
        assert not held_out(rays.place[chosen], rays.view[chosen]).any()
    assert held_out(rays.place, rays.view).any()


def test_the_verdict_asks_for_more_than_chance() -> None:
    block = block_of(torch.rand(4000, 2, generator=torch.Generator().manual_seed(0)) * 200, torch.zeros(4000))
    start = torch.full((4000,), 0.01)
    noise = 0.004 * torch.randn(4000, generator=torch.Generator().manual_seed(1))
    assert verdict(start + noise, start, block)[0] is False
    better, text = verdict(0.9 * start + noise, start, block)
    assert better
    assert text.startswith("its heights change the error of held-out rays by -")
    assert text.endswith("took them")
    better, text = verdict(0.995 * start, start, block)  # surely, but by half a per cent
    assert not better
    assert text.endswith("kept those it started from")
    assert not verdict(start[:3], start[:3], block[:1].expand(3))[0]


@pytest.mark.parametrize(("start", "kept"), [(HEIGHT, True), (HEIGHT - 1.0, False)])
def test_a_field_keeps_its_heights_if_they_explain_held_out_rays(start: float, kept: bool) -> None:
    """A field 1 m above the plane that it started from is put back, unless the images are of that height."""
    trainer = plane("spsnerf", start, shadow="none")
    with torch.no_grad():
        trainer.tensors["field.sigma.bias"].add_(5.0)
    assert heights_seen(trainer)[0] == pytest.approx(start + 1.0, abs=0.3)
    notes = judge_heights(trainer, 40)
    assert notes[0].startswith("mlp: its heights change the error of held-out rays by ")
    assert (heights_seen(trainer) == pytest.approx([start] * 5, abs=0.03)) == kept


def test_a_field_without_a_start_is_not_judged() -> None:
    trainer = plane("eonerf")
    trainer.field.base = None
    assert judge_heights(trainer, 40) == []

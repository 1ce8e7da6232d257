"""Every field and loss computes where its tensors are: `meta` has shapes and a place, no values, and does not mix."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from sattools.field.mlp import MlpField
from sattools.field.networks import EMBEDDING, NETWORKS
from sattools.field.neural import NeuralField
from sattools.field.protocol import Box
from sattools.field.surface_base import SurfaceBase
from sattools.field.voxel import VoxelField
from sattools.fit.losses import photometric
from sattools.fit.options import FitOptions
from sattools.fit.presets import PRESETS
from sattools.fit.rays.losses import beta_loss, depth_loss, solar_correction
from sattools.fit.rays.maps import read_maps
from sattools.fit.rays.rays import RaySet
from sattools.fit.rays.start import make_field
from sattools.fit.rays.trainer import RayTrainer
from sattools.render.volume import RayBatch, composite, guided, median_share, stratified, towards_sun
from sattools.scene import Grid

META = torch.device("meta")
BOX = Box((0.0, -8.0, 0.0), (8.0, 0.0, 20.0))


def base() -> SurfaceBase:
    return SurfaceBase(BOX, torch.zeros(8, 8, device=META), torch.zeros(8, 8, 3, device=META), 0.5)


def fields() -> dict[str, Any]:
    made: dict[str, Any] = {"voxel": VoxelField(BOX, (9, 8, 8), base().height, base().colour)}
    made["neural"] = NeuralField(BOX, base())
    for name, network in NETWORKS.items():
        field = made[name] = MlpField(network, BOX, 3, width=16, base=base())
        layers = [*field.trunk, field.sigma, *(layer for head in field.head_layers.values() for layer in head)]
        for layer in layers + ([field.bottleneck] if field.bottleneck else []):
            layer.to(META)
    return made


@pytest.mark.parametrize("name", ["voxel", "neural", *NETWORKS])
def test_a_field_stays_where_it_is(name: Any) -> None:
    field = fields()[name]
    sigma, features = field.density(torch.zeros(5, 3, device=META))
    look = field.look(features, torch.zeros(5, 3, device=META), torch.zeros(5, EMBEDDING, device=META))
    answers = {"sigma": sigma, **look, **field.named_tensors()}
    if isinstance(field.penalty(), torch.Tensor):
        answers["penalty"] = field.penalty()
    assert {n for n, answer in answers.items() if answer.device != META} == set()
    assert sigma.shape == (5,)
    assert look["albedo"].shape == (5, 3)


@pytest.mark.parametrize("loss", ["mse", "mse-gamma", "raw-gamma", "raw-log"])
def test_a_loss_stays_where_it_is(loss: Any) -> None:
    colour = torch.zeros(5, 3, device=META)
    assert photometric(loss, colour, colour, 0.1).device == META


def test_what_lies_between_stays_where_it_is() -> None:
    rays, ones = torch.zeros(5, 3, device=META), torch.zeros(5, device=META)
    samples = torch.zeros(5, 7, device=META)
    weights, transmittance = composite(samples, samples, ones)
    answers = [
        weights,
        RayBatch(rays, rays).points(samples),
        towards_sun(rays, rays, 20.0).path,
        median_share(weights, samples),
        beta_loss(rays, ones[:, None]),
        solar_correction(weights, transmittance, samples),
        depth_loss(weights, samples, ones, ones, ones, ones),
    ]
    assert {answer.device for answer in answers} == {META}


def test_mixed_places_are_noticed() -> None:
    """Or this file would test nothing."""
    with pytest.raises(RuntimeError):
        fields()["neural"].density(torch.zeros(5, 3))


def trainer_on_meta(options: FitOptions) -> RayTrainer:
    """A field as its preset makes it, and twelve rays of three images, the last of which has no sun."""
    count, views = 12, 3
    one, three = torch.full((count,), 0.5), torch.full((count, 3), 0.5)
    suns = torch.tensor([[0.0, 0.6, 0.8], [0.6, 0.0, 0.8], [torch.nan] * 3])
    sights = torch.tensor([[0.0, 0.0, 1.0]]).expand(views, 3)
    path, view = torch.tensor([[0.0, 0.0, -20.0]]).expand(views, 3), torch.arange(count) % views
    rays = RaySet(three[:, :2], three, view, one, one, three, path, suns, sights, 20.0).to(META)
    with META:
        surface = torch.zeros(8, 8), torch.zeros(8, 8, 3)
        start = SurfaceBase(BOX, *surface, 0.5) if options.field != "voxel" and options.start != "noise" else None
        grid = Grid("EPSG:32633", 0.0, 0.0, 1.0, 8, 8)
        field = make_field(options, grid, (0.0, 20.0), 5.0, 3, None, base=start)
        return RayTrainer(field, rays, options, torch.ones(views, 3), torch.zeros(views, 3))


def options_of(name: str) -> FitOptions:
    given = {"field": name, "shadow": "geometric", "transient": "off"} if name in ("neural", "voxel") else PRESETS[name]
    return replace(FitOptions(), **{**given, "samples": 4, "guided": 3, "width": 16, "depth_weight": 1.0})


@pytest.mark.parametrize("name", [*(name for name in PRESETS if name != "fast"), "neural", "voxel"])
def test_a_training_step_of_every_preset_stays_on_its_device(name: str) -> None:
    trainer = trainer_on_meta(options_of(name))
    loss = one_step(trainer)
    assert loss.device == META
    moved = [n for n, tensor in trainer.tensors.items() if tensor.grad is not None and tensor.grad.device == META]
    assert len(moved) >= len(trainer.field.named_tensors()) // 2


def one_step(trainer: RayTrainer) -> torch.Tensor:
    with META:
        loss, extra = trainer.losses(torch.zeros(5, dtype=torch.long), 6, 0.9, None)
        (loss + extra).backward()
        trainer.adam.step()
    return loss


@pytest.mark.parametrize("name", [*(name for name in PRESETS if name != "fast"), "neural", "voxel"])
def test_a_second_step_brings_nothing_to_its_device(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """To bring numbers there waits for what it does, and a step that waits cannot be recorded."""
    trainer = trainer_on_meta(options_of(name))
    one_step(trainer)
    for module, function in ((torch, "tensor"), (torch, "as_tensor"), (torch, "from_numpy")):
        monkeypatch.setattr(module, function, brings)
    for method in ("new_tensor", "to", "cuda", "cpu", "numpy"):
        monkeypatch.setattr(torch.Tensor, method, brings_elsewhere(method))
    one_step(trainer)


def brings(*_: Any, **__: Any) -> Any:
    pytest.fail("numbers are brought to the device")


def brings_elsewhere(method: str) -> Any:
    plain = getattr(torch.Tensor, method)

    def checked(tensor: torch.Tensor, *given: Any, **more: Any) -> Any:
        if method == "to" and not any(isinstance(one, (str, torch.device)) for one in (*given, *more.values())):
            return plain(tensor, *given, **more)
        return brings()

    return checked


@pytest.mark.parametrize("at_rest", [False, True])
def test_reading_off_a_field_stays_on_its_device(at_rest: bool) -> None:
    options = replace(FitOptions(), **PRESETS["eonerf"], width=16)
    trainer = trainer_on_meta(options)
    if at_rest:
        trainer.rest(0)
    with META:
        maps = read_maps(trainer, Grid("EPSG:32633", 0.0, 0.0, 1.0, 8, 8), (0.0, 20.0))
    assert {maps.height.device, maps.albedo.device, *(image.device for image in maps.images.values())} == {META}


def test_random_samples_are_where_their_generator_is() -> None:
    random = torch.Generator("cpu").manual_seed(0)
    with META:  # the default device would be another
        shares = stratified(3, 4, random)
        near = guided(torch.full((3,), 0.5, device="cpu"), torch.full((3,), 0.1, device="cpu"), 4, random)
    assert shares.device == near.device == torch.device("cpu")

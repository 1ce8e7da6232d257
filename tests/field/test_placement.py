"""Every field and loss computes where its tensors are: `meta` has shapes and a place, no values, and does not mix."""

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
from sattools.fit.rays.trainer import beta_loss, depth_loss, solar_correction
from sattools.render.volume import RayBatch, composite, median_share, towards_sun

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

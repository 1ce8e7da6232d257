"""Sampling and compositing along single rays."""

import math

import pytest
import torch

from sattools.render.volume import RayBatch, composite, guided, median_share, stratified, towards_sun


def test_transmittance_through_fog_is_that_of_beer_and_lambert() -> None:
    """1.5 optical depths in 30 m."""
    t = stratified(2, 400, None)
    weights, transmittance = composite(torch.full(t.shape, 0.05), t, torch.full((2,), 30.0))
    assert weights.sum(dim=1).tolist() == pytest.approx([1 - math.exp(-1.5)] * 2, abs=1e-3)
    assert transmittance[0, 0] == 1
    assert float(transmittance[0, -1]) == pytest.approx(math.exp(-1.5), rel=0.01)
    # half of the light is gone after ln 2 / 0.05 = 13.9 m
    assert float(median_share(weights, t)[0]) * 30 == pytest.approx(math.log(2) / 0.05, abs=0.1)


def test_a_wall_takes_all_the_weight() -> None:
    t = stratified(1, 100, None)
    weights, _ = composite(torch.where(t > 0.3, 1000.0, 0.0), t, torch.tensor([50.0]))
    assert float(weights[0, 30]) == pytest.approx(1, abs=1e-6)
    assert float(median_share(weights, t)) == pytest.approx(0.3, abs=0.01)


def test_a_ray_that_meets_nothing_ends_with_its_path() -> None:
    t = stratified(1, 10, None)
    assert float(median_share(torch.zeros(1, 10), t)) == 1


def test_samples_are_one_in_each_part_or_around_the_prior() -> None:
    random = torch.Generator().manual_seed(0)
    t = stratified(50, 16, random)
    assert torch.equal((t * 16).floor(), torch.arange(16.0).expand(50, 16))
    near = guided(torch.tensor([0.5, 0.02]), torch.tensor([0.05, 0.05]), 4000, random)
    assert float((near[0] - 0.5).abs().max()) <= 0.15 + 1e-6
    assert float(near[0].std()) == pytest.approx(0.05, rel=0.05)
    assert float(near[1].min()) == 0


def test_rays_and_points() -> None:
    batch = RayBatch(torch.tensor([[1.0, 2.0, 30.0]]), torch.tensor([[4.0, 0.0, -40.0]]))
    assert batch.points(torch.tensor([[0.0, 0.5]]))[0].tolist() == [[1.0, 2.0, 30.0], [3.0, 2.0, 10.0]]
    up = towards_sun(torch.tensor([[0.0, 0.0, 10.0]]), torch.tensor([[0.6, 0.0, 0.8]]), 30.0)
    assert up.points(torch.tensor([[1.0]]))[0, 0].tolist() == pytest.approx([15.0, 0.0, 30.0])


def test_a_soft_surface_is_seen_where_it_is_by_few_samples() -> None:
    """Softness 0.02, samples 0.04 apart: parts that reach to the next sample would see it 0.01 to 0.02 too early."""
    random = torch.Generator().manual_seed(1)
    t = stratified(4000, 25, random)
    length = torch.full((4000,), 50.0)
    weights, _ = composite(torch.sigmoid((t - 0.4) / 0.02) / (0.02 * 50.0), t, length)
    # T = sigmoid(-(t - 0.4) / 0.02) crosses one half at 0.4; 0.002 is a tenth of the softness
    assert float(median_share(weights, t).mean()) == pytest.approx(0.4, abs=0.002)

"""What of a cell's brightness is its material's, and what is an error of the surface's slope."""

import math

import pytest
import torch
from torch import Tensor

from sattools.fit.materials.inversion import Samples, predict, solve_amplitudes, start_endmembers
from sattools.fit.materials.parameters import AMPLITUDE, Kind
from sattools.fit.materials.shading import tilted, told_apart

CELLS, BANDS = 3000, 3
SLOPE_ERROR = 0.06  # [m per m]


def unit(azimuth: float, zenith: float) -> Tensor:
    a, z = math.radians(azimuth), math.radians(zenith)
    return torch.tensor([math.sin(z) * math.sin(a), math.sin(z) * math.cos(a), math.cos(z)])


def hills(kind: Kind, texture: float, lit: bool = True) -> tuple[Samples, Tensor, Tensor, Tensor]:
    """Samples with wrong slopes, the true unbounded amplitudes, the endmembers and the true normals."""
    random = torch.Generator().manual_seed(7)
    slope = 0.5 * torch.randn(CELLS, 2, generator=random)
    normal = tilted(torch.tensor([[0.0, 0.0, 1.0]]).repeat(CELLS, 1), slope)
    base = AMPLITUDE[kind].raw(torch.tensor([0.3, 0.4, 0.5]))
    amplitude = base + texture * torch.randn(CELLS, 1, generator=random)
    endmembers = start_endmembers(kind, 1, base)
    sun = unit(135.0, 45.0)
    views = [unit(90.0, zenith) for zenith in (-20.0, -10.0, 1.0, 10.0, 20.0)]
    s = Samples(normal, torch.ones(CELLS, 1), torch.zeros(5, CELLS, BANDS), torch.ones(5, CELLS), [sun] * 5, views)
    s.seen = predict(kind, s, amplitude, endmembers)
    s.weight = ((normal @ sun > 0.05) & lit).float().repeat(5, 1)
    s.normal = tilted(normal, SLOPE_ERROR * torch.randn(CELLS, 2, generator=random))
    return s, amplitude, endmembers, normal


def spread(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


@pytest.mark.parametrize("kind", ["hapke", "rpv"])
def test_slopes_take_what_a_cells_material_does_not_explain(kind: Kind) -> None:
    s, truth, endmembers, true_normal = hills(kind, texture=0.05)
    lit = s.weight[0] > 0
    fitted, _ = solve_amplitudes(kind, s, endmembers, rounds=6)
    amplitude, normal = told_apart(kind, s, fitted, endmembers)
    # amplitudes alone take up all of the slopes' errors
    assert spread((amplitude - truth)[lit]) < 0.8 * spread((fitted - truth)[lit])
    # one sun tells of one direction of two, and where it is high of none; a prior of 0.2 takes little for a slope
    assert spread((normal - true_normal)[lit]) < 0.985 * spread((s.normal - true_normal)[lit])


def test_what_the_views_show_stays() -> None:
    s, _, endmembers, _ = hills("hapke", texture=0.05)
    fitted, _ = solve_amplitudes("hapke", s, endmembers, rounds=6)
    amplitude, normal = told_apart("hapke", s, fitted, endmembers)
    lit = s.weight[0] > 0
    before = predict("hapke", s, fitted, endmembers)[:, lit]
    s.normal = normal
    after = predict("hapke", s, amplitude, endmembers)[:, lit]
    # the samples count with 2 % of noise
    assert float(((after - before) / before.clamp_min(0.02)).abs().median()) < 0.01


def test_texture_on_true_slopes_stays_texture() -> None:
    s, truth, endmembers, true_normal = hills("hapke", texture=0.3)
    s.normal = true_normal
    lit = s.normal @ s.suns[0] > 0.5
    amplitude, _ = told_apart("hapke", s, truth, endmembers)
    # where the sun is high a slope of 0.06 changes little: most of the texture cannot be its doing
    kept = (amplitude - truth.mean(0))[lit] / (truth - truth.mean(0))[lit]
    assert float(kept.median()) > 0.85


def test_cells_that_no_view_shows_in_the_sun_have_their_materials_mean_and_the_surfaces_normal() -> None:
    s, truth, endmembers, _ = hills("hapke", texture=0.0)
    s.weight[:, :100] = 0
    wrong = truth.clone()
    wrong[:100] = -4.0
    amplitude, normal = told_apart("hapke", s, wrong, endmembers, slopes=False)
    assert torch.allclose(amplitude, truth, atol=1e-3)
    assert torch.equal(normal, s.normal)


def test_cells_that_the_descent_has_given_up_are_taken_from_the_views() -> None:
    s, truth, endmembers, true_normal = hills("hapke", texture=0.0)
    s.normal = true_normal
    patch = torch.nonzero(s.weight[0] > 0)[:50, 0]
    black = truth.clone()
    black[patch] = -5.0
    amplitude, _ = told_apart("hapke", s, black, endmembers)
    value = AMPLITUDE["hapke"].bounded
    assert float((value(amplitude) - value(truth))[patch].abs().median()) < 0.03


def test_views_blurred_within_their_noise_do_not_blur_what_the_descent_has_found() -> None:
    s, truth, endmembers, true_normal = hills("hapke", texture=0.05)
    s.normal = true_normal
    lit = s.normal @ s.suns[0] > 0.5
    kept = told_apart("hapke", s, truth, endmembers)[0]
    s.seen = 0.93 * s.seen  # as ground that is brighter than what is around it
    amplitude, _ = told_apart("hapke", s, truth, endmembers)
    assert float((amplitude - kept)[lit].abs().median()) < 0.002


def test_a_scene_all_in_shade_has_the_mean_of_what_it_had() -> None:
    s, truth, endmembers, _ = hills("hapke", texture=0.0, lit=False)
    amplitude, normal = told_apart("hapke", s, truth, endmembers)
    assert torch.allclose(amplitude, truth, rtol=0.01)
    assert torch.equal(normal, s.normal)


def test_a_material_of_which_nothing_is_in_the_sun_is_none_of_the_others() -> None:
    s, truth, endmembers, _ = hills("hapke", texture=0.0)
    dark = torch.arange(CELLS) < 100
    s.weight[:, dark] = 0
    s.abundances = torch.stack([~dark, dark], -1).float()
    wanted = torch.where(dark[:, None], -3.0, truth)
    amplitude, _ = told_apart("hapke", s, wanted, endmembers.repeat(2, 1), slopes=False)
    assert torch.allclose(amplitude, wanted, rtol=0.01)


@pytest.mark.parametrize("value", [-40.0, 40.0])
def test_a_material_all_black_or_white_is_no_error(value: float) -> None:
    s, truth, endmembers, _ = hills("hapke", texture=0.0)
    extreme = torch.full_like(truth, value)
    s.seen = predict("hapke", s, extreme, endmembers)
    amplitude, normal = told_apart("hapke", s, extreme, endmembers)
    assert bool(amplitude.isfinite().all())
    assert torch.allclose(normal, s.normal, atol=1e-2)


def test_a_normal_leans_by_the_slope_it_is_given() -> None:
    level = torch.tensor([[0.0, 0.0, 1.0]])
    assert torch.allclose(tilted(level, torch.tensor([[0.75, 0.0]])), torch.tensor([[0.6, 0.0, 0.8]]))

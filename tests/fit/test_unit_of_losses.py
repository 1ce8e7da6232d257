"""What --robust is counted in: tone-mapped units at the images' median, whatever the loss, the field and the images."""

import pytest
import torch
from four_sides import Z_RANGE, a_house, house_trainer

from sattools.fit.losses import robust_scale, typical_radiance
from sattools.fit.options import FitOptions
from sattools.fit.surface.scene import start_scene
from sattools.fit.surface.trainer import StageSettings, StageTrainer


def surface_trainer(options: FitOptions, absolute: bool) -> StageTrainer:
    views, prior, base = a_house()
    ones = torch.ones(len(views), 3)
    scene = start_scene(prior.height.clone(), base.colour.clone(), ones, 0 * ones, 0.4, absolute)
    return StageTrainer(scene, views, StageSettings(1.0, 4, (1.5, 0.5), Z_RANGE), options, prior, 0)


@pytest.mark.parametrize(("absolute", "unit"), [(False, 0.1), (True, 0.01)])
def test_without_outliers_a_loss_keeps_its_weight_against_the_prior(absolute: bool, unit: float) -> None:
    """That of calibrated images fell to a hundredth: --robust 0 left them the prior's heights."""
    assert surface_trainer(FitOptions(robust=0.0), absolute).scale == pytest.approx(unit)
    assert surface_trainer(FitOptions(robust=unit), absolute).scale == pytest.approx(unit)


@pytest.mark.parametrize("loss", ["mse", "mse-gamma", "raw-gamma", "raw-log"])
def test_fields_of_rays_count_as_surfaces_do(loss: str) -> None:
    options = FitOptions(field="neural", loss=loss, robust=0.1)
    assert house_trainer(options).robust == pytest.approx(surface_trainer(options, False).scale)


def test_fields_of_rays_in_radiances_and_logarithms_of_them() -> None:
    """The slope of x^(1/2.2) at 0.05 is 2.3293, and that of log(x) 20."""
    assert robust_scale("raw-gamma", 0.1, 0.05) == 0.1
    assert robust_scale("mse", 0.1, 0.05) == pytest.approx(0.1 / 2.3293, rel=1e-4)
    assert robust_scale("raw-log", 0.1, 0.05) == pytest.approx(0.1 / 2.3293 * 20, rel=1e-4)


def test_a_network_of_the_papers_counts_every_residual() -> None:
    assert house_trainer(FitOptions(field="neural", robust=0.0)).robust == 0.0


def test_the_typical_radiance_is_the_median() -> None:
    assert typical_radiance(torch.tensor([[0.1, 0.9], [0.2, 0.3]])) == pytest.approx(0.2)
    assert typical_radiance(torch.zeros(0)) == 1.0

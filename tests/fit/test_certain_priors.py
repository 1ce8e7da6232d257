"""The less noisy a prior's heights are, the less a fit of a surface smooths them."""

import math
from typing import Any

import numpy as np
import pytest

from sattools.fit.depth_prior import DepthPrior, certainty, noise
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.prior import PriorOptions
from sattools.prior.stage import prior
from sattools.scene import Grid
from sattools.scene.raster import read_raster

SHAPE = (120, 100)


def town(spread: float, slope: float = 0.0) -> Any:
    """Level ground (or a slope), a roof 10 m above a quarter of it, noise."""
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    height = slope * cols + np.where((rows < 60) & (cols < 50), 10.0, 0.0)
    return (height + np.random.default_rng(0).normal(0, spread, SHAPE)).astype(np.float32)


def weight(height: Any, cell: float = 0.5) -> float:
    grid = Grid("EPSG:32617", 0.0, 100.0, cell, SHAPE[1], SHAPE[0])
    return certainty(DepthPrior.from_arrays(height, np.ones(SHAPE, np.float32), grid))


@pytest.mark.parametrize("spread", [0.01, 0.1])
def test_noise_is_that_of_level_ground_and_roofs_not_of_walls(spread: float) -> None:
    """Of 25 cells the mean takes a part with it: 0.98 of the spread are left. A tenth: at the border slopes count."""
    assert noise(town(spread)) == pytest.approx(0.98 * spread, rel=0.1)
    assert noise(town(spread, slope=0.1)) == pytest.approx(0.98 * spread, rel=0.1)


def test_unknown_cells_are_not_looked_at() -> None:
    height = town(0.02)
    height[::20, ::7] = np.nan
    assert noise(height) == pytest.approx(0.98 * 0.02, rel=0.1)


def test_half_the_noise_is_four_times_the_weight() -> None:
    """From a twenty-fifth of a cell on; ten times at most."""
    assert weight(town(0.1)) == 1.0
    assert weight(town(0.01)) == pytest.approx(4.2, rel=0.1)
    assert weight(town(0.0)) == 10.0
    assert weight(town(0.01), cell=0.25) == pytest.approx(1.05, rel=0.1)


def test_hills_and_unknown_heights_weigh_what_they_are_told_to() -> None:
    assert math.isnan(noise(town(0.0, slope=0.4)))
    assert weight(town(0.0, slope=0.4)) == 1.0
    assert weight(np.full(SHAPE, np.nan, np.float32)) == 1.0


def test_a_fit_stays_nearer_to_a_prior_without_noise(make_town: Any, monkeypatch: Any) -> None:
    moved = []
    scene = make_town()
    prior(scene, PriorOptions(rough_passes=0, pairs=2, resolution=0.5))
    for factor in (1.0, 10.0):
        monkeypatch.setattr("sattools.fit.whole.certainty", lambda _, factor=factor: factor)
        fit(scene, FitOptions(epochs=[5], coarsest=1.0), overwrite=True)
        height = FittedModel.load(scene.path(scene.products["model"])).height.numpy()
        given, _ = read_raster(scene.path(scene.products["prior_dsm"]))
        moved.append(float(np.nanmean(np.abs(height - given[0]))))
    assert moved[1] < 0.7 * moved[0]

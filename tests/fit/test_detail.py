"""The default fit gives its surface on the prior's cells: prior and correction."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.stage import check_start, fit
from sattools.fit.surface.detail import with_detail
from sattools.prior import PriorOptions
from sattools.prior.stage import prior
from sattools.scene import Grid
from sattools.scene.raster import read_raster

FINE = Grid("EPSG:32617", 0.0, 100.0, 0.5, 31, 40)  # an odd width: the last of the coarse cells is half beyond it
COARSE = FINE.resized(1.0)


def a_prior() -> DepthPrior:
    """A wall of 10 m between the two halves of a coarse cell, and a slope along it."""
    rows, cols = np.mgrid[0:40, 0:31]
    height = np.where(cols < 15, 0.0, 10.0) + 0.1 * rows
    return DepthPrior.from_arrays(height.astype(np.float32), np.ones(FINE.shape, np.float32), FINE)


def a_model(height: Any) -> FittedModel:
    """A fit of two views on the coarse cells."""
    rows, cols = COARSE.shape
    gain = torch.ones(2, 3)
    return FittedModel(
        grid=COARSE, items=["a", "b"], suns=[None, None], height=height, height_std=torch.full(COARSE.shape, 0.2),
        albedo=torch.linspace(0, 1, rows * cols * 3).reshape(rows, cols, 3), gain=gain, offset=0 * gain,
        ambient=0 * gain, pose=torch.zeros(2, 2), tau=torch.full((2, rows, cols), 0.75),
    )  # fmt: skip


def test_a_fit_that_agrees_with_the_prior_keeps_its_walls() -> None:
    given = a_prior()
    found = with_detail(a_model(given.on(COARSE).height), given)
    assert found.grid == FINE
    torch.testing.assert_close(found.height, given.height, atol=1e-5, rtol=0)
    assert tuple(found.albedo.shape) == (40, 31, 3)
    torch.testing.assert_close(found.height_std, torch.full(FINE.shape, 0.2))
    assert found.tau is not None
    torch.testing.assert_close(found.tau, torch.full((2, 40, 31), 0.75))
    assert found.s_net is None


def test_corrections_are_carried_over_but_not_beside_walls() -> None:
    given = a_prior()
    corrected = with_detail(a_model(given.on(COARSE).height + 0.7), given).height - given.height
    torch.testing.assert_close(corrected[:, :12], torch.full((40, 12), 0.7), atol=1e-5, rtol=0)
    torch.testing.assert_close(corrected[:, 19:], torch.full((40, 12), 0.7), atol=1e-5, rtol=0)
    # what a fit on coarse cells makes of a wall is the mean of both sides
    assert float(corrected[:, 14:16].abs().max()) < 0.25 * 0.7 + 1e-5


def test_a_steep_slope_is_no_wall() -> None:
    slope = torch.linspace(0, 18.6, 31).expand(FINE.shape).contiguous()  # 1.24 metres a metre
    given = DepthPrior(slope, torch.ones(FINE.shape), FINE)
    found = with_detail(a_model(given.on(COARSE).height - 0.4), given)
    # the last coarse cell is half beyond the prior
    torch.testing.assert_close(found.height[:, :28], slope[:, :28] - 0.4, atol=1e-4, rtol=0)


def test_noise_of_the_prior_stays_only_near_walls() -> None:
    given = a_prior()
    smooth = given.on(COARSE).height
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.2, FINE.shape).astype(np.float32))
    noisy = replace(given, height=given.height + noise)
    left = with_detail(a_model(smooth), noisy).height - given.height
    assert float(left[4:-4, 4:10].abs().max()) < 1e-4
    assert float(left[4:-4, 13:17].std()) > 0.1


def test_where_there_is_no_prior_the_fit_stands() -> None:
    given = a_prior()
    given.height[10:20, 4:12] = torch.nan
    height = a_prior().on(COARSE).height + 0.5
    found = with_detail(a_model(height), given).height
    assert bool(found.isfinite().all())
    torch.testing.assert_close(found[12:18, 6:10], a_prior().height[12:18, 6:10] + 0.5, atol=0.06, rtol=0)


def test_the_default_surface_has_the_priors_cells(make_matched_hamlet: Any) -> None:
    scene = make_matched_hamlet()
    fit(scene, FitOptions(epochs=[2]))
    export(scene, ExportOptions())
    model = FittedModel.load(scene.path(scene.products["model"]))
    assert model.grid == scene.grid
    for name in ("dsm", "dsm_std", "albedo"):
        assert read_raster(scene.path(scene.products[name]))[1] == scene.grid
    # two passes move nothing far: walls are where the prior has them
    height, _ = read_raster(scene.path(scene.products["prior_dsm"]))
    assert float(np.median(np.abs(model.height.numpy() - height[0]))) < 0.3


@pytest.mark.parametrize(
    ("options", "cell"),
    [({"resolution": 1.0}, 1.0), ({"prior_weight": 0.0}, 1.0), ({"brdf": "rpv"}, 1.0), ({"resolution": 0.5}, 0.5)],
)
def test_what_has_cells_of_its_own_keeps_them(make_matched_hamlet: Any, options: Any, cell: Any) -> None:
    scene = make_matched_hamlet()
    fit(scene, replace(FitOptions(epochs=[2], coarsest=options.get("resolution", 1.0)), **options))
    assert FittedModel.load(scene.path(scene.products["model"])).grid.cell_size == cell


def test_tiles_have_the_cells_of_a_fit_at_once(make_matched_row: Any) -> None:
    scene = make_matched_row()
    fit(scene, FitOptions(epochs=[2], tile=16.0, overlap=4.0))
    model = FittedModel.load(scene.path(scene.products["model"]))
    assert model.grid == scene.grid
    height, _ = read_raster(scene.path(scene.products["prior_dsm"]))
    assert float(np.median(np.abs(model.height.numpy() - height[0]))) < 0.3


BETTER = (
    "scene TOWN: --resolution 0.25 is finer than the prior, which has cells of 0.5 m: with `sattools prior "
    "--resolution 0.25` before the fit its heights are better"
)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"resolution": 0.25}, [BETTER]),  # the fit would make a prior on the grid's cells of 0.5 m
        ({"resolution": 0.25, "tile": 32.0, "overlap": 8.0}, [BETTER]),
        ({"resolution": 0.25, "tile": 500.0}, [BETTER]),  # all in one tile
        ({"resolution": 0.46}, []),  # finer by less than a tenth
        ({"resolution": 1.0}, []),
        ({"resolution": 0.25, "prior_weight": 0.0}, []),
        ({}, []),
    ],
    ids=str,
)
def test_cells_finer_than_the_priors_are_warned_of(make_hamlet: Any, caplog: Any, options: Any, told: Any) -> None:
    check_start(make_hamlet("TOWN"), replace(FitOptions(), **options))
    assert [line for line in caplog.messages if "finer than the prior" in line] == told


def test_a_prior_of_the_fits_own_cells_is_not_warned_of(make_hamlet: Any, caplog: Any) -> None:
    scene = make_hamlet()
    prior(scene, PriorOptions(rough_passes=0, pairs=2, resolution=1.0))
    fit(scene, FitOptions(epochs=[1], coarsest=0.9, resolution=0.92))
    assert "finer than the prior" not in caplog.text
    check_start(scene, FitOptions(resolution=0.5))
    assert "--resolution 0.5 is finer than the prior, which has cells of 1 m" in caplog.text


def test_tiles_are_warned_of_a_coarse_prior_once(make_row: Any, caplog: Any) -> None:
    scene = make_row()
    prior(scene, PriorOptions(rough_passes=0, pairs=2, resolution=1.0))
    fit(scene, FitOptions(epochs=[1], resolution=0.5, tile=16.0, overlap=4.0))
    assert caplog.text.count("finer than the prior, which has cells of 1 m") == 1

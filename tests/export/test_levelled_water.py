"""Water that the prior has laid level is marked as an assumption, and nothing takes it for measured ground."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from sattools import api
from sattools.export.blocks import blocks
from sattools.export.options import ExportOptions
from sattools.export.products.maps import Maps
from sattools.export.products.points import write_laz
from sattools.export.products.terrain import INTERPOLATED, SEEN, terrain_of
from sattools.export.stage import export
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.prior.files import MAPS
from sattools.prior.stage import write_maps
from sattools.progress import silent
from sattools.scene import Grid, Scene
from sattools.scene.dependencies import drop
from sattools.scene.raster import read_raster, write_cog
from sattools.scene.validity import CLASSES, FILLED, LEVELLED, MEASURED, UNSEEN, UNWANTED

GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 1.0, 120, 80)
WATER = slice(0, 60)  # columns


@pytest.fixture
def fitted(make_hamlet: Any) -> Scene:
    """Whose prior says that the western third of it was laid level."""
    scene = make_hamlet()
    grid = scene.require_grid().resized(2.0)
    height = np.full(grid.shape, float(np.mean(scene.require_height_range())), np.float32)
    water = np.zeros(grid.shape, np.uint8)
    water[:, : grid.width // 3] = 1
    write_maps(scene, height, np.where(water, 0.0, 0.5).astype(np.float32), grid, water)
    fit(scene, FitOptions(resolution=2.0, coarsest=2.0, epochs=[2]))
    return scene


def codes(scene: Scene) -> Any:
    return read_raster(scene.path(scene.products["validity"]))[0][0]


def test_codes_that_others_rely_on_stay() -> None:
    assert (UNSEEN, MEASURED, FILLED, UNWANTED, LEVELLED) == (0, 1, 2, 3, 4)
    assert list(CLASSES) == [0, 1, 2, 3, 4]


def test_water_that_two_images_see_is_not_called_measured(fitted: Scene) -> None:
    laid = read_raster(fitted.path(fitted.products["prior_water"]))[0][0] == 1
    made = export(fitted, ExportOptions())
    found = codes(fitted)
    assert set(np.unique(found[laid])) <= {UNSEEN, LEVELLED}
    assert (found[laid] == LEVELLED).mean() > 0.8
    assert not (found[~laid] == LEVELLED).any()
    assert made["validity"]["water"] == pytest.approx((found == LEVELLED).mean(), abs=1e-4)
    dsm = read_raster(fitted.path(fitted.products["dsm"]))[0][0]
    assert np.isfinite(dsm[found == LEVELLED]).all()


def test_water_of_a_prior_that_the_fit_has_not_used_is_not_that_of_its_surface(fitted: Scene) -> None:
    scene = api.fit(fitted, FitOptions(resolution=2.0, coarsest=2.0, epochs=[2], prior_weight=0.0), overwrite=True)
    assert "prior_water" in scene.products
    assert not (codes(api.export(scene)) == LEVELLED).any()


def test_priors_that_do_not_say_what_they_laid_level_are_exported_as_before(fitted: Scene) -> None:
    """Those of other programs and older versions."""
    export(fitted, ExportOptions())
    with_map = codes(fitted)
    del fitted.products["prior_water"]
    fitted.path(MAPS["water"]).unlink()
    fitted.history.clear()
    made = export(fitted, ExportOptions())
    assert "water" not in made["validity"]
    without = codes(fitted)
    assert set(np.unique(without)) <= {UNSEEN, MEASURED, FILLED}
    np.testing.assert_array_equal(without[with_map != LEVELLED], with_map[with_map != LEVELLED])


def test_the_map_goes_with_the_prior(fitted: Scene) -> None:
    assert "prior_water" in drop(fitted, "prior")


@pytest.fixture
def maps(tmp_path: Path) -> Maps:
    """Water at 2 m beside ground that rises from it, as sure as the other."""
    height = np.tile(2.0 + 0.1 * np.maximum(np.arange(120) - 60, 0), (80, 1)).astype(np.float32)
    validity = np.full(GRID.shape, MEASURED, np.uint8)
    validity[:, WATER] = LEVELLED
    write_cog(tmp_path / "dsm.tif", height, GRID)
    write_cog(tmp_path / "validity.tif", validity, GRID, nodata=None)
    return Maps.of({name: tmp_path / f"{name}.tif" for name in ("dsm", "validity")})


def test_a_point_cloud_has_it_as_synthetic_water(maps: Maps, tmp_path: Path) -> None:
    write_laz(tmp_path / "a.laz", maps, None, silent)
    found = laspy.read(tmp_path / "a.laz")
    water = np.asarray(found["validity"]) == 4
    assert water.sum() == 60 * 80
    assert set(np.asarray(found.classification)[water]) == {9}  # ASPRS: water
    assert set(np.asarray(found.synthetic)[water]) == {1}
    assert set(np.asarray(found.classification)[~water]) == {1}
    assert set(np.asarray(found.synthetic)[~water]) == {0}


def test_it_is_ground_that_was_not_seen(maps: Maps) -> None:
    (whole,) = blocks(GRID)
    surface, ground, validity = terrain_of(maps, whole, 30.0)
    np.testing.assert_allclose(ground[:, WATER], 2.0, atol=0.05)
    assert set(np.unique(validity[:, WATER])) == {INTERPOLATED}
    assert (validity[:, 62:] == SEEN).mean() > 0.9
    assert np.abs(surface - ground).max() < 0.2

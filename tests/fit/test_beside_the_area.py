"""What stands around an area casts its shadows into it, and what images show of it is not of the area."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from towns import copied

from sattools.align.options import AlignOptions
from sattools.align.stage import align
from sattools.camera.view_direction import ViewDirection
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.around import of_the_area
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.prior import PriorOptions, tiled
from sattools.prior import stage as priors
from sattools.prior.stage import prior
from sattools.render.around import Around
from sattools.scene import Grid
from sattools.scene.raster import raster_grid, read_raster, write_cog
from sattools.views import View

QUICK = FitOptions(resolution=1.0, coarsest=1.0, epochs=[5])


@pytest.fixture(scope="module")
def middle_source(town_source: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The middle of a town, whose images show all of it, with its prior; not fitted."""
    grid = town_source.require_grid()
    quarter = grid.width // 4
    part = slice(quarter, grid.height - quarter), slice(quarter, grid.width - quarter)
    scene = copied(replace(town_source, grid=grid.part(*part)), tmp_path_factory.mktemp("middle") / "MIDDLE")
    prior(scene, PriorOptions())
    return scene


@pytest.fixture
def middle(middle_source: Any, tmp_path: Path) -> Any:
    return copied(middle_source, tmp_path / "MIDDLE")


def shadows(scene: Any) -> np.ndarray:
    """``[V, H, W]`` that `export` writes."""
    fit(scene, QUICK)
    export(scene, ExportOptions())
    return np.stack([read_raster(scene.path(item.assets["shadow"].href))[0][0] for item in scene.train_items()])


def light_in_shade(scene: Any) -> float:
    """Mean over images and bands, as share of the light in the sun."""
    return float(FittedModel.load(scene.path(scene.products["model"])).ambient.mean())


def test_a_wall_around_the_area_throws_its_shadow_into_maps_and_pictures(middle: Any) -> None:
    plain = shadows(middle)
    dark = light_in_shade(middle)
    without, _ = read_raster(middle.path(middle.products["albedo"]))
    path = middle.path(middle.products["prior_surroundings"])
    height, grid = read_raster(path)
    rows, cols = grid.window(middle.grid)
    wall = np.ones(grid.shape, bool)
    wall[rows, cols] = False
    write_cog(path, np.where(wall, height + 20, height), grid)
    walled = shadows(middle)
    assert plain.mean() < 0.3
    assert walled.mean() > plain.mean() + 0.2
    assert (walled >= plain)[:, 1:-1, 1:-1].mean() > 0.98
    # what is taken for shade is taken for lighter than it looks; not by much, as all of this shade that is none makes
    # the images' light in shade brighter
    found, _ = read_raster(middle.path(middle.products["albedo"]))
    there = (walled.mean(axis=0) > plain.mean(axis=0) + 0.3) & (walled.mean(axis=0) < 1)
    assert there.any()
    assert light_in_shade(middle) > dark + 0.1
    assert np.median(found[:, there]) > 1.04 * np.median(without[:, there])
    under = ExportOptions(sun=(180.0, 30.0))
    export(middle, under)
    shaded, _ = read_raster(middle.path(middle.products["relit"]))
    del middle.products["prior_surroundings"]
    export(middle, under)
    lit, _ = read_raster(middle.path(middle.products["relit"]))
    assert np.nanmean(shaded) < 0.9 * np.nanmean(lit)


def test_surroundings_reach_sixteen_metres_beyond_the_area_and_a_rim_into_it(middle: Any) -> None:
    height, grid = read_raster(middle.path(middle.products["prior_surroundings"]))
    west, south, east, north = middle.grid.bounds
    assert grid.bounds == (west - 16, south - 16, east + 16, north + 16)
    known = np.isfinite(height[0])
    inside = known[grid.window(middle.grid)].copy()
    cells = round(4 / grid.cell_size)
    assert not inside[cells:-cells, cells:-cells].any()
    known[grid.window(middle.grid)] = True
    assert known.all()
    rim, _ = read_raster(middle.path(middle.products["prior_dsm"]))
    own = height[0][grid.window(middle.grid)]
    np.testing.assert_array_equal(own[inside], rim[0][inside])


def test_surroundings_of_tiles_are_those_of_the_area_at_once(middle: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    at_once, grid = read_raster(middle.path(middle.products["prior_surroundings"]))
    monkeypatch.setattr(tiled, "AT_ONCE", 1000)
    for name, value in {"TILE_CELLS": 64, "OVERLAP_M": 16.0}.items():
        monkeypatch.setattr(tiled, name, value)
    prior(middle, PriorOptions())
    in_tiles, same = read_raster(middle.path(middle.products["prior_surroundings"]))
    assert same == grid
    assert (np.isfinite(in_tiles) == np.isfinite(at_once)).all()
    assert np.nanmedian(np.abs(in_tiles - at_once)) < 0.2


def test_surroundings_of_wide_cells_have_cells_as_wide(middle: Any) -> None:
    middle.grid = middle.grid.resized(2.0)
    prior(middle, PriorOptions())
    assert raster_grid(middle.path(middle.products["prior_surroundings"])).cell_size == 2.0


def test_surroundings_share_corners_with_the_wide_cells_of_the_area(middle: Any) -> None:
    middle.grid = middle.grid.resized(3.0)
    prior(middle, PriorOptions())
    grid = raster_grid(middle.path(middle.products["prior_surroundings"]))
    west, south, east, north = middle.grid.bounds
    assert grid.bounds == (west - 15, south - 15, east + 15, north + 15)
    assert grid.cell_size == 3.0


@pytest.mark.parametrize(("cell", "around"), [(5.0, 3), (20.0, 0)])
def test_cells_that_would_reach_further_than_what_was_matched_are_none_of_them(cell: float, around: int) -> None:
    area = Grid("EPSG:32633", 500000.0, 5000000.0, cell, 9, 8)
    fine = area.resized(0.5)
    wide = fine.widened(32)  # 16 m
    grid, height = priors._wide_cells(area, fine, wide, np.full(wide.shape, 7.0, np.float32))
    assert grid == area.widened(around)
    assert height.shape == grid.shape
    assert (height == 7.0).all()


def test_a_prior_that_was_matched_by_itself_has_none(middle: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path = middle.path(middle.products["prior_surroundings"])
    assert path.exists()
    monkeypatch.setattr(priors, "with_surroundings", lambda grid, *_: grid)
    prior(middle, PriorOptions())
    assert "prior_surroundings" not in middle.products
    assert not path.exists()


def test_surroundings_move_with_the_area(middle: Any, tmp_path: Any) -> None:
    shadows(middle)
    before, grid = read_raster(middle.path(middle.products["prior_surroundings"]))
    dsm = middle.path(middle.products["dsm"])
    heights, own = read_raster(dsm)
    write_cog(tmp_path / "REF.tif", heights + 1.5, own.moved(3.0, -2.0))
    align(middle, AlignOptions(to=str(tmp_path / "REF.tif")))
    after, there = read_raster(middle.path(middle.products["prior_surroundings"]))
    assert there.left - grid.left == pytest.approx(3.0, abs=0.1)
    assert there.top - grid.top == pytest.approx(-2.0, abs=0.1)
    assert np.nanmean(after - before) == pytest.approx(1.5, abs=0.1)


def test_pixels_that_show_what_stands_beside_the_area_do_not_count() -> None:
    """A tower of 20 m, 4 to 10 m east of the area, seen from the east."""
    wide = Grid("EPSG:32633", 500000.0, 5000000.0, 1.0, 60, 30)
    area = wide.part(slice(0, 30), slice(0, 40))
    height = np.zeros(wide.shape, np.float32)
    height[:, 44:50] = 20.0
    around = Around(((height, wide),), area)
    nothing = np.zeros((30, 40, 1), np.float32), np.ones((30, 40), np.uint8)
    flat = torch.zeros(area.shape)

    def counted(east: float) -> np.ndarray:
        view = View("A", *nothing, ViewDirection(east, 0.0), 0.0, None, 0.0)
        (found,) = of_the_area([view], around, flat, 1.0, (-1.0, 25.0))
        return np.flatnonzero(found.mask[15])

    assert counted(0.0).tolist() == list(range(40))
    # rays that climb 1 m eastwards per metre: those from 44 - 20 = 24 m on meet the tower's wall or roof
    assert counted(1.0).max() in (23, 24)
    assert counted(-1.0).tolist() == list(range(40))

"""Ground that fewer than two images reach is no-data, what is hidden is said, and nothing seen is lost."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from towns import copied

from sattools.export.blocks import Surroundings, blocks
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.export.validity import Witnesses, valid_pixels
from sattools.fit.checkpoint import load, save
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster
from sattools.scene.validity import FILLED, MEASURED, UNSEEN

QUICK = FitOptions(resolution=2.0, coarsest=2.0, epochs=[2], prior_weight=0.0)


@pytest.fixture(scope="module")
def fitted_source(town_source: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    scene = copied(town_source, tmp_path_factory.mktemp("fitted") / "TOWN")
    fit(scene, QUICK)
    return scene


@pytest.fixture
def fitted(fitted_source: Any, tmp_path: Path) -> Any:
    shutil.copytree(fitted_source.root, tmp_path / "TOWN")
    scene = Scene.from_json(fitted_source.to_json())
    scene.root = tmp_path / "TOWN"
    return scene


def validity_of(scene: Any, ids: Any, grid: Grid, height: Any) -> Any:
    (whole,) = blocks(grid)
    return Witnesses(scene, ids).validity(whole, Surroundings(grid, lambda rows, cols: height[rows, cols]))


def blank(scene: Any, item: Any, columns: Any) -> None:
    """Frame the image in zeros, as vendors do."""
    path = scene.path(item.assets["image"].href)
    with rasterio.open(path) as data:
        pixels, profile, rpc = data.read(), data.profile, data.tags(ns="RPC")
    pixels[:, :, columns] = 0
    with rasterio.open(path, "w", **profile) as data:
        data.write(pixels)
        data.update_tags(ns="RPC", **rpc)


def east_half_in(scene: Any, count: Any) -> None:
    """All but ``count`` images show the western half only."""
    for item in scene.items[count:]:
        with rasterio.open(scene.path(item.assets["image"].href)) as data:
            middle = data.width // 2
        blank(scene, item, slice(middle, None))


@pytest.mark.parametrize(("count", "kind"), [(0, UNSEEN), (1, UNSEEN), (2, MEASURED)])
def test_two_images_make_a_measurement_and_one_does_not(fitted: Any, count: Any, kind: Any) -> None:
    east_half_in(fitted, count)
    tensors, meta = load(fitted.root / "fit/model.safetensors")
    grid = Grid.from_dict(meta["grid"])
    flat = np.full(grid.shape, float(np.median(tensors["height"])), np.float32)
    found = validity_of(fitted, meta["items"], grid, flat)
    assert found is not None
    assert np.median(found[:, -8:]) == kind
    assert (found[:, :8] == MEASURED).all()


def test_two_images_from_one_direction_count_as_one(fitted: Any) -> None:
    tensors, meta = load(fitted.root / "fit/model.safetensors")
    grid, first = Grid.from_dict(meta["grid"]), fitted.items[0]
    flat = np.full(grid.shape, float(np.median(tensors["height"])), np.float32)
    fitted.items.append(replace(first, id="COPY"))
    assert (validity_of(fitted, [first.id, "COPY"], grid, flat) == UNSEEN).all()
    assert (validity_of(fitted, [first.id, fitted.items[1].id, "COPY"], grid, flat) == MEASURED).any()


def test_unseen_ground_is_no_data_in_the_surface_and_all_its_sisters(fitted: Any) -> None:
    east_half_in(fitted, 1)
    fit(fitted, QUICK)
    made = export(fitted, ExportOptions())
    validity, _ = read_raster(fitted.path(fitted.products["validity"]))
    unseen = validity[0] == UNSEEN
    assert 0.3 < unseen.mean() < 0.7
    assert made["validity"]["unseen"] == pytest.approx(unseen.mean(), abs=1e-4)
    for name in ("dsm", "dsm_std", "albedo"):
        values, _ = read_raster(fitted.path(fitted.products[name]))
        assert np.array_equal(np.isnan(values).any(axis=0), unseen), name
    for item in fitted.items:
        if "shadow" in item.assets:
            mask, _ = read_raster(fitted.path(item.assets["shadow"].href))
            assert np.array_equal(mask[0] == 255, unseen)


def test_ground_that_is_saturated_in_all_images_has_a_height_and_no_albedo(fitted: Any) -> None:
    export(fitted, ExportOptions())
    before = {name: read_raster(fitted.path(fitted.products[name]))[0] for name in ("dsm", "albedo", "validity")}
    normalise(fitted, NormaliseOptions(saturation=500))
    fit(fitted, QUICK)
    export(fitted, ExportOptions())
    dsm, albedo, validity = (read_raster(fitted.path(fitted.products[n]))[0] for n in ("dsm", "albedo", "validity"))
    dark = np.isnan(albedo).any(axis=0) & np.isfinite(dsm[0])
    assert 0.005 < dark.mean() < 0.2
    assert before["albedo"].mean(axis=0)[dark].mean() > 1.5 * np.nanmean(before["albedo"])  # the brightest ground
    assert np.isnan(dsm).mean() == np.isnan(before["dsm"]).mean()
    assert (validity != before["validity"]).mean() < 0.02  # heights of the two fits differ a little


def test_images_of_nothing_but_zeros_leave_empty_maps_and_that_is_said(
    fitted: Any, caplog: pytest.LogCaptureFixture
) -> None:
    for item in fitted.items:
        blank(fitted, item, slice(None))
    fit(fitted, QUICK)
    made = export(fitted, ExportOptions())
    assert made["validity"]["unseen"] == 1.0
    assert made["notes"] == [
        "no two images show any of the surface, so every map is empty (0 from an image's edge inwards is no pixel)"
    ]
    assert "every map is empty" in caplog.text
    assert np.isnan(read_raster(fitted.path(fitted.products["dsm"]))[0]).all()


def test_fill_gives_the_heights_back_and_the_mark_stays(fitted: Any) -> None:
    east_half_in(fitted, 1)
    fit(fitted, QUICK)
    export(fitted, ExportOptions(fill=True))
    heights, _ = read_raster(fitted.path(fitted.products["dsm"]))
    validity, _ = read_raster(fitted.path(fitted.products["validity"]))
    assert np.isfinite(heights).all()
    assert (validity == UNSEEN).any()


def test_a_court_between_walls_that_only_one_image_looks_into_is_filled(fitted: Any) -> None:
    """A shaft 1 cell wide and 60 m deep: no image but the one from the zenith, if there is one, sees its floor."""
    _, meta = load(fitted.root / "fit/model.safetensors")
    grid = Grid.from_dict(meta["grid"])
    height = np.full(grid.shape, 60.0, np.float32)
    row, col = grid.height // 2, grid.width // 2
    height[row, col] = 0.0
    found = validity_of(fitted, meta["items"], grid, height)
    assert found is not None
    assert found[row, col] == FILLED
    assert found[row, col - 5] == MEASURED


def test_no_cell_that_two_images_see_is_lost(fitted: Any) -> None:
    export(fitted, ExportOptions())
    heights, _ = read_raster(fitted.path(fitted.products["dsm"]))
    validity, _ = read_raster(fitted.path(fitted.products["validity"]))
    assert (validity == MEASURED).mean() > 0.9
    assert np.isfinite(heights[validity == MEASURED]).all()


def test_without_the_images_nobody_knows(fitted: Any, caplog: pytest.LogCaptureFixture) -> None:
    del fitted.items[0].assets["rpc"]
    fitted.history.clear()
    export(fitted, ExportOptions())
    assert "validity" not in fitted.products
    assert "nobody knows what they show" in caplog.text
    heights, _ = read_raster(fitted.path(fitted.products["dsm"]))
    assert np.isfinite(heights).all()


def test_dark_pixels_inside_an_image_are_pixels_and_a_frame_of_zeros_is_none() -> None:
    image = np.ones((1, 20, 20), np.float32)
    image[0, 8:12, 8:12] = 0.0
    image[0, :, :5] = 0.0
    image[0, 15, 15] = np.nan
    valid = valid_pixels(image)
    assert valid[8:12, 8:12].all()
    assert not valid[:, :5].any()
    assert not valid[15, 15]
    assert valid.sum() == 400 - 100 - 1


def test_compare_says_what_was_measured_and_what_holes_cost(fitted: Any) -> None:
    from sattools.compare import CompareOptions, compare

    east_half_in(fitted, 1)
    fit(fitted, QUICK)
    export(fitted, ExportOptions())
    figures = compare(CompareOptions(register="none"), fitted)
    heights, _ = read_raster(fitted.path(fitted.products["dsm"]))
    assert figures["completeness"] == pytest.approx(np.isfinite(heights).mean(), abs=0.05)
    assert figures["measured"]["n"] == round(figures["completeness"] * figures["cells"])
    assert figures["filled"]["mae"] == figures["mae_filled"]
    assert json.loads((fitted.root / "compare/errors.json").read_text())["measured"] == figures["measured"]


def test_a_model_that_is_no_data_everywhere_is_an_error_not_a_crash(fitted: Any) -> None:
    tensors, meta = load(fitted.root / "fit/model.safetensors")
    tensors["height"][:] = float("nan")
    save(fitted.root / "fit/model.safetensors", tensors, meta)
    fitted.history.clear()
    with pytest.raises(Exception, match=r"fit/model\.safetensors: found no finite height"):
        export(fitted, ExportOptions())


def test_large_cells_at_the_last_pixels_of_an_image_are_looked_up(fitted: Any) -> None:
    grid = fitted.require_grid()
    level = float(np.mean(fitted.require_height_range()))
    west, south, _, _ = grid.bounds
    seen = []
    for k in range(40):  # cells of 16 pixels that slide over the southern border of the images, a metre at a time
        coarse = Grid(grid.crs, west, south + 20.0 - k, 8.0, 8, 1)
        heights = np.full(coarse.shape, level, np.float32)
        seen.append(Witnesses(fitted, [fitted.items[0].id])._witnesses[0].shown(coarse, heights).mean())
    assert seen[0] == 1.0
    assert seen[-1] == 0.0

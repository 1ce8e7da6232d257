"""The stage and its command on a simulated town."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from towns import copied

from sattools.cli import main
from sattools.compare import compare_dsm, read_reference
from sattools.errors import InputError, OutputExistsError, SceneError
from sattools.fit.inputs import load_prior
from sattools.fit.options import FitOptions
from sattools.fit.surface.schedule import own_cell
from sattools.prior import PriorOptions, stage
from sattools.prior.cells import grids
from sattools.prior.files import MapFiles
from sattools.prior.gate import check_start
from sattools.prior.stage import prior
from sattools.progress import silent
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import Scene
from sattools.scene.raster import read_raster


@pytest.fixture(scope="module")
def matched_source(town_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Any:
    scene = copied(town_source, tmp_path_factory.mktemp("matched") / "TOWN")
    return scene, prior(scene, PriorOptions(per_image=True))


@pytest.fixture
def matched(matched_source: Any, tmp_path: Path) -> Any:
    """A copy of a town with its prior, and what `prior` has told of it."""
    scene, entry = matched_source
    return copied(scene, tmp_path / "TOWN"), entry


def product(scene: Any, name: Any) -> Any:
    return read_raster(scene.path(scene.products[name]))


def test_surface_confidence_and_normals_lie_on_the_grid(matched: Any) -> None:
    scene, entry = matched
    names = ("prior_dsm", "prior_dsm_std", "prior_dsm_error95", "prior_confidence", "prior_probability")
    for name, bands in (*((name, 1) for name in (*names, "prior_water")), ("prior_normals", 3)):
        array, grid = product(scene, name)
        assert grid == scene.require_grid()
        assert array.shape == (bands, *grid.shape)
    confidence, _ = product(scene, "prior_confidence")
    assert confidence.min() >= 0
    assert confidence.max() <= 1
    normals, _ = product(scene, "prior_normals")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1.0, atol=1e-5)
    assert entry["prior"]["seen_by_two"] > 0.9
    assert len(entry["prior"]["pairs"]) <= 15  # six views
    with rasterio.open(scene.path(scene.products["prior_water"])) as data:
        assert (data.dtypes, data.nodata) == (("uint8",), None)
        assert not data.read().any()  # a town without water
    with rasterio.open(scene.path(scene.products["prior_dsm"])) as data:
        assert data.tags()["VERTICAL_DATUM"] == "WGS84 ellipsoid"
        assert data.units == ("m",)


def test_errors_are_no_larger_than_the_range_of_heights(make_town: Any) -> None:
    scene = make_town()
    scene.height_range_m = (-5.0, 3.0)
    grid = scene.require_grid()
    with MapFiles(scene, grid) as files:
        files.write(np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32), slice(0, grid.height))
    for name in ("prior_dsm_std", "prior_dsm_error95"):  # guesses are said to be 10 and 40 m off
        assert product(scene, name)[0].max() == 8.0


def test_planes_further_apart_than_the_heights_are_refused(make_town: Any) -> None:
    scene = make_town()
    scene.height_range_m = (-28.0, 21.0)
    for refuse in (check_start, prior):
        with pytest.raises(SceneError, match=r"found --step 50 m, expected at most the height range, 49 m"):
            refuse(scene, PriorOptions(step=50.0))
        told = r"cells of 40 m, whose planes are 56 m apart, expected at most the height range, 49 m \(--resolution\)"
        with pytest.raises(SceneError, match=told):
            refuse(scene, PriorOptions(resolution=40.0))
    assert "prior_dsm" not in scene.products


def test_a_least_angle_above_the_largest_is_refused() -> None:
    with pytest.raises(InputError, match=r"--min-angle: found 45, expected at most 40 \(--max-angle\)"):
        PriorOptions(min_angle=45.0)
    assert PriorOptions(min_angle=45.0, max_angle=60.0).min_angle == 45.0


def test_the_surface_is_right_and_where_it_is_sure_it_is_righter(matched: Any) -> None:
    scene, _ = matched
    truth = read_reference(scene.path(scene.products["truth_dsm"]))
    height, grid = product(scene, "prior_dsm")
    confidence, _ = product(scene, "prior_confidence")
    error = np.abs(compare_dsm(height[0], truth, grid, method="none").difference)
    known = np.isfinite(error)
    assert np.median(error[known]) < 0.35
    assert error[known].mean() < 1.5
    order = np.argsort(-confidence[0][known])
    error = error[known][order]
    half = error.size // 2
    assert error[:half].mean() < 0.4 * error[half:].mean()


def test_masked_saturated_roofs_have_the_heights_of_kept_ones(make_town: Any) -> None:
    heights = []
    for kept in ("keep", "mask"):
        scene = make_town(f"TOWN_{kept}")
        normalise(scene, NormaliseOptions(saturation=900, saturated=kept))
        prior(scene, PriorOptions())
        heights.append(product(scene, "prior_dsm")[0][0])
    # numbers go to radiance and back in single precision, which may decide between two planes here and there
    assert (np.abs(heights[1] - heights[0]) < 0.01).mean() > 0.99


@pytest.mark.parametrize(
    ("cell", "gsd", "fine"),
    [
        (0.5, 0.31, 0.5),
        (0.7, 0.5, 0.7),  # less than 1.5 times what suits the pixels
        (1.0, 0.5, 0.5),
        (5.0, 0.31, 0.5),
        (5.0, 2.0, 5 / 3),  # a whole number of times
        (5.0, None, 5.0),  # unknown
        (0.3, 0.5, 0.3),  # no less than 0.6 of what suits the pixels
        (0.25, 0.31, 0.5),
        (0.1, 0.31, 0.5),
    ],
)
def test_cells_that_do_not_suit_the_pixels_are_matched_on_those_that_do(
    town_source: Any, cell: Any, gsd: Any, fine: Any
) -> None:
    items = [replace(item, properties={**item.properties, "gsd": gsd}) for item in town_source.items]
    scene = replace(town_source, grid=town_source.require_grid().resized(cell), items=items)
    whole, own = grids(scene, items, PriorOptions())
    assert (whole, own.cell_size) == (scene.grid, pytest.approx(fine))
    assert own.width == math.ceil(round(whole.width * cell / fine, 6))
    assert own_cell(scene) == max(fine, cell / 2)
    assert [grid.cell_size for grid in grids(scene, items, PriorOptions(resolution=3.0))] == [3.0, 3.0]


def test_a_surface_of_wide_cells_is_the_mean_of_a_finer_one(make_matched_town: Any) -> None:
    scene = make_matched_town()
    fine, _ = product(scene, "prior_dsm")
    scene.grid = scene.require_grid().resized(2.0)
    prior(scene, PriorOptions())
    wide, grid = product(scene, "prior_dsm")
    assert grid == scene.grid
    rows, cols = (n // 4 for n in fine[0].shape)
    means = fine[0][: 4 * rows, : 4 * cols].reshape(rows, 4, cols, 4).mean(axis=(1, 3))
    # what lies within a cell or two of the border is seen with other surroundings
    np.testing.assert_allclose(wide[0][2 : rows - 2, 2 : cols - 2], means[2:-2, 2:-2], atol=0.01)
    prior(scene, PriorOptions(resolution=2.0))
    coarse, _ = product(scene, "prior_dsm")
    assert np.abs(coarse[0] - wide[0]).mean() > 0.3  # who asks for wide windows gets them


def test_a_surface_of_narrow_cells_lies_between_those_of_a_wider_one(
    make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_matched_hamlet()
    wide, before = product(scene, "prior_dsm")
    narrow = before.resized(0.1)
    scene.grid = replace(narrow, width=narrow.width - 2, height=narrow.height - 3)
    prior(scene, PriorOptions())
    fine, grid = product(scene, "prior_dsm")
    assert grid == scene.grid
    # the middles of the wide cells; the narrow grid ends within the last ones
    np.testing.assert_allclose(fine[0][2::5, 2::5][:60, :60], wide[0][:60, :60], atol=0.01)
    # cut into strips of any height, it is the same
    monkeypatch.setattr(stage, "pieces", lambda shape: [slice(k, min(k + 7, shape[0])) for k in range(0, shape[0], 7)])
    prior(scene, PriorOptions())
    np.testing.assert_array_equal(product(scene, "prior_dsm")[0], fine)


def test_a_window_that_blurs_what_it_is_to_find_is_warned_of(
    make_hamlet: Any, caplog: pytest.LogCaptureFixture
) -> None:
    scene = make_hamlet()  # of cells of 0.5 m, matched on 0.35 m
    for window, wide in ((1, False), (4, False), (5, True), (16, True)):
        caplog.clear()
        check_start(scene, PriorOptions(window=window))
        assert bool(caplog.records) == wide
    (record,) = caplog.records
    why = "--window 16 compares 33 x 33 cells, 11.5 m on the ground, and blurs what is narrower"
    assert record.message.startswith(f"scene HAMLET: {why}")
    found = prior(scene, PriorOptions(window=16, rough_passes=0))
    assert found["notes"][0].startswith(why)


def test_cells_may_be_large_and_windows_of_small_cells_have_many(
    make_town: Any, caplog: pytest.LogCaptureFixture
) -> None:
    scene = make_town()
    check_start(scene, PriorOptions(resolution=8.0))
    check_start(scene, PriorOptions(resolution=0.2, window=8))  # 2.4 m
    assert not caplog.records


def test_the_probability_is_about_the_share_of_heights_that_are_right_to_a_metre(matched: Any) -> None:
    scene, _ = matched
    truth = read_reference(scene.path(scene.products["truth_dsm"]))
    height, grid = product(scene, "prior_dsm")
    probability, _ = product(scene, "prior_probability")
    error = np.abs(compare_dsm(height[0], truth, grid, method="none").difference)
    known = np.isfinite(error)
    assert probability.min() > 0
    assert probability.max() <= 1
    right, said = error[known] < 1, probability[0][known]
    # a town of six views, unlike any that the weights were found on
    assert said.mean() == pytest.approx(right.mean(), abs=0.1)
    assert right[said > 0.9].mean() > right[said < 0.6].mean() + 0.3


def test_two_heights_in_three_are_less_off_than_their_standard_deviation(matched: Any) -> None:
    scene, _ = matched
    truth = read_reference(scene.path(scene.products["truth_dsm"]))
    height, grid = product(scene, "prior_dsm")
    difference = compare_dsm(height[0], truth, grid, method="none").difference
    error = np.abs(difference - np.nanmedian(difference))
    known = np.isfinite(error)
    std, error95 = (product(scene, f"prior_dsm_{name}")[0][0] for name in ("std", "error95"))
    # a town of six views, unlike any that the weights were found on
    assert (error < std)[known].mean() == pytest.approx(0.68, abs=0.12)
    assert (error < error95)[known].mean() == pytest.approx(0.95, abs=0.06)


def test_depth_per_image_is_the_height_that_its_pixel_sees(matched: Any) -> None:
    scene, _ = matched
    truth, _ = product(scene, "truth_dsm")
    for item in scene.train_items()[:2]:
        with rasterio.open(scene.path(item.assets["depth"].href)) as data:
            depth = data.read(1)
            assert data.descriptions == ("height of what the pixel shows",)
            assert data.units == ("m",)
            assert data.tags()["VERTICAL_DATUM"] == "WGS84 ellipsoid"
            assert data.tags(ns="RPC")  # the image's camera
        with rasterio.open(scene.path(item.assets["image"].href)) as image:
            assert depth.shape == image.shape
        with rasterio.open(scene.path(item.assets["confidence"].href)) as data:
            image_confidence = data.read(1)
        seen = np.isfinite(depth)
        assert seen.mean() > 0.3  # images reach beyond the grid
        assert np.array_equal(seen, np.isfinite(image_confidence))
        # the quartiles of what a view sees are those of the town, nearly
        assert np.percentile(depth[seen], 25) == pytest.approx(np.percentile(truth, 25), abs=1.5)


def test_two_images_give_a_surface_and_say_what_that_means(make_hamlet: Any) -> None:
    scene = make_hamlet()
    scene.items = scene.items[:2]
    entry = prior(scene, PriorOptions())
    assert any("two images only" in text for text in entry["notes"])
    assert not any("are guesses" in text for text in entry["notes"])
    assert np.isfinite(product(scene, "prior_dsm")[0]).all()


@pytest.mark.parametrize(("images", "spoilt"), [(2, 0.5), (3, 0.7)])
def test_few_images_that_agree_about_half_are_warned_of(
    images: int, spoilt: float, make_town: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """All but one of them show noise in half of the area and more."""
    scene = make_town()
    scene.items = scene.items[:images]
    rng = np.random.default_rng(0)
    for item in scene.items[1:]:
        with rasterio.open(scene.path(item.assets["image"].href), "r+") as file:
            pixels = file.read()
            part = pixels[:, : round(spoilt * file.height)]
            part[:] = rng.integers(100, 1500, part.shape)
            file.write(pixels)
    notes = prior(scene, PriorOptions())["notes"]
    (told,) = [note for note in notes if "are guesses" in note]
    assert re.match(r"images agree about [1-6]\d\.\d % of what two of them see: elsewhere heights are guesses", told)
    assert told in caplog.text


def test_three_images_that_agree_are_not_warned_of(make_town: Any) -> None:
    scene = make_town()
    scene.items = scene.items[:3]
    assert not any("are guesses" in note for note in prior(scene, PriorOptions())["notes"])


def test_images_that_agree_about_nothing_are_warned_of(make_town: Any, caplog: pytest.LogCaptureFixture) -> None:
    """As two of towers and two dates: their heights may be tens of metres off, and only the confidence had told."""
    scene = make_town()
    rng = np.random.default_rng(0)
    for item in scene.items:
        with rasterio.open(scene.path(item.assets["image"].href), "r+") as file:
            pixels = rng.integers(100, 1500, (file.count, file.height, file.width))
            file.write(pixels.astype(file.dtypes[0]))
    notes = prior(scene, PriorOptions())["notes"]
    (told,) = [note for note in notes if "heights are guesses" in note]
    assert told.startswith("images agree about 0.")
    assert told in caplog.text


def test_one_image_or_one_direction_is_an_error(make_town: Any) -> None:
    scene = make_town()
    scene.items = scene.items[:1]
    with pytest.raises(SceneError, match="found 1 training image, expected at least 2"):
        prior(scene, PriorOptions())


def test_a_held_out_image_is_not_matched(make_hamlet: Any) -> None:
    scene = make_hamlet()
    scene.items[0].properties["sattools:role"] = "test"
    entry = prior(scene, PriorOptions())
    assert scene.items[0].id not in {name for pair in entry["prior"]["pairs"] for name in pair}


def test_images_without_sun_are_matched(make_hamlet: Any) -> None:
    scene = make_hamlet()
    for item in scene.items:
        item.properties.pop("view:sun_azimuth")
    assert prior(scene, PriorOptions())["prior"]["pairs"]


def test_existing_products_are_kept_unless_told(matched: Any) -> None:
    scene, _ = matched
    with pytest.raises(OutputExistsError, match="--overwrite"):
        prior(scene, PriorOptions(), overwrite=False)


def test_the_fit_makes_its_own_prior_where_there_is_none(make_hamlet: Any) -> None:
    scene = make_hamlet()
    assert load_prior(scene, FitOptions(prior_weight=0), silent) == (None, {})
    prior, made = load_prior(scene, FitOptions(prior_weight=0.1), silent)
    height, confidence, grid = prior.height.numpy(), prior.confidence.numpy(), prior.grid
    assert made["prior"]["implicit"]
    assert height.shape == confidence.shape == grid.shape
    assert "prior_dsm" in scene.products


def test_the_command_passes_the_scene_on(make_hamlet: Any) -> None:
    scene = make_hamlet()
    done = CliRunner().invoke(main, ["prior", "--rough-passes", "1", str(scene.root / "scene.json")])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)["sattools"]
    assert set(document["products"]) >= {"prior_dsm", "prior_confidence", "prior_normals"}
    entry = document["history"][-1]
    assert entry["command"] == "prior"
    assert entry["options"]["rough_passes"] == 1
    assert entry["seconds"] > 0

"""Single pixels far beyond all around them are no data; what is bright in earnest stays."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.windows import Window
from spoilt import Town, made, prep

from sattools.prep.hot import hot_pixels
from sattools.scene import Scene
from sattools.views import load_sources


@pytest.fixture
def town(town_source: Any, tmp_path: Path) -> Any:
    return Town(tmp_path, town_source, 3)


def places(shape: Any, number: int) -> Any:
    """One pixel in a hundred, none of which touch."""
    rng = np.random.default_rng(number)
    found = np.zeros(shape, bool)
    found[1:-1:2, 1:-1:2] = rng.random(found[1:-1:2, 1:-1:2].shape) < 0.04
    return found


def hot(number: int) -> Any:
    def change(values: Any) -> Any:
        values = values.copy()
        values[:, places(values.shape[1:], number)] = 65535
        return values

    return change


def test_images_with_hot_pixels_are_prepared_as_those_without(town: Any) -> None:
    for number in range(1, 4):
        town.pixels(number, hot(number))
    scene = made(town, "TOWN_001: 0.94 % of its pixels are hot", "taken for no data")
    adjustment = scene.history[-1]["adjustment"]
    assert adjustment["median_after_px"] < 0.3
    assert adjustment["outlier_views"] == []
    assert [item.properties["sattools:bits"] for item in scene.items] == [11, 11, 11]
    missing = np.isnan(load_sources(scene, scene.items[:1])[0].radiance).any(axis=0)
    np.testing.assert_array_equal(missing, places(missing.shape, 1))
    with (
        rasterio.open(town.image(1)) as before,
        rasterio.open(scene.path(scene.items[0].assets["image"].href)) as after,
    ):
        np.testing.assert_array_equal(before.read(), after.read())


@pytest.mark.parametrize("number", [65535.0, 1e8])
def test_floating_point_images_with_hot_pixels_are_prepared_as_those_without(town: Any, number: float) -> None:
    """One pixel in 10,000 was enough: no tie points were found, and the overlap of the images was blamed."""

    def few(values: Any) -> Any:
        values = values.astype(np.float32)
        values[:, 40::60, 50::60] = number
        return values

    for view in range(1, 4):
        town.pixels(view, few)
    scene = made(town, "of its pixels are hot", "taken for no data")
    assert scene.history[-1]["adjustment"]["median_after_px"] < 0.3
    assert scene.items[0].properties["sattools:value_range"][1] < 2048


def test_originals_that_are_not_copied_are_said_to_keep_theirs(town: Any) -> None:
    town.pixels(1, hot(1))
    assert "TOWN_001: is not copied, so its hot pixels are brightness later on" in prep(town, "--no-copy").stderr


def image(path: Path, values: Any, nodata: float | None = None) -> Path:
    profile = {"driver": "GTiff", "count": 1, "height": values.shape[0], "width": values.shape[1]}
    with rasterio.open(path, "w", dtype=values.dtype, nodata=nodata, **profile) as data:
        data.write(values, 1)
    return path


def found(path: Path, *window: int) -> Any:
    with rasterio.open(path) as data:
        return hot_pixels(data, path, Window(*(window or (0, 0, data.width, data.height))))


def test_hot_pixels_are_the_same_in_whatever_windows_an_image_is_read(tmp_path: Path) -> None:
    values = np.full((9, 8), 700, np.uint16)
    values[0, 0] = values[4, 3] = values[5, 4] = values[8, 7] = 65535
    path = image(tmp_path / "a.tif", values)
    np.testing.assert_array_equal(found(path), values == 65535)
    pieces = np.concatenate([found(path, 0, row, 8, 1) for row in range(9)])
    np.testing.assert_array_equal(pieces, values == 65535)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32])
def test_roofs_and_glints_that_optics_spread_are_none(tmp_path: Path, dtype: Any) -> None:
    most = 65535 if dtype == np.float32 else np.iinfo(dtype).max
    values = np.full((20, 20), most / 50)
    values[2:5, 2:5] = most  # a roof
    values[10:13, 10:13] = most * np.array([[0.02, 0.1, 0.02], [0.1, 1, 0.1], [0.02, 0.1, 0.02]])  # a glint
    assert not found(image(tmp_path / "a.tif", values.astype(dtype))).any()


def test_no_data_is_none_and_says_nothing_of_what_is_beside_it(tmp_path: Path) -> None:
    values = np.zeros((9, 9), np.uint16)
    values[4, 4] = 50000
    assert not found(image(tmp_path / "beside.tif", values, nodata=0)).any()
    assert not found(image(tmp_path / "declared.tif", values, nodata=50000)).any()
    assert found(image(tmp_path / "none.tif", values)).sum() == 1


def test_images_without_hot_pixels_get_no_mask(town: Any) -> None:
    scene = Scene.from_json(prep(town).stdout)
    with rasterio.open(scene.path(scene.items[0].assets["image"].href)) as data:
        assert data.dataset_mask().all()
    assert not any("hot" in note for note in scene.history[-1]["notes"])


def test_floating_point_numbers_are_hot_where_nothing_else_is_nearly_as_bright(tmp_path: Path) -> None:
    """Whatever their unit; neither roofs, glints with their surroundings nor what lies beside missing pixels are."""
    values = np.full((200, 300), 0.1, np.float32) * np.linspace(0.5, 1.5, 300, dtype=np.float32)
    values[100:110, 100:110] = 5.0
    values[30, 40] = values[30, 41] = values[120, 250] = 9.0
    values[60, 60], values[59:62, 61], values[60, 59] = 9.0, 2.0, 2.0
    values[150, 150], values[149:152, 149] = 9.0, np.nan
    for unit in (1.0, 1e-6, 1e6):
        hot_ones = found(image(tmp_path / f"{unit}.tif", values * np.float32(unit)))
        assert np.argwhere(hot_ones).tolist() == [[30, 40], [30, 41], [120, 250]]

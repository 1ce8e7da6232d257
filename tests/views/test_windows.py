"""Only the part of an image that shows the grid is read, in pixels no finer than the grid has use for."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from sattools.camera.rpc import RPC
from sattools.scene import Grid
from sattools.scene.raster import image_shape, raster_grid, read_image, read_raster, write_cog
from sattools.views import load_sources, views_on

GRID = Grid("EPSG:32617", 1000.0, 5000.0, 1.0, 9, 7)


@pytest.fixture
def numbers(tmp_path: Path) -> Any:
    """A raster of one band, 0 ... 62 row by row, with one cell unknown."""
    array = np.arange(63, dtype=np.float32).reshape(7, 9)
    array[1, 1] = np.nan
    write_cog(tmp_path / "n.tif", array, GRID)
    return tmp_path / "n.tif", array


def test_a_window_and_means_of_pixels_are_read(numbers: Any) -> None:
    path, array = numbers
    assert image_shape(path) == (7, 9)
    assert np.array_equal(read_image(path, (slice(1, 4), slice(1, 8)))[0], array[1:4, 1:8], equal_nan=True)
    halved = read_image(path, (slice(0, 5), slice(0, 9)), 2)[0]
    # the mean of the three known ones of 0, 1, 9 and the unknown; the fifth row and the ninth column are left over
    assert halved.shape == (2, 4)
    assert halved[0, 0] == pytest.approx(10 / 3)
    assert halved[0, 1] == pytest.approx((2 + 3 + 11 + 12) / 4)
    assert np.isnan(read_image(path, (slice(1, 2), slice(1, 2)), 1)).all()
    # two of four are half of them, and enough; one is not
    array[0, 1], array[2:4, 0], array[2, 1] = np.nan, np.nan, np.nan
    write_cog(path, array, GRID)
    halved = read_image(path, (slice(0, 4), slice(0, 2)), 2)[0]
    np.testing.assert_array_equal(halved, [[(0 + 9) / 2], [np.nan]])


def test_a_raster_is_read_within_a_grid(numbers: Any) -> None:
    path, array = numbers
    found, grid = read_raster(path, replace(GRID, left=1002.0, top=4999.0, width=3, height=20))
    assert grid == replace(GRID, left=1002.0, top=4999.0, width=3, height=6)
    assert np.array_equal(found[0], array[1:, 2:5], equal_nan=True)
    assert raster_grid(path) == GRID


def test_the_camera_of_means_sees_them_where_they_are(town_source: Any) -> None:
    rpc = RPC.from_file(town_source.path(town_source.items[0].assets["rpc"].href))
    lon, lat = rpc.lon_offset, rpc.lat_offset
    col, row = rpc.projection(lon, lat, 10.0)
    # the middle of the pixels 0, 1, 2 is the middle of the first mean
    assert rpc.reduced(3).projection(lon, lat, 10.0) == pytest.approx(((col - 1) / 3, (row - 1) / 3), abs=1e-9)


def test_a_small_area_of_large_images_looks_as_it_does_in_the_whole(town_source: Any) -> None:
    middle = sum(town_source.height_range_m) / 2
    scene = replace(town_source, height_range_m=(middle - 2, middle + 2))
    small = replace(scene, grid=scene.grid.part(slice(48, 64), slice(60, 76)))
    whole, windows = (load_sources(s, scene.train_items()) for s in (scene, small))
    assert all(w.radiance[0].size < 0.9 * s.radiance[0].size for w, s in zip(windows, whole, strict=True))
    one, other = (views_on(s, small.grid, middle, scene.height_range_m) for s in (whole, windows))
    for a, b in zip(one, other, strict=True):
        assert np.array_equal(a.mask, b.mask)
        # columns and rows are of 32 bits: 1e-5 of a pixel
        assert np.abs(a.target - b.target).max() < 1e-4


def test_coarse_cells_are_read_as_means_and_look_the_same(town_source: Any) -> None:
    scene = town_source
    coarse = replace(scene, grid=scene.grid.resized(6 * scene.grid.cell_size))
    [whole], [means] = (load_sources(s, scene.train_items()[:1]) for s in (scene, coarse))
    rows, cols = whole.radiance.shape[1:]
    # six cells of about 1.5 pixels or more are read as four by four means
    assert means.radiance.shape[1] <= rows // 2
    assert means.radiance.shape[2] <= cols // 2
    middle = sum(scene.height_range_m) / 2
    [one], [other] = (views_on([s], coarse.grid, middle, scene.height_range_m) for s in (whole, means))
    inside = (one.mask > 0) & (other.mask > 0)
    assert inside.mean() > 0.9
    # one is a Gaussian's view of the cell, the other that of boxes
    assert np.abs(one.target - other.target)[inside].mean() < 0.02 * one.target[inside].std() + 0.005


def test_floating_point_images_of_a_sensor_have_one_full_scale(make_town: Any) -> None:
    scene = make_town()
    before = load_sources(scene, scene.items[:2])
    for number, item in enumerate(scene.items):
        with rasterio.open(scene.path(item.assets["image"].href)) as data:
            shares, profile, tags = data.read() / 2047, data.profile, data.tags(ns="RPC")
        path = scene.root / "images" / f"{item.id}_shares.tif"
        with rasterio.open(path, "w", **profile | {"dtype": "float32", "nodata": None}) as data:
            data.write(shares.astype(np.float32))
            data.update_tags(ns="RPC", **tags)
        item.assets["image"].href = f"images/{path.name}"
        # something in one of them is brighter than a white in full sun
        most = 60.0 if number == 1 else 0.9
        item.properties |= {"sattools:bits": None, "sattools:dtype": "float32", "sattools:value_range": [0.0, most]}
    for one, other in zip(load_sources(scene, scene.items[:2]), before, strict=True):
        np.testing.assert_allclose(one.radiance, other.radiance, atol=1e-5)


def test_images_of_a_sensor_have_the_full_scale_of_the_brightest(make_town: Any) -> None:
    scene = make_town()
    dark = scene.items[0]
    before = load_sources(scene, [dark])[0].radiance
    dark.properties |= {"sattools:bits": 10, "sattools:value_range": [0.0, 1000.0]}
    assert dark.properties["sattools:dtype"] == "uint16"
    assert scene.items[1].properties["sattools:bits"] == 11
    np.testing.assert_array_equal(load_sources(scene, [dark])[0].radiance, before)
    dark.properties["platform"] = "Pleiades-1A"
    np.testing.assert_allclose(load_sources(scene, [dark])[0].radiance, before * 2047 / 1023, rtol=1e-5)

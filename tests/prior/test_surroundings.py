"""An area is matched with what stands beside it, as far as the images show that."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rasterio
from synthetic_views import ALT0, LAT0, LON0, parallel_rpc

from sattools.camera import RPC
from sattools.camera.ground import from_geographic, localize, project
from sattools.prior import PriorOptions, tiled
from sattools.prior import stage as priors
from sattools.prior.stage import prior
from sattools.prior.surroundings import with_surroundings
from sattools.scene import Grid
from sattools.scene.raster import read_raster

UTM33 = "EPSG:32633"
X, Y = (float(v) for v in from_geographic(UTM33, LON0, LAT0))
AREA = Grid(UTM33, X - 20, Y + 20, 0.5, 80, 80)  # 40 m
WIDE, NARROW = (240, 260), (240, 90)  # 120 m x 130 m, and 45 m from west to east


def around(sizes: list[tuple[int, int]], grid: Grid = AREA, reach: float | None = None) -> list[float]:
    """By how much an area is wider to the west, south, east and north [m], with images of these sizes about it."""
    wide = with_surroundings(grid, [parallel_rpc(size=size) for size in sizes], sizes, ALT0, reach)
    return [abs(a - b) for a, b in zip(wide.bounds, grid.bounds, strict=True)]


def test_sixteen_metres_beyond_the_border_are_matched_where_the_images_go_on() -> None:
    assert around([WIDE, WIDE, WIDE]) == [16.0, 16.0, 16.0, 16.0]


def test_nothing_is_matched_on_sides_on_which_images_end() -> None:
    assert around([NARROW, NARROW, NARROW]) == [0.0, 16.0, 0.0, 16.0]
    assert around([WIDE, NARROW, NARROW, NARROW]) == [0.0, 16.0, 0.0, 16.0]  # one of four shows more
    assert around([WIDE, WIDE, NARROW]) == [16.0, 16.0, 16.0, 16.0]


def test_an_image_that_shows_nothing_of_the_area_does_not_matter() -> None:
    elsewhere = parallel_rpc().cropped(5000, 0)
    wide = with_surroundings(AREA, [parallel_rpc(), parallel_rpc(), elsewhere], [WIDE] * 3, ALT0)
    assert wide == AREA.widened(32)


def test_a_tile_is_matched_as_far_as_it_asks_for_where_the_images_go_on_so_far() -> None:
    assert around([WIDE] * 3, reach=24.0) == [24.0, 24.0, 24.0, 24.0]
    # images of 120 m from north to south and 130 m from west to east end 40 and 45 m beyond
    assert around([WIDE] * 3, reach=64.0) == [48.0, 48.0, 48.0, 48.0]
    assert around([NARROW] * 3, reach=24.0) == [0.0, 24.0, 0.0, 24.0]
    assert around([(150, 260)] * 3, reach=40.0) == [40.0, 16.0, 40.0, 16.0]


def test_cells_wider_than_that_have_no_surroundings() -> None:
    assert around([(2400, 2600)] * 2, Grid(UTM33, X - 200, Y + 200, 40.0, 10, 10)) == [0.0, 0.0, 0.0, 0.0]


@pytest.fixture
def middle(make_town: Any) -> Any:
    """The middle of a town, whose images show all of it, and the prior of the whole there."""
    whole = make_town()
    prior(whole, PriorOptions())
    grid = whole.require_grid()
    quarter = grid.width // 4
    rows, cols = slice(quarter, grid.height - quarter), slice(quarter, grid.width - quarter)
    expected, _ = read_raster(whole.path(whole.products["prior_dsm"]))
    return replace(make_town("MIDDLE"), grid=grid.part(rows, cols)), expected[0][rows, cols]


def differing(scene: Any, expected: np.ndarray) -> float:
    """Share of the cells whose heights are a metre from those expected.

    Half a metre of the height of a wall is a twentieth of a cell in its place, which other windows change as well.
    """
    prior(scene, PriorOptions())
    height, grid = read_raster(scene.path(scene.products["prior_dsm"]))
    assert grid == scene.grid
    return float((np.abs(height[0] - expected) > 1.0).mean())


def test_a_small_area_has_the_heights_that_it_has_in_a_larger_one(middle: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, expected = middle
    with_them = differing(scene, expected)
    monkeypatch.setattr(priors, "with_surroundings", lambda grid, *_: grid)
    assert with_them < 0.5 * differing(scene, expected)


def test_a_wide_reach_brings_a_small_area_nearer_to_the_larger_one(middle: Any) -> None:
    scene, expected = middle
    usual = differing(scene, expected)
    assert differing(replace(scene, surroundings_m=40.0), expected) < 0.8 * usual


def test_tiles_reach_into_the_surroundings_and_their_maps_do_not(middle: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, expected = middle
    at_once = differing(scene, expected)
    monkeypatch.setattr(tiled, "AT_ONCE", 1000)
    for name, value in {"TILE_CELLS": 64, "OVERLAP_M": 16.0}.items():
        monkeypatch.setattr(tiled, name, value)
    assert differing(scene, expected) < at_once + 0.05  # tiles see less around them
    assert scene.path(scene.products["prior_normals"]).exists()


def test_depth_per_image_has_all_pixels_of_the_image_however_small_the_area(make_town: Any) -> None:
    scene = make_town()
    grid, (low, _) = scene.require_grid(), scene.require_height_range()
    side = round(12 / grid.cell_size)
    first = grid.width // 2 - side // 2
    scene.grid = grid.part(slice(first, first + side), slice(first, first + side))
    scene.height_range_m = low, low + 8  # so little shows where it is not that little of the images is looked at
    prior(scene, PriorOptions(per_image=True))
    for item in scene.train_items():
        depth, image = (rasterio.open(scene.path(item.assets[name].href)) for name in ("depth", "image"))
        with depth, image:
            assert depth.shape == image.shape
            seen = np.argwhere(np.isfinite(depth.read(1)))
        rpc = RPC.from_file(scene.path(item.assets["rpc"].href))
        x, y = (low_edge + side * grid.cell_size / 2 for low_edge in (scene.grid.left, scene.grid.bounds[1]))
        col, row = project(rpc, grid.crs, x, y, low + 4)
        assert np.hypot(*(seen.mean(axis=0) - [row, col])) < 0.3 * max(depth.shape)


@pytest.mark.parametrize("at_once", [10**6, 1000])
def test_shares_are_of_the_area_where_images_have_no_data_beyond(
    middle: Any, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, _ = middle
    monkeypatch.setattr(tiled, "AT_ONCE", at_once)
    grid, (low, high) = scene.require_grid(), scene.require_height_range()
    west, south, east, north = grid.widened(round(3 / grid.cell_size)).bounds
    for item in scene.train_items():
        rpc = RPC.from_file(scene.path(item.assets["rpc"].href))
        with rasterio.open(scene.path(item.assets["image"].href), "r+") as data:
            row, col = np.indices(data.shape)
            at = [localize(rpc, grid.crs, col.ravel(), row.ravel(), np.full(row.size, z)) for z in (low, high)]
            shown = np.zeros(data.shape, bool)
            for x, y in at:
                shown |= ((west < x) & (x < east) & (south < y) & (y < north)).reshape(data.shape)
            data.nodata = 0
            data.write(np.where(shown, np.maximum(data.read(), 1), 0))
    entry = prior(scene, PriorOptions())
    assert entry["prior"]["seen_by_two"] > 0.95
    assert not any("seen by fewer" in text for text in entry["notes"])

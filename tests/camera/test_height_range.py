"""The height range holds ground and roofs, without any truth."""

from typing import Any

import numpy as np
import pytest
from synthetic_views import ALT0, LAT0, LON0, parallel_rpc, render, texture

from sattools.camera.ground import from_geographic
from sattools.camera.heights import (
    by_chance,
    estimate_height_range,
    extend_range,
    in_company,
    least_patch,
    small_roofs,
    sweep_patches,
    tie_point_range,
    unseen_roofs,
)
from sattools.errors import InputError

RUNS = [(0.3, 0.05), (-0.2, 0.2), (0.0, -0.3), (0.15, 0.3), (-0.3, -0.1)]
X, Y = from_geographic("EPSG:32633", LON0, LAT0)
BOUNDS = (X - 45, Y - 45, X + 45, Y + 45)


def with_tower(ground: Any, run: tuple[float, float], roof: float) -> Any:
    """What a view shows of hills and a block of 24 x 24 m, so high."""
    block = np.zeros_like(ground)
    block[422:518, 442:538] = 1.0  # cells of 0.25 m
    level = {"height": lambda east, north: 0 * east + roof}
    on_top = render(block, run, **level) > 110.0
    return np.where(on_top, render(ground, run, **level), render(ground, run))


def test_a_few_wild_tie_points_do_not_set_the_ends() -> None:
    heights = np.r_[np.linspace(0, 20, 1000), -300, 500]
    assert tie_point_range(heights) == pytest.approx((0.1, 19.9), abs=0.1)


def test_no_tie_points_are_an_error() -> None:
    with pytest.raises(InputError, match="found no tie points"):
        tie_point_range(np.array([np.nan]))


def test_the_range_is_widened_to_planes_with_a_patch_that_clearly_agrees_only() -> None:
    planes = np.arange(0.0, 100.0, 2.0)
    patches = np.full(50, 25)  # one window of the correlation
    patches[5:15] = 500
    assert extend_range(10.0, 28.0, planes, patches, 40.0) == (10.0, 28.0)
    patches[40] = 41
    assert extend_range(10.0, 28.0, planes, patches, 40.0) == (10.0, 80.0)


def test_the_more_views_agree_the_smaller_a_roof_may_be() -> None:
    """Patches of chance had up to 47, 40 and 28 cells with 3, 7 and 12 views; tops of towers had 41 and 44 with 12."""
    assert [least_patch(views) for views in (0, 3, 7, 9, 12, 30)] == [50.0, 50.0, 50.0, 44.0, 35.0, 35.0]


def scattered(n: int, lon: float, seed: int = 0) -> Any:
    """Longitude, latitude and height of ground points over a square of some 200 m, on level ground 12 m high."""
    random = np.random.default_rng(seed)
    where = random.uniform(-1e-3, 1e-3, (n, 2))
    return np.column_stack([(lon + where[:, 0] + 180) % 360 - 180, 30.0 + where[:, 1], random.normal(12.0, 0.3, n)])


@pytest.mark.parametrize("lon", [13.0, 180.0])
def test_matches_at_any_height_have_no_company_those_on_ground_and_roofs_have(lon: float) -> None:
    points = scattered(160, lon)
    east = (points[:, 0] - lon + 180) % 360 - 180
    roof = (np.abs(east) < 3e-4) & (np.abs(points[:, 1] - 30.0) < 3e-4)
    points[roof, 2] += 60.0
    false = np.arange(0, 160, 4)
    points[false, 2] = np.random.default_rng(1).uniform(-300.0, 300.0, len(false))
    sure = in_company(points)
    true = np.setdiff1d(np.arange(160), false)
    assert roof[true].sum() >= 8
    assert sure[true].mean() > 0.95
    assert sure[false].mean() < 0.2
    assert points[sure, 2].min() > 0.0
    assert points[sure, 2].max() < 90.0


def test_a_hillside_keeps_its_range() -> None:
    """Neighbours on a slope of 30 degrees differ by more than 2 m, but some of eight lie along the slope."""
    points = scattered(200, 13.0)
    points[:, 2] += np.tan(np.radians(30)) * (points[:, 1] - 30.0) * 110_852.0
    sure = in_company(points)
    assert sure.mean() > 0.5
    assert np.ptp(points[sure, 2]) > 0.95 * np.ptp(points[:, 2])


def test_above_a_pair_more_is_looked_at_than_tie_points_and_patches_tell() -> None:
    ground = texture()
    images = [render(ground, r, height=lambda e, n: 0 * e + 12.0) for r in RUNS]
    cameras = [parallel_rpc(r) for r in RUNS]
    heights = np.linspace(ALT0 + 10.0, ALT0 + 14.0, 50)
    low, high = estimate_height_range(heights, images[:3], cameras[:3], "EPSG:32633", BOUNDS)
    pair = estimate_height_range(heights, images[:2], cameras[:2], "EPSG:32633", BOUNDS)
    assert pair == pytest.approx((low, high + 20.0), abs=1.0)


def test_above_three_images_that_agree_about_little_more_is_looked_at() -> None:
    """As of towers on different dates, whose roofs may be in no tie point and in no patch."""
    rng = np.random.default_rng(0)
    unrelated = [rng.normal(0.5, 0.1, (200, 200)).astype(np.float32) for _ in RUNS[:3]]
    cameras = [parallel_rpc(r) for r in RUNS[:3]]
    heights = np.linspace(ALT0 - 8.0, ALT0 + 8.0, 50)
    low, high = estimate_height_range(heights, unrelated, cameras, "EPSG:32633", BOUNDS)
    # half a per cent of the tie points may be false at either end; 6 m of margin
    assert (low, high) == (pytest.approx(ALT0 - 13.9, abs=0.1), pytest.approx(ALT0 + 13.9 + 40.0, abs=0.1))


@pytest.mark.parametrize(
    ("images", "found", "coherent", "metres"),
    [
        (2, 50.0, 0.9, 20.0),
        (3, 0.0, 0.19, 40.0),
        (3, 0.0, 0.21, 0.0),
        (3, 16.0, 0.1, 24.0),
        (3, 60.0, 0.1, 0.0),
        (4, 0.0, 0.1, 0.0),
    ],
)
def test_roofs_that_few_images_do_not_show_are_allowed_for(
    images: int, found: float, coherent: float, metres: float
) -> None:
    assert unseen_roofs(images, found, coherent) == metres


@pytest.mark.parametrize("n", [0, 1, 2])
def test_a_few_points_are_no_company(n: int) -> None:
    assert not in_company(scattered(n, 13.0)).any()


def test_the_sweep_peaks_at_the_height_of_a_plain() -> None:
    ground = texture()
    images = [render(ground, r, height=lambda e, n: 0 * e + 12.0) for r in RUNS]
    planes = ALT0 + np.arange(-20.0, 60.0, 2.0)
    patches, views, coherent, *_ = sweep_patches(
        images, [parallel_rpc(r) for r in RUNS], "EPSG:32633", BOUNDS, planes, 8000
    )
    assert views == len(RUNS)
    assert planes[patches.argmax()] == pytest.approx(ALT0 + 12.0, abs=2.0)
    assert patches.max() > 4000  # of 8000 cells
    assert patches[np.abs(planes - ALT0 - 12) > 6].max() < 50
    assert coherent > 0.8


def test_the_fewer_views_show_a_place_the_more_alike_they_have_to_be() -> None:
    # 0.2 * 3.5 over the root of 1, 3, 10 and 66 pairs; never less than 0.2
    np.testing.assert_allclose(by_chance(np.array([2, 3, 5, 12])), [0.7, 0.404, 0.221, 0.2], atol=5e-4)


def test_places_that_two_unrelated_views_alone_show_have_no_height() -> None:
    """As on planes so far off that the other views show something else there."""
    rng = np.random.default_rng(0)
    images = [rng.normal(0.5, 0.1, (200, 200)).astype(np.float32) for _ in RUNS]
    for image in images[2:]:
        image[:] = np.nan
    planes = ALT0 + np.arange(-20.0, 60.0, 2.0)
    patches, views, coherent, *_ = sweep_patches(
        images, [parallel_rpc(r) for r in RUNS], "EPSG:32633", BOUNDS, planes, 8000
    )
    assert views == 2
    assert coherent < 0.05
    assert patches.max() < 25  # 38 where as little is asked of two views as of five


@pytest.mark.parametrize("roof", [40.0, 75.0])
def test_a_tower_without_tie_points_is_inside_the_range(roof: float) -> None:
    """However many times as high as what tie points lie on."""
    ground = texture()
    images = [with_tower(ground, r, roof) for r in RUNS]
    bulk = ALT0 + np.linspace(-8, 8, 200)  # tie points on the hills only
    cameras = [parallel_rpc(r) for r in RUNS]
    low, high = estimate_height_range(bulk, images, cameras, "EPSG:32633", BOUNDS)
    assert low < ALT0 - 8.0
    assert ALT0 + roof < high < ALT0 + roof + 25.0


@pytest.fixture(scope="module")
def coarsely() -> Any:
    """Images of a tower of 75 m, their cameras, and what they show on cells of 3 m, of which its roof has 64."""
    ground = texture()
    images, cameras = [with_tower(ground, r, 75.0) for r in RUNS], [parallel_rpc(r) for r in RUNS]
    planes = ALT0 + np.arange(-20.0, 120.0, 2.5)
    return images, cameras, sweep_patches(images, cameras, "EPSG:32633", BOUNDS, planes, 900)


def test_a_roof_that_is_too_small_to_be_no_chance_is_looked_at_more_closely(coarsely: Any) -> None:
    images, cameras, swept = coarsely
    beyond = swept.planes > ALT0 + 20.0
    assert 10 <= swept.patches[beyond].max() < 50
    assert extend_range(ALT0 - 8, ALT0 + 8, swept.planes, np.where(beyond, swept.patches, 0), 50)[1] == ALT0 + 8
    found = small_roofs(ALT0 + 20.0, swept, 50.0, images, cameras, "EPSG:32633")
    assert found == pytest.approx(ALT0 + 75.0, abs=2.5)


def test_what_agrees_by_chance_does_not_when_it_is_looked_at_more_closely(coarsely: Any) -> None:
    """Thirty cells far above the hills, 20 m beside the tower."""
    images, cameras, swept = coarsely
    k = int(np.argmin(np.abs(swept.planes - ALT0 - 110.0)))
    patches, places = np.zeros_like(swept.patches), swept.places.copy()
    patches[k], places[k] = 30, (X - 30, Y - 30, 8.0)
    swept = swept._replace(patches=patches, places=places)
    assert small_roofs(ALT0 + 80.0, swept, 50.0, images, cameras, "EPSG:32633") == ALT0 + 80.0


def test_cells_are_no_finer_than_pixels(coarsely: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between pixels is nothing that could agree: what is as coarse is not looked at again."""
    images, cameras, swept = coarsely
    monkeypatch.setattr("sattools.camera.heights.ground_sample_distance", lambda *_: 0.9 * swept.cell)
    assert small_roofs(ALT0 + 20.0, swept, 50.0, images, cameras, "EPSG:32633") == ALT0 + 20.0


def test_two_images_are_not_looked_at_more_closely(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sattools.camera.heights.small_roofs", lambda *_: pytest.fail("was asked"))
    ground = texture()
    images, cameras = [render(ground, r) for r in RUNS[:2]], [parallel_rpc(r) for r in RUNS[:2]]
    estimate_height_range(ALT0 + np.linspace(-8, 8, 50), images, cameras, "EPSG:32633", BOUNDS)

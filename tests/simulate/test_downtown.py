"""A harder city: what it has, and that rays meet it as they should."""

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sattools.scene.grid import Grid
from sattools.scene.raster import read_image, read_raster
from sattools.simulate import SimulateOptions, simulate
from sattools.simulate.canvas import Canvas
from sattools.simulate.detailed import (
    BARE_SHARE,
    GLASS,
    LEAFY,
    NO_CROWN,
    PLAIN,
    WINDOWS,
    DetailedWorld,
    leaves_on,
    over_surface_model,
)  # fmt: skip
from sattools.simulate.detailed_trace import LEAF, first_hit, mirrored_sun, wall_look
from sattools.simulate.downtown import build_downtown
from sattools.simulate.roofs import barrel, clutter, dome, parapet
from sattools.simulate.terrain import build_terrain
from sattools.simulate.trace import TOP, WALL_X
from sattools.simulate.trace import first_hit as friendly_hit
from sattools.simulate.world import BUILDING, GROUND, TREES, WATER

SMALL = {"terrain": "downtown", "size": 48.0, "views": 4, "dates": 4, "gsd": 1.0, "seed": 2}


@pytest.fixture(scope="module")
def world() -> DetailedWorld:
    return build_downtown((0.0, 0.0), 128.0, 0.5, 10.0, np.random.default_rng(4))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return simulate(SimulateOptions(**SMALL), tmp_path_factory.mktemp("downtown"))


def test_a_downtown_has_towers_narrow_streets_water_and_trees(world: DetailedWorld) -> None:
    assert 50 < world.top.max() - 10 < 165  # a tower, its plant rooms and mast
    assert set(np.unique(world.classes)) == {GROUND, TREES, BUILDING, WATER}
    shares = {c: float((world.classes == c).mean()) for c in (GROUND, TREES, BUILDING, WATER)}
    assert 0.3 < shares[BUILDING] < 0.75
    assert 0.01 < shares[TREES] < 0.3
    assert 0.01 < shares[WATER] < 0.15
    # water lies below the quays
    assert world.height[world.classes == WATER].max() < world.height[world.classes == GROUND].min()
    assert world.gloss[world.classes == WATER].min() > 1
    assert len(np.unique(world.building)) > 30
    assert set(np.unique(world.windows[world.classes == BUILDING])) == {0, 1, 2, 3, 4}


def test_seeds_give_other_downtowns_the_same_seed_the_same(world: DetailedWorld) -> None:
    again, other = (build_downtown((0.0, 0.0), 128.0, 0.5, 10.0, np.random.default_rng(k)) for k in (4, 5))
    np.testing.assert_array_equal(again.height, world.height)
    np.testing.assert_array_equal(again.crown_top, world.crown_top)
    assert other.rotation_deg != world.rotation_deg


def test_crowns_stand_over_the_ground_and_nowhere_else(world: DetailedWorld) -> None:
    crowns = world.classes == TREES
    np.testing.assert_array_equal(crowns, world.crown_top > world.crown_base)
    assert (world.crown_base - world.height)[crowns].min() > 0
    assert (world.crown_top[~crowns] == NO_CROWN).all()
    assert 4 < np.quantile((world.crown_top - world.height)[crowns], 0.9) < 25
    # the truth is what lidar sees first
    rows, columns = np.nonzero(crowns)
    turn = np.linalg.inv(world.turn)
    at = np.stack([columns[::50] + 0.5 - world.shape[1] / 2, rows[::50] + 0.5 - world.shape[0] / 2]) * world.cell_size
    east, north = turn @ at
    np.testing.assert_allclose(world.surface(east, north), world.crown_top[rows[::50], columns[::50]])


def column_of_leaves(share: float) -> dict[str, np.ndarray]:
    """A plain at 0 m of 20 x 20 cells of 0.5 m; on its middle 10 x 10 leaves from 4 to 8 m."""
    flat = np.zeros((20, 20), np.float32)
    top, base, foliage = np.full_like(flat, NO_CROWN), np.full_like(flat, NO_CROWN), np.zeros_like(flat)
    top[5:15, 5:15], base[5:15, 5:15], foliage[5:15, 5:15] = 8.0, 4.0, share
    return {"height": flat, "crown_base": base, "crown_top": top, "foliage": foliage}


def shoot(rasters: dict[str, np.ndarray], x: float, y: float, dx: float = 0.0) -> tuple[float, int, int, int]:
    """First hit of a ray that falls from 20 m."""
    flat = np.zeros_like(rasters["height"])
    return first_hit(
        rasters["height"], flat, flat, rasters["crown_base"], rasters["crown_top"], rasters["foliage"], 0.5, x, y, 20.0,
        dx, 0.0, -1.0, -5.0, False, 0.0, 21.0, 0.0,
    )  # fmt: skip


@pytest.mark.parametrize(("share", "low", "high"), [(0.0, 0.0, 0.0), (0.1, 0.4, 0.7), (1.0, 1.0, 1.0)])
def test_rays_meet_clumps_as_often_as_they_are_filled(share: float, low: float, high: float) -> None:
    rasters = column_of_leaves(share)
    hits = [shoot(rasters, 5.5 + c, 5.5 + r) for r in range(10) for c in range(10)]
    met = np.mean([face == LEAF for *_, face in hits])
    assert low <= met <= high  # eight layers of clumps: 1 - 0.9^8 = 0.57 for a tenth
    for t, _, _, face in hits:
        assert (12 <= t <= 16 + 1e-3) if face == LEAF else t == pytest.approx(20)
    if share == 1.0:
        assert all(t == pytest.approx(12) for t, *_ in hits)


def test_a_slanting_ray_passes_below_a_crown_or_meets_its_side() -> None:
    rasters = column_of_leaves(1.0)
    # half a cell (0.25 m) outward per metre of fall: at 8 m the ray is 6 cells from where it started
    t, column, _, face = shoot(rasters, 0.0, 10.0, dx=0.5)
    assert (face, column, t) == (LEAF, 6, pytest.approx(12))
    # reaches the leaves' columns at a height of 3 m, below the base
    t, _, _, face = shoot(rasters, 3.5 - 8.5 / 2, 10.0, dx=0.34)
    assert (face, t) == (TOP, pytest.approx(20))


def test_without_crowns_rays_end_where_the_friendly_tracer_has_them_end() -> None:
    rng = np.random.default_rng(0)
    height = np.where(rng.random((30, 30)) < 0.3, 8.0, 0.0).astype(np.float32)
    flat, none = np.zeros_like(height), np.full_like(height, NO_CROWN)
    for x, y, dx, dy in rng.uniform((2, 2, -0.8, -0.8), (28, 28, 0.8, 0.8), (200, 4)):
        ray = 0.5, x, y, 10.0, dx, dy, -1.0, -2.0, False, 0.0, 11.0
        expected = friendly_hit(height, flat, flat, *ray)
        assert first_hit(height, flat, flat, none, none, flat, *ray, 0.0) == expected
        assert expected[3] in (TOP, WALL_X, 2)


def test_mirrors_shine_where_the_half_vector_is_the_normal() -> None:
    up = (0.0, 0.0, 1.0)
    tilted = (math.sin(0.5), 0.0, math.cos(0.5))
    assert mirrored_sun(*up, *tilted, -tilted[0], 0.0, tilted[2]) == pytest.approx(1)
    # sun and sensor both 0.5 rad to one side: the half vector is 0.5 rad off, cos(0.5)^60 = 0.000394
    assert mirrored_sun(*up, *tilted, *tilted) == pytest.approx(math.cos(0.5) ** 60)


def test_every_building_and_side_has_a_wall_of_its_own_and_panes_mirror() -> None:
    plain = {(b, s): wall_look(PLAIN, b, s, 0.4, 0.3, 1, 0)[0] for b in (1, 2) for s in range(4)}
    assert len(set(plain.values())) == 8
    assert all(0.6 * 0.85 * 0.88 <= v <= 1.4 * 1.15 * 1.12 for v in plain.values())
    along = np.arange(0, 40, 0.2)
    for style, share in ((PLAIN, 0.0), (WINDOWS, 0.25), (GLASS, 0.85)):
        mirrored = [wall_look(style, 7, 0, a, b, 1, 0)[1] > 0 for a in along for b in along]
        assert np.mean(mirrored) == pytest.approx(share, abs=0.03), style
    # what a wall looks like does not depend on the image, but for a pane in fifty
    looks = [[wall_look(GLASS, 7, 0, a, b, view, 0) for a in along[::4] for b in along[::4]] for view in (1, 2)]
    assert 0.01 < np.mean([a != b for a, b in zip(*looks, strict=True)]) < 0.1


def test_trees_are_bare_in_winter_and_meadows_pale(world: DetailedWorld) -> None:
    assert leaves_on(datetime(2015, 7, 20, tzinfo=UTC), 45.0) == 1
    assert leaves_on(datetime(2015, 1, 20, tzinfo=UTC), 45.0) == 0
    assert leaves_on(datetime(2015, 1, 20, tzinfo=UTC), -45.0) == 1
    assert leaves_on(datetime(2015, 1, 20, tzinfo=UTC), 10.0) == 1
    bare, green = world.on_day(0.0), world.on_day(1.0)
    np.testing.assert_allclose(green.albedo, world.albedo, rtol=1e-5)
    leafless = (world.classes == TREES) & ~world.evergreen
    np.testing.assert_allclose(bare.foliage[leafless], BARE_SHARE * LEAFY, rtol=1e-5)
    np.testing.assert_allclose(bare.foliage[(world.classes == TREES) & world.evergreen], LEAFY, rtol=1e-5)
    np.testing.assert_allclose(
        (bare.albedo / world.albedo)[world.meadow], [[1.7, 1.15, 1.35]] * world.meadow.sum(), 1e-4
    )
    np.testing.assert_array_equal(bare.top, world.top)


def canvas_with_roof() -> tuple[Canvas, tuple[slice, slice]]:
    canvas = Canvas(0.5, np.zeros((80, 80)))
    area = canvas.box(5, 5, 35, 25)
    canvas.flat(area, 10.0, "gravel", np.full(3, 0.3, np.float32))
    return canvas, area


def test_parapets_and_clutter_stand_on_their_roof_alone() -> None:
    canvas, area = canvas_with_roof()
    parapet(canvas, area, 10.0)
    roof = canvas.height[area]
    assert (roof[0] == 11).all()
    assert (roof[:, -1] == 11).all()
    assert (roof[1:-1, 1:-1] == 10).all()
    clutter(canvas, area, 10.0, np.random.default_rng(1))
    assert (roof[0] == 11).all()
    assert 0.03 < (roof[2:-2, 2:-2] > 10.3).mean() < 0.5
    assert roof.min() == 10
    assert roof.max() < 19.1
    outside = np.ones(canvas.height.shape, bool)
    outside[area] = False
    assert (canvas.height[outside] == 0).all()


def test_vaults_and_domes_rise_as_circles_do() -> None:
    canvas, area = canvas_with_roof()
    barrel(canvas, area, 10.0, 4.0, "metal", np.full(3, 0.3, np.float32))
    across = canvas.height[area][:, 30] - 10  # 20 m across the axis
    assert across.max() == pytest.approx(4, abs=0.01)
    assert across[10] == pytest.approx(4 * math.sqrt(1 - (9.5 / 20) ** 2), abs=1e-5)
    assert np.ptp(canvas.height[area][20]) == 0
    canvas, area = canvas_with_roof()
    dome(canvas, area, 10.0, "copper")
    # 0.38 of 20 m on a drum of 2 m
    assert canvas.height[area].max() == pytest.approx(10 + 2 + 7.6, abs=0.02)
    assert canvas.height[area][0, 0] == 10


def test_a_surface_model_keeps_its_heights_when_its_trees_become_porous() -> None:
    heights = np.zeros((60, 60), np.float32)
    classes = np.full((60, 60), GROUND, np.uint8)
    heights[10:30, 10:30], classes[10:30, 10:30] = 12.0, BUILDING
    heights[40:50, 40:50], classes[40:50, 40:50] = 8.0, TREES
    heights[5:7, 50:55], classes[5:7, 50:55] = 0.5, TREES  # a shrub
    grid = Grid("EPSG:32617", 0.0, 60.0, 1.0, 60, 60)
    plain = build_terrain(heights, grid, classes, 0.5, np.random.default_rng(0))
    detailed = over_surface_model(plain, np.random.default_rng(0))
    np.testing.assert_allclose(detailed.top, plain.height, atol=1e-5)
    crowns = detailed.crown_top > detailed.crown_base
    assert crowns.sum() == 20 * 20
    np.testing.assert_allclose(detailed.height[crowns], 0.0, atol=1e-5)
    np.testing.assert_allclose(detailed.crown_base[crowns], 0.35 * 8, atol=1e-4)
    assert detailed.building.max() == 1


def test_one_camera_of_a_downtown_is_far_off(scene: Any) -> None:
    errors = sorted(math.hypot(*item.properties["sattools:simulated"]["rpc_bias_px"]) for item in scene.items)
    assert errors[-2] <= 3
    assert 15 <= errors[-1] <= 36


def test_images_of_a_downtown_show_saturated_roofs_cars_and_haze(scene: Any) -> None:
    images = [read_image(scene.path(item.assets["image"].href)) for item in scene.items]
    saturated = [(image == 2047).any(axis=0).mean() for image in images]
    assert 0.001 < max(saturated) < 0.6
    darkest = [float(np.quantile(image[2], 0.02)) for image in images]
    assert max(darkest) > 1.5 * min(darkest)
    truth = read_raster(scene.path(scene.products["truth_dsm"]))[0]
    assert np.ptp(truth) > 15


def test_a_downtown_is_also_made_of_a_surface_model(scene: Any, tmp_path: Path) -> None:
    dsm, classes = (str(scene.path(scene.products[f"truth_{name}"])) for name in ("dsm", "classes"))
    given = simulate(SimulateOptions(**{**SMALL, "views": 2, "dsm": dsm, "classes": classes}), tmp_path)
    a, b = (read_raster(s.path(s.products["truth_dsm"]))[0][0] for s in (scene, given))
    assert np.median(np.abs(a - b)) < 0.05
    assert len(given.items) == 2

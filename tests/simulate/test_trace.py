"""The ray tracer against cases that can be worked out on paper."""

import math
from typing import Any

import numpy as np
import pytest

from sattools.camera.ground import direction
from sattools.simulate.camera import Pushbroom
from sattools.simulate.trace import render, sky_view
from sattools.simulate.world import World

CELL = 0.25
EAST, NORTH = 500_000.0, 3_000_000.0


def plain(size_m: float = 80.0, rotation_deg: float = 0.0) -> World:
    """Level ground at 0 m with reflectance 0.2, walls of 0.4."""
    count = round(size_m / CELL)
    zero = np.zeros((count, count), np.float32)
    return World(
        (EAST, NORTH), rotation_deg, CELL, zero.copy(), zero.copy(), zero.copy(), np.full(zero.shape, 2, np.uint8),
        np.full((*zero.shape, 3), 0.2, np.float32), np.full((*zero.shape, 3), 0.4, np.float32),
        np.zeros(zero.shape, np.uint8),
    )  # fmt: skip


def with_box(world: World, height: float, half_m: float = 5.0) -> World:
    """A box of `height` with edges at ±`half_m` about the middle."""
    middle, half = world.shape[0] // 2, round(half_m / CELL)
    world.height[middle - half : middle + half, middle - half : middle + half] = height
    return world


def look(
    world: Any, view: Any, sun: Any, shape: Any = (121, 121), pixel: Any = 0.5, samples: Any = 1, sky: Any = 0.0
) -> Any:
    """Image, sunlit share and height seen by a camera whose middle pixel sees the middle of the ground."""
    camera = Pushbroom.towards(np.array([EAST, NORTH, 0.0]), view, pixel, shape)
    open_sky = np.ones((1, 1), np.float32)
    return render(
        world.height, world.slope_x, world.slope_y, world.albedo, world.wall_albedo, world.windows, open_sky, 10**6,
        world.cell_size, world.turn, np.array(world.centre), camera.origin, camera.velocity, camera.look,
        camera.across, camera.focal, camera.col0, camera.row0, shape, samples, sun, np.ones(3), np.full(3, sky),
        -1.0, float(world.height.max()) + 1.0,
    )  # fmt: skip


NADIR = np.array([0.0, 0.0, 1.0])


def test_level_ground_is_albedo_times_cosine_of_the_sun_plus_sky() -> None:
    image, lit, height = look(plain(), NADIR, direction(150, 30), sky=0.1)
    assert image == pytest.approx(np.full(image.shape, 0.2 * (0.5 + 0.1)), rel=1e-5)
    assert (lit == 1).all()
    assert height == pytest.approx(np.zeros(height.shape), abs=1e-5)


def test_tilted_ground_follows_the_cosine_to_its_normal() -> None:
    world = plain()
    slope = math.tan(math.radians(20))
    world.slope_x[:] = slope
    world.height[:] = slope * (np.arange(world.shape[1]) + 0.5 - world.shape[1] / 2) * CELL
    # climbs to the east by 20°; a sun in the west at 40° stands 40 + 20 = 60° above that plane
    image, lit, _ = look(world, NADIR, direction(270, 40), shape=(41, 41))
    assert image == pytest.approx(np.full(image.shape, 0.2 * math.sin(math.radians(60))), rel=1e-5)
    assert (lit == 1).all()


@pytest.mark.parametrize(
    ("elevation", "height", "pixels"),
    [(45.0, 10.0, 20), (30.0, 8.0, 28)],  # 10 / tan 45° = 10 m, 8 / tan 30° = 13.86 m, at 0.5 m a pixel
)
def test_shadow_is_as_long_as_height_over_tangent_of_the_sun(elevation: Any, height: Any, pixels: Any) -> None:
    # an even number of pixels, so that the walls fall between two; sun in the south, shadow to the north (up)
    _, lit, _ = look(with_box(plain(), height), NADIR, direction(180, elevation), shape=(120, 120))
    dark = np.flatnonzero(lit[:, 60] == 0)
    assert dark.max() == 49  # it begins at the wall, 5 m = 10 pixels north of the middle
    assert len(dark) == pixels
    assert dark.min() == 50 - pixels


@pytest.mark.parametrize("rotation", [0.0, 17.0])
def test_shadow_falls_away_from_the_sun(rotation: Any) -> None:
    _, lit, _ = look(with_box(plain(rotation_deg=rotation), 10.0), NADIR, direction(135, 45))
    rows, columns = np.nonzero(lit == 0)
    # sun in the south-east: the shadow's centre lies north-west (up and left) of the box
    assert rows.mean() < 55
    assert columns.mean() < 55
    assert rows.mean() == pytest.approx(columns.mean(), abs=0.3 if rotation == 0 else 4)


def test_a_roof_leans_away_from_the_sensor_and_hides_the_ground_behind() -> None:
    # sensor in the west, 30° off nadir; the roof at 10 m is displaced to the east by 10 tan 30° = 5.77 m on the ground
    image, _, height = look(with_box(plain(), 10.0), direction(270, 60), direction(180, 45), pixel=0.25)
    middle = height[60]
    roof = np.flatnonzero(np.abs(middle - 10.0) < 1e-3)
    # across the line of sight a ground metre measures cos 30° m, 0.25 m a pixel
    first, last = ((x + 10 * math.tan(math.radians(30))) * math.cos(math.radians(30)) / 0.25 + 60 for x in (-5, 5))
    assert roof.min() == pytest.approx(first, abs=1.0)
    assert roof.max() == pytest.approx(last, abs=1.0)
    # west of the roof the west wall shows, with heights rising from 0 to 10; nothing of it is on the east side
    wall = (middle > 0.01) & (middle < 9.99)
    assert wall.sum() == pytest.approx(10 * math.sin(math.radians(30)) / 0.25, abs=1.5)
    assert np.flatnonzero(wall).max() < roof.min()
    assert (np.diff(middle[wall]) > 0).all()
    # a wall that faces west gets nothing from a sun due south
    assert image[:, 60, wall].max() < 1e-6


def test_a_wall_is_lit_by_the_cosine_to_its_own_normal() -> None:
    world = with_box(plain(), 10.0)
    image, lit, height = look(world, direction(180, 60), direction(180, 30), pixel=0.25)
    wall = (height[:, 60] > 1) & (height[:, 60] < 9)
    assert wall.sum() > 10
    assert image[0, wall, 60] == pytest.approx(np.full(wall.sum(), 0.4 * math.cos(math.radians(30))), rel=1e-4)
    assert (lit[wall, 60] == 1).all()


def test_sky_share_is_one_in_the_open_and_half_at_the_foot_of_a_long_high_wall() -> None:
    world = plain(20.0)
    world.height[:, 40:] = 100.0  # the eastern half
    share = sky_view(world.height, world.slope_x, world.slope_y, CELL, 8, 101.0)
    assert share[5, 4] == 0.5  # 0.9 m west of the wall
    level = plain(20.0)
    assert (sky_view(level.height, level.slope_x, level.slope_y, CELL, 8, 1.0) == 1).all()


def test_more_rays_a_pixel_blend_across_an_edge() -> None:
    _, one, _ = look(with_box(plain(), 10.0), NADIR, direction(180, 41), samples=1)
    _, many, _ = look(with_box(plain(), 10.0), NADIR, direction(180, 41), samples=3)
    assert set(np.unique(one)) == {0.0, 1.0}
    assert ((many > 0) & (many < 1)).any()
    assert many.mean() == pytest.approx(one.mean(), abs=0.01)

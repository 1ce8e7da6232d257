"""The shadow of a wall shows where it stands."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from sattools.prior.frame import Frame
from sattools.prior.visibility.cast import shadow_sides
from sattools.prior.visibility.edges import snap_edges
from sattools.prior.visibility.sides import Surroundings

NOISE = 0.04
CELL = 0.5
MARGIN = 4
SUN = (0.0, -math.sqrt(0.5), math.sqrt(0.5))  # in the south, 45 degrees high: 10 m throw 20 cells of shadow northward


@pytest.fixture
def height() -> Any:
    """A house of 20 x 20 cells, 10 m high, in the south of flat ground."""
    height = np.zeros((60, 40), np.float32)
    height[34:54, 10:30] = 10.0
    return height


def shadowed(height: Any, views: int = 3, sun: Any = SUN, slopes: Any = None) -> Any:
    """Views of a house which nothing but its shadow tells from the ground; it begins at row 14."""
    image = np.full((height.shape[0] + 2 * MARGIN, height.shape[1] + 2 * MARGIN), 0.6, np.float32)
    image[MARGIN + 14 : MARGIN + 34, MARGIN + 10 : MARGIN + 30] = 0.2
    images = image + np.random.default_rng(0).normal(0, 0.01, (views, *image.shape)).astype(np.float32)
    slopes = np.zeros((views, 2)) if slopes is None else slopes
    return Frame(images, np.ones(images.shape, np.uint8), slopes, 0.0, CELL, MARGIN, (sun,) * views)


def seen(frame: Any) -> Any:
    """Nothing hides anything."""
    return np.full(frame.images.shape, -1e9, np.float32)


def sides(frame: Any, height: Any, hits: Any = None, noise: float = NOISE) -> Any:
    """`shadow_sides` at a wall that runs from east to west, up to the south, between 0 and 10 m."""
    uphill = np.zeros((2, *height.shape), np.float32)
    uphill[0] = 1.0
    near = np.zeros(height.shape, bool)
    near[30:38, 14:26] = True
    below, above = (np.where(near, z, np.nan).astype(np.float32) for z in (0.0, 10.0))
    off_step = np.ones(height.shape, bool)
    off_step[33:35] = False
    return shadow_sides(
        frame, seen(frame) if hits is None else hits, height, off_step, uphill, (below, above),
        tolerance=2.0, noise=noise, around=Surroundings(),
    )  # fmt: skip


def test_what_throws_the_shadow_is_high_and_what_throws_none_is_low(height: Any) -> None:
    like, views = sides(shadowed(height), height)
    assert views[31:37, 20].tolist() == [3.0] * 6
    # the beam over row 34 ends at row 14, the first in the shadow; each view is as sure as it can be
    np.testing.assert_allclose(like[31:34, 20], -3.0)
    np.testing.assert_allclose(like[34:37, 20], 3.0)
    assert not views[20, 20]  # away from the wall


def test_the_place_where_a_beam_ends_is_found_on_ground_of_another_height(height: Any) -> None:
    # ground 2 m higher from row 24 northward: the shadow of the roof's edge is 4 cells nearer to the wall
    height[:24] = 2.0
    frame = shadowed(height)
    frame.images[:] = np.roll(frame.images, 4, axis=1)
    like, views = sides(frame, height)
    assert views[34, 20] == 3
    assert like[33, 20] == pytest.approx(-3.0)
    assert like[34, 20] == pytest.approx(3.0)


def test_views_from_aside_see_it_where_parallax_puts_it(height: Any) -> None:
    height += 5.0
    slopes = np.array([[0.6, 0.0], [-0.6, 0.4], [0.2, -0.4]])  # times 5 m: whole cells
    frame = shadowed(height, slopes=slopes)
    for image, slope in zip(frame.images, slopes, strict=True):
        image[:] = np.roll(image, np.rint(5 * slope).astype(int), axis=(0, 1))
    below, above = np.full_like(height, 5.0), np.full_like(height, 15.0)
    uphill = np.zeros((2, *height.shape), np.float32)
    uphill[0] = 1.0
    like, views = shadow_sides(
        frame, seen(frame), height, np.ones(height.shape, bool), uphill, (below, above),
        tolerance=2.0, noise=NOISE, around=Surroundings(),
    )  # fmt: skip
    assert views[34, 20] == 3
    assert (like[33, 20], like[34, 20]) == (pytest.approx(-3.0), pytest.approx(3.0))


@pytest.mark.parametrize(
    "sun", [None, (0.0, math.sqrt(0.5), math.sqrt(0.5)), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -0.04, 0.9992)]
)
def test_a_wall_that_throws_no_shadow_or_that_of_an_unknown_sun_tells_nothing(height: Any, sun: Any) -> None:
    # unknown, behind the viewer, on the horizon, at the zenith, nearly there
    like, views = sides(shadowed(height, sun=sun), height)
    assert not views.any()
    assert not like.any()


def test_shadow_that_no_view_sees_and_that_of_a_single_view_tell_nothing(height: Any) -> None:
    frame = shadowed(height)
    assert not sides(frame, height, np.full(frame.images.shape, 50.0, np.float32))[1].any()
    frame.masks[:] = 0
    assert not sides(frame, height)[1].any()
    assert not sides(shadowed(height, views=1), height)[1].any()


def test_ground_that_is_brighter_where_the_shadow_should_be_tells_nothing(height: Any) -> None:
    frame = shadowed(height)
    frame.images[:] = 0.8 - frame.images
    assert not sides(frame, height)[1].any()


def test_a_beam_that_meets_another_house_or_leaves_the_area_tells_nothing(height: Any) -> None:
    other = height.copy()
    other[8:20, 8:32] = 12.0
    assert not sides(shadowed(height), other)[1].any()
    assert not sides(shadowed(height, sun=(0.0, -0.9, math.sqrt(1 - 0.81))), height)[1].any()


def test_a_roof_as_dark_as_the_shadow_at_its_foot_ends_where_that_shadow_says(height: Any) -> None:
    wide = height.copy()
    wide[32:34, 10:30] = 10.0  # two cells too far north

    def found(sun: Any) -> Any:
        frame = shadowed(height, sun=sun)
        frame.images[:, MARGIN + 34 : MARGIN + 54, MARGIN + 10 : MARGIN + 30] -= 0.4
        return snap_edges(frame, seen(frame), wide, 2.0, NOISE).height[30:36, 15:25]

    assert (found(SUN) == height[30:36, 15:25]).all()
    assert (found(None) == wide[30:36, 15:25]).all()


def plain_shadow(frame: Any, height: Any, off_step: Any, row: int, col: int, view: int, look: int) -> float:
    """The likeness of one cell of the wall between 0 and 10 m in one view, in plain NumPy; flat ground at 0 m."""
    sun = np.array(frame.suns[view])
    beam = 10.0 * np.array([sun[1], -sun[0]]) / sun[2] / CELL
    landed = np.array([row, col]) + beam
    i, j = np.indices((2 * look + 1,) * 2) - look
    shift = np.rint(landed).astype(int)
    r, c = row + i, col + j
    kept = ((i + j) % 2 == 0) & off_step[r, c] & (height[shift[0] + i, shift[1] + j] == 0)
    i, j, high = i[kept], j[kept], height[r, c][kept] > 5
    weight = np.exp(-(i**2 + j**2) / (2 * np.where(high, 4.0, 3.0) ** 2))
    values = frame.images[view][shift[0] + MARGIN + i, shift[1] + MARGIN + j].astype(float)
    dark, lit = (np.average(values[side], weights=weight[side]) for side in (high, ~high))
    spread = [np.average((values[s] - m) ** 2, weights=weight[s]) for s, m in ((high, dark), (~high, lit))]
    here = map_coordinates(frame.images[view].astype(float), (landed + MARGIN)[:, None], order=1)[0]
    return float(np.clip((dark - lit) * (here - (dark + lit) / 2) / (0.3**2 + sum(spread) / 2) / 2, -1, 1))


@given(st.lists(st.tuples(st.floats(-0.1, 0.1), st.floats(0.95, 1.05)), min_size=2, max_size=3), st.integers(0, 999))
@settings(max_examples=25, deadline=None)
def test_the_kernel_does_as_plain_numpy(suns: list[tuple[float, float]], seed: int) -> None:
    height = np.zeros((60, 40), np.float32)
    height[34:54, 10:30] = 10.0
    frame = shadowed(height, views=len(suns))
    frame.images[:] += np.random.default_rng(seed).normal(0, 0.05, frame.images.shape)
    directions = [np.array([east, -1.0, up]) for east, up in suns]
    frame = replace(frame, suns=tuple(tuple(d / np.linalg.norm(d)) for d in directions))
    off_step = np.ones(height.shape, bool)
    off_step[33:35] = False
    like, views = sides(frame, height, noise=0.3)
    for row, col in ((32, 20), (33, 18), (34, 21), (35, 17)):
        expected = [plain_shadow(frame, height, off_step, row, col, v, 4) for v in range(len(suns))]
        assert views[row, col] == len(suns)
        assert like[row, col] == pytest.approx(sum(expected), abs=1e-4)  # sums of float32 pixels

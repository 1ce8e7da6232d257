"""Shifts and tilts found from heights alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from align_ground import CRS, GRID, surface, tilted
from scipy.ndimage import gaussian_filter

from sattools.align.determined import open_direction
from sattools.align.estimate import shift_to_dem
from sattools.align.shift import Shift
from sattools.errors import InputError
from sattools.scene.grid import Grid

SHIFT = (3.0, -2.0, 5.0)


@pytest.mark.parametrize("method", ["icp", "nuth-kaab"])
@pytest.mark.parametrize("cell", [0.5, 1.0, 10.0])
def test_a_shift_is_found_to_a_third_of_a_metre_whatever_the_references_cells(cell: float, method: Any) -> None:
    rng = np.random.default_rng(0)
    count = round(400 / cell)
    other = Grid(crs=CRS, left=436000.0, top=3355400.0, cell_size=cell, width=count, height=count)
    height = surface(GRID) + rng.normal(0, 0.5, GRID.shape).astype(np.float32)
    height[100:150, 200:230] += 15.0  # a building that the reference does not know
    found = shift_to_dem(height, GRID, surface(other, SHIFT, fine=10 if cell == 10 else 1), other, method)
    assert (found.east, found.north, found.up) == pytest.approx(SHIFT, abs=0.3)
    assert found.after < found.before


def test_height_alone_is_moved_if_asked_for() -> None:
    found = shift_to_dem(surface(GRID), GRID, surface(GRID) + 5.0, GRID, "z")
    assert (found.east, found.north) == (0.0, 0.0)
    assert found.up == pytest.approx(5.0, abs=1e-4)


@pytest.mark.parametrize("cell", [0.5, 1.0, 10.0])
@pytest.mark.parametrize("along", [(0.0, 0.0), (2e-3, -5e-3)])
def test_closest_points_find_a_shift_and_a_tilt(cell: float, along: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    count = round(400 / cell)
    other = Grid(crs=CRS, left=436000.0, top=3355400.0, cell_size=cell, width=count, height=count)
    height = surface(GRID) + rng.normal(0, 0.5, GRID.shape).astype(np.float32)
    height[100:150, 200:230] += 15.0  # a building that the reference does not know
    reference = tilted(surface(other, SHIFT, fine=10 if cell == 10 else 1), other, along)
    found = shift_to_dem(height, GRID, reference, other, tilt=True)
    # at the middle of the surface, which has been moved there
    there = SHIFT[2] + along[0] * SHIFT[0] + along[1] * SHIFT[1]
    assert (found.east, found.north, found.up) == pytest.approx((*SHIFT[:2], there), abs=0.3)
    # over half the area's width that is 2 cm
    assert (found.tilt_east, found.tilt_north) == pytest.approx(along, abs=1e-4 if cell < 10 else 1e-3)
    assert found.after < 0.75 * found.before
    if any(along):  # slopes alone leave the tilt
        assert found.after < shift_to_dem(height, GRID, reference, other).after


def test_the_matrix_says_the_same_as_shift_and_tilt() -> None:
    shift = Shift(3.0, -2.0, 5.0, 1.0, 0.1, 9, 2e-3, -1e-3, 436200.0, 3355200.0)
    place = np.array([436010.0, 3355390.0, 7.0, 1.0])
    grid = Grid(CRS, place[0] - 0.5, place[1] + 0.5, 1.0, 1, 1)
    moved = shift.matrix() @ place
    assert moved[:2] == pytest.approx((436013.0, 3355388.0))
    assert moved[2] == pytest.approx(7.0 + shift.rise(grid)[0, 0])


FLAT = np.zeros(GRID.shape, np.float32)
EAST, NORTH = np.meshgrid(GRID.x() - 436000.0, GRID.y() - 3355000.0)


@pytest.mark.parametrize("method", ["nuth-kaab", "icp"])
@pytest.mark.parametrize(
    ("ground", "along"),
    [
        (FLAT, "all directions"),
        (0.1 * EAST, "all directions"),  # one slope everywhere: a shift is a change of height
        (5 * np.sin(EAST / 20), "north and south"),  # dunes
        (5 * np.sin(NORTH / 20), "east and west"),
        (5 * np.sin((EAST + NORTH) / 20), "north-west and south-east"),
    ],
)
def test_ground_that_leaves_a_direction_open_is_refused_by_name(method: Any, ground: Any, along: str) -> None:
    rng = np.random.default_rng(0)
    height, reference = (ground + rng.normal(0, 0.1, GRID.shape) for _ in range(2))
    with pytest.raises(InputError, match=f"along {along}"):
        shift_to_dem(height.astype(np.float32), GRID, reference.astype(np.float32), GRID, method)


def town(moved: tuple[int, int] = (0, 0)) -> Any:
    """Houses with flat roofs on flat ground, 60 m wide, moved by cells of half a metre [m]."""
    rng = np.random.default_rng(3)
    heights = np.zeros((120, 120), np.float32)
    for row, col, roof in zip(rng.integers(5, 95, 9), rng.integers(5, 95, 9), rng.uniform(4, 15, 9), strict=True):
        heights[row + moved[0] : row + moved[0] + 18, col + moved[1] : col + moved[1] + 14] = roof
    return heights + np.random.default_rng(sum(moved)).normal(0, 0.15, heights.shape).astype(np.float32)


def test_walls_alone_say_how_far_a_town_is_off() -> None:
    grid = Grid(CRS, 436000.0, 3355400.0, 0.5, 120, 120)
    found = shift_to_dem(town(), grid, town((3, -2)) + np.float32(2), grid)
    assert (found.east, found.north, found.up) == pytest.approx((-1.0, -1.5, 2.0), abs=0.05)
    assert not found.tilted


@pytest.mark.parametrize("cell", [0.25, 0.5])
@pytest.mark.parametrize("off", [(1, 0), (2, -1), (3, 2), (0, 3)])
def test_a_town_is_brought_to_its_place_between_cells(off: tuple[int, int], cell: float) -> None:
    """Its walls are steps wherever cells lie, and plates lie best on plates: at whole cells."""
    fine = np.zeros((480, 480), np.float32)
    rng = np.random.default_rng(5)
    for row, col, roof in zip(rng.integers(20, 380, 9), rng.integers(20, 380, 9), rng.uniform(4, 15, 9), strict=True):
        fine[row : row + 72, col : col + 56] = roof
    times = round(cell / 0.125)
    height = fine.reshape(120, 4, 120, 4).mean(axis=(1, 3)) + rng.normal(0, 0.1, (120, 120)).astype(np.float32)
    reference = fine.reshape(480 // times, times, 480 // times, times).mean(axis=(1, 3))
    grid = Grid(CRS, 436000.0, 3355400.0, 0.5, 120, 120)
    moved = Grid(CRS, 436000.0 + off[0] / 8, 3355400.0 + off[1] / 8, cell, 480 // times, 480 // times)
    found = shift_to_dem(height, grid, reference + np.float32(2), moved)
    assert (found.east, found.north, found.up) == pytest.approx((off[0] / 8, off[1] / 8, 2.0), abs=0.02)


def test_a_towns_walls_count_where_large_cells_have_made_slopes_of_them() -> None:
    grid = Grid(CRS, 436000.0, 3355400.0, 0.5, 120, 120)
    large = Grid(CRS, 436000.0, 3355400.0, 3.0, 20, 20)
    means = town((3, -2)).reshape(20, 6, 20, 6).mean(axis=(1, 3))
    found = shift_to_dem(town(), grid, means, large)
    # half a cell and more, of which the flats beside the walls know nothing
    assert (found.east, found.north) == pytest.approx((-1.0, -1.5), abs=0.3)


def test_slopes_that_lead_away_are_refused() -> None:
    grid = Grid(CRS, 436000.0, 3355400.0, 0.5, 120, 120)
    with pytest.raises(InputError, match=r"its slopes lead away from it .* --method icp"):
        shift_to_dem(town(), grid, town((3, -2)), grid, "nuth-kaab")


def test_a_dome_tells_no_tilt_from_a_shift() -> None:
    dome = ((EAST - 200) ** 2 + (NORTH - 200) ** 2) / 1000
    assert open_direction(dome, dome, 1.0) is None
    assert open_direction(dome, dome, 1.0, tilt=True) == "all directions"


def test_other_ground_is_no_reference() -> None:
    rng = np.random.default_rng(0)
    one, other = (10 * gaussian_filter(rng.normal(size=GRID.shape), 4).astype(np.float32) for _ in range(2))
    with pytest.raises(InputError, match="no slopes like the surface's"):
        shift_to_dem(one, GRID, other, GRID)


def test_a_move_that_makes_it_worse_is_refused() -> None:
    grid = GRID.resized(4.0)  # as with cells of 1 m, of which sixteen times as many are moved until the last step
    height = surface(grid) + np.random.default_rng(0).normal(0, 0.5, grid.shape).astype(np.float32)
    with pytest.raises(InputError, match=r"fits it worse once it is moved \(NMAD \d\.\d+ m, \d\.\d+ m before\)"):
        shift_to_dem(height, grid, 0.3 * surface(grid), grid)  # as a map that only resembles the ground


def test_what_is_left_of_heights_in_another_unit_is_told() -> None:
    height = surface(GRID) + np.random.default_rng(0).normal(0, 0.5, GRID.shape).astype(np.float32)

    def left(factor: float) -> float:
        return shift_to_dem(height, GRID, np.float32(factor) * surface(GRID), GRID, "z").left

    assert left(3.281) == pytest.approx(2.28, abs=0.05)
    assert left(1.0) < 0.1


def test_what_is_left_of_a_town_is_told_by_its_houses() -> None:
    grid = Grid(CRS, 436000.0, 3355400.0, 0.5, 120, 120)
    flat = town() * np.float32(0.001)  # in kilometres; the median alone would know the streets of both
    assert shift_to_dem(town(), grid, flat, grid, "z").left == pytest.approx(1.0, abs=0.01)
    assert shift_to_dem(town(), grid, town((3, -2)), grid).left < 0.2


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (3.281, r"varies 2\.\d times as much as the surface itself"),  # feet
        (
            0.05,
            r"found hardly any relief \(NMAD \d\.\d+ m, \d\.\d+ m between",
        ),  # a map of something else, with the same edges
    ],
)
@pytest.mark.parametrize("method", ["icp", "means"])
def test_what_a_level_plane_would_do_as_well_is_no_reference(factor: float, said: str, method: Any) -> None:
    grid = Grid(CRS, 436000.0, 3355400.0, 0.5, 120, 120)
    there, other = town((3, -2)), grid
    if method == "means":
        there, other = there.reshape(40, 3, 40, 3).mean(axis=(1, 3)), grid.resized(1.5)
    with pytest.raises(InputError, match=said):
        shift_to_dem(town(), grid, np.float32(factor) * there, other, method)


def test_bare_ground_under_a_town_is_a_reference_although_the_houses_are_what_varies() -> None:
    rng = np.random.default_rng(5)
    ground = (200 * gaussian_filter(rng.normal(size=GRID.shape), 12)).astype(np.float32)  # hills of 5 m
    height = ground + rng.normal(0, 0.2, GRID.shape).astype(np.float32)
    for row, col in rng.integers(0, 380, (160, 2)):
        height[row : row + 18, col : col + 18] += rng.uniform(8, 25)
    for moved in ((0.0, 0.0, 0.0), SHIFT):  # in place already, what is left may grow by a little
        other = GRID.moved(*moved[:2])
        found = shift_to_dem(height, GRID, ground + np.float32(moved[2]), other)
        assert found.left > 0.65
        assert (found.east, found.north) == pytest.approx(moved[:2], abs=0.1)


def test_level_ground_does_not_tell_whether_it_is_the_same() -> None:
    one, other = (np.random.default_rng(k).normal(0, 0.3, GRID.shape).astype(np.float32) for k in range(2))
    assert shift_to_dem(one, GRID, other, GRID, "z").left == 0.0


def test_bare_ground_under_a_town_is_no_doubtful_reference() -> None:
    rng = np.random.default_rng(2)
    ground = surface(GRID, SHIFT)
    height = surface(GRID) + rng.normal(0, 0.3, GRID.shape).astype(np.float32)
    for row, col in rng.integers(0, 380, (60, 2)):
        height[row : row + 15, col : col + 15] += rng.uniform(3, 15)
    found = shift_to_dem(height, GRID, ground, GRID)
    assert (found.east, found.north, found.up) == pytest.approx(SHIFT, abs=0.3)
    assert found.left < 0.2


def test_a_surface_in_its_place_stays_there_within_its_noise() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        height, reference = (surface(GRID) + rng.normal(0, 0.5, GRID.shape).astype(np.float32) for _ in range(2))
        found = shift_to_dem(height, GRID, reference, GRID)
        assert (found.east, found.north, found.up) == pytest.approx((0, 0, 0), abs=0.2)

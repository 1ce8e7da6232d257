"""Means over neighbouring cells, except across walls that the images agree on."""

from typing import Any

import numpy as np
import pytest

from sattools.prior.neighbours import (
    blurred_walls,
    doubtful_walls,
    mean_of_neighbours,
    means_of_cells,
    quarters,
    relief,
)
from sattools.scene import Grid
from sattools.scene.regrid import resize_map

ROWS, COLS = np.mgrid[0:30, 0:40].astype(np.float32)


@pytest.fixture
def wall() -> Any:
    """A step of 10 m between sloping planes."""
    return np.where(COLS < 20, 3.0 + 0.3 * ROWS, 13.0 + 0.2 * COLS).astype(np.float32)


def test_a_plane_stays_as_it_is() -> None:
    plane = 5.0 + 0.4 * ROWS - 0.7 * COLS
    np.testing.assert_allclose(mean_of_neighbours(plane), plane, atol=1e-4)
    np.testing.assert_allclose(mean_of_neighbours(plane, np.ones(plane.shape)), plane, atol=1e-4)


def test_noise_on_a_flat_goes_down() -> None:
    noise = np.random.default_rng(0).normal(0, 0.2, ROWS.shape).astype(np.float32)
    found = mean_of_neighbours(noise)[3:-3, 3:-3]
    # (1 4 6 4 1) / 16 along both axes leaves 70 / 256 of the standard deviation
    assert found.std() == pytest.approx(0.2 * 70 / 256, rel=0.15)
    assert mean_of_neighbours(noise).mean() == pytest.approx(noise.mean(), abs=0.01)


def test_a_wall_that_the_images_agree_on_stays_sharp_and_planes_end_at_it(wall: Any) -> None:
    np.testing.assert_allclose(mean_of_neighbours(wall, np.zeros(wall.shape)), wall, atol=1e-4)
    np.testing.assert_allclose(mean_of_neighbours(wall), wall, atol=1e-4)


def test_a_wall_that_may_be_anywhere_becomes_a_ramp_around_its_place(wall: Any) -> None:
    flat = np.where(COLS < 20, 0.0, 5.0).astype(np.float32)
    found = mean_of_neighbours(flat, np.ones(flat.shape))
    np.testing.assert_allclose(found[15, 17:23], 5 / 16 * np.array([0, 1, 5, 11, 15, 16]), atol=1e-5)
    half = mean_of_neighbours(flat, np.full(flat.shape, 0.5))[15]
    assert 0 < half[19] < found[15, 19]
    np.testing.assert_allclose(half[19] + half[20], 5.0, atol=1e-5)


@pytest.mark.parametrize(("step", "share"), [(5.0, 5 / 16), (10.0, 0.28), (15.0, 0.0), (80.0, 0.0)])
def test_the_taller_a_wall_the_less_it_becomes_a_ramp(step: float, share: float) -> None:
    """Up to 5 m as wide as the means are, over 15 m not at all, in between less."""
    flat = np.where(COLS < 20, 0.0, step).astype(np.float32)
    found = mean_of_neighbours(flat, np.ones(flat.shape))[15]
    assert found[19] / step == pytest.approx(share, abs=0.02)
    assert found[19] + found[20] == pytest.approx(step, abs=1e-4)


def test_doubt_on_one_side_alone_does_not_move_the_wall(wall: Any) -> None:
    doubt = np.where(COLS < 20, 1.0, 0.0)
    np.testing.assert_allclose(mean_of_neighbours(wall, doubt), wall, atol=1e-4)


def test_no_data_stays_no_data_and_spreads_nowhere() -> None:
    plane = 5.0 + 0.4 * ROWS - 0.7 * COLS
    holes = plane.copy()
    holes[10:14, 5:9] = holes[0, 0] = np.nan
    for doubt in (None, np.ones(plane.shape)):
        found = mean_of_neighbours(holes, doubt)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(holes))
        np.testing.assert_allclose(found[np.isfinite(holes)], plane[np.isfinite(holes)], atol=1e-4)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 2), (7, 1)])
def test_areas_of_a_few_cells(shape: Any) -> None:
    found = mean_of_neighbours(np.full(shape, 3.0, np.float32), np.ones(shape))
    np.testing.assert_allclose(found, 3.0)


@pytest.mark.parametrize(("likeness", "doubt"), [(0.9, 0.0), (-0.9, 0.0), (0.6, 0.0), (0.5, 0.5), (0.4, 1.0), (0, 1)])
def test_doubt_is_how_little_cells_beside_walls_look_like_one_side(likeness: Any, doubt: Any) -> None:
    beside = abs(COLS - 20) < 3
    found = doubtful_walls(np.where(beside, likeness, 0.0), beside, 0.5)
    np.testing.assert_allclose(found[beside], doubt, atol=1e-6)
    np.testing.assert_array_equal(found[~beside], 1.0)


def test_single_cells_that_look_like_neither_side_are_no_doubt() -> None:
    beside = abs(COLS - 20) < 3
    likeness = np.where(beside, 0.9, 0.0)
    likeness[::5, 19] = 0.0
    assert doubtful_walls(likeness, beside, 0.5)[beside].max() == 0.0


def test_without_walls_there_is_nothing_to_keep_apart() -> None:
    np.testing.assert_array_equal(doubtful_walls(np.zeros((4, 5)), np.zeros((4, 5), bool), 0.5), 1.0)


def test_what_tells_a_wall_from_a_slope_grows_with_wide_cells() -> None:
    assert [relief(cell) for cell in (0.35, 0.7, 1.4)] == [1.0, 1.0, 2.0]


def test_a_step_that_wide_cells_make_of_a_slope_is_averaged() -> None:
    stairs = np.repeat(np.arange(10.0), 2)[None].repeat(8, axis=0) * 3.0  # steps of 3 m
    np.testing.assert_allclose(mean_of_neighbours(stairs, np.zeros(stairs.shape)), stairs, atol=1e-4)
    # 1 2 1 twice over pairs of equal cells: 1/16 of what is two stairs away, 4/16 and then 5/16 of the next
    found = mean_of_neighbours(stairs, np.zeros(stairs.shape), step_m=4.0)
    np.testing.assert_allclose(np.diff(found[4, 4:-4]), 1.5, atol=0.4)


def grid_of(cell: float, width: int, height: int) -> Grid:
    return Grid("EPSG:32617", 435500.0, 3354300.0, cell, width, height)


def test_a_cell_that_a_wall_divides_belongs_to_the_side_that_has_more_of_it() -> None:
    # cells of 1 m from cells of 0.4 m: the wall at 2.4 m leaves 0.4 m of the third one to the low side
    fine = np.where(np.arange(10) < 6, 1.0, 9.0).astype(np.float32)[None].repeat(10, axis=0)
    source, target = grid_of(0.4, 10, 10), grid_of(1.0, 4, 4)
    np.testing.assert_allclose(means_of_cells(fine, source, target, blur=0.0), [[1, 1, 9, 9]] * 4)
    np.testing.assert_allclose(means_of_cells(fine.T, source, target, blur=0.0), np.array([[1, 1, 9, 9]] * 4).T)
    np.testing.assert_allclose(means_of_cells(fine, source, target), [[1, 1, 5.8, 9]] * 4, atol=1e-5)
    np.testing.assert_allclose(means_of_cells(fine, source, target, blur=0.5), [[1, 1, 7.4, 9]] * 4, atol=1e-5)


@pytest.mark.parametrize(("blur", "third"), [(0.0, 1.0), (1.0, 91.0)])
def test_half_of_a_cell_that_is_high_is_the_part_for_which_a_sharp_wall_stands_out(blur: float, third: float) -> None:
    # cells of 1 m from cells of 0.275 m: the wall at 2.475 m leaves 0.525 m of the third one to the high side, of which
    # 0.0385 m may be the window's; where walls are blurred nobody knows (towers go by the larger side there, too)
    fine = np.where(np.arange(16) < 9, 1.0, 91.0).astype(np.float32)[None].repeat(16, axis=0)
    source, target = grid_of(0.275, 16, 16), grid_of(1.0, 4, 4)
    found = means_of_cells(fine, source, target, blur, out=0.0385)
    np.testing.assert_allclose(found[0], [1, 1, third, 91])
    np.testing.assert_allclose(means_of_cells(fine, source, target, blur)[0], [1, 1, 91, 91])


@pytest.mark.parametrize(("step", "third"), [(30.0, 18.0), (45.0, 36.0), (60.0, 60.0), (90.0, 90.0)])
def test_walls_of_towers_are_never_blurred(step: float, third: float) -> None:
    fine = np.where(np.arange(10) < 6, 0.0, step).astype(np.float32)[None].repeat(10, axis=0)
    found = means_of_cells(fine, grid_of(0.4, 10, 10), grid_of(1.0, 4, 4), blur=1.0)
    np.testing.assert_allclose(found, [[0, 0, third, step]] * 4, rtol=1e-5)  # 0.6 of the step is the mean


def test_cells_without_a_step_are_means_of_all_that_they_cover() -> None:
    rough = (0.1 * ROWS + 0.15 * COLS + np.random.default_rng(0).uniform(0, 0.5, ROWS.shape)).astype(np.float32)
    source, target = grid_of(0.35, 40, 30), grid_of(0.5, 29, 22)  # its last cells reach beyond the source
    np.testing.assert_array_equal(means_of_cells(rough, source, target, 0.0), resize_map(rough, source, target))
    finer = grid_of(0.175, 80, 60)
    np.testing.assert_array_equal(means_of_cells(rough, source, finer, 0.0), resize_map(rough, source, finer))


def test_sides_are_those_of_plain_counting() -> None:
    rng = np.random.default_rng(4)
    fine = (rng.choice([0.0, 8.0], (30, 30)) + rng.uniform(0, 0.5, (30, 30))).astype(np.float32)
    found = means_of_cells(fine, grid_of(1.0, 30, 30), grid_of(1.5, 20, 20), blur=0.0)
    halves = fine.repeat(2, axis=0).repeat(2, axis=1)  # cells of 0.5, of which 3 x 3 make one of 1.5
    for row, col in np.ndindex(20, 20):
        parts = halves[3 * row : 3 * row + 3, 3 * col : 3 * col + 3]
        high = parts > 4
        side = parts[high] if high.sum() > 4 else parts[~high]
        assert found[row, col] == pytest.approx(side.mean(), abs=1e-5)


def test_quarters_lie_on_the_side_of_the_wall_that_their_middle_is_on() -> None:
    # between centres of +0.2 and -0.6 the wall is a quarter of a cell from the first: at the middle of its right half
    # (a quarter of a cell from its centre) the line between them is 0
    height = np.array([[9.0, 9.0, 1.0, 1.0]], np.float32).repeat(3, axis=0)
    for low, quarter in ((-0.5, 9.0), (-0.7, 1.0)):
        side = np.array([[0.9, 0.2, low, -0.9]], np.float32).repeat(3, axis=0)
        found = quarters(height, side)
        assert found.shape == (6, 8)
        # quarters at the border have fewer neighbours to go by
        assert (found[1:-1] == np.array([9, 9, 9, quarter, 1, 1, 1, 1], np.float32)).all()
        assert (quarters(height.T, side.T) == found.T).all()
        # the low side is as high as those beyond the wall where it is the one that gives way
        other = quarters(height, -side[:, ::-1])
        assert (other[1:-1] == np.array([9, 9, 9, 9, 10 - quarter, 1, 1, 1], np.float32)).all()


def test_quarters_of_cells_away_from_walls_are_as_high_as_the_cells() -> None:
    rough = np.random.default_rng(0).uniform(0, 9, (5, 7)).astype(np.float32)
    side = np.full((5, 7), np.nan, np.float32)
    np.testing.assert_array_equal(quarters(rough, side), rough.repeat(2, axis=0).repeat(2, axis=1))
    side[2] = 0.01  # cells of one side, and none beside them to be told from
    np.testing.assert_array_equal(quarters(rough, side), rough.repeat(2, axis=0).repeat(2, axis=1))


def test_a_quarter_at_a_corner_has_the_mean_height_of_what_is_beyond() -> None:
    height = np.array([[8.0, 2.0], [1.0, 0.0]], np.float32)
    side = np.array([[0.1, -0.9], [-0.9, -0.9]], np.float32)
    # (9 * 0.1 - 3 * 0.9 - 3 * 0.9 - 0.9) / 16 < 0; towards the border there is one neighbour, or none, to go by
    np.testing.assert_array_equal(quarters(height, side)[:2, :2], [[8, 2], [1, 1]])


@pytest.mark.parametrize(("likeness", "blur"), [(0.45, 1.0), (-0.55, 0.5), (0.7, 0.0)])
def test_walls_are_sharp_where_their_cells_look_like_one_side(likeness: float, blur: float) -> None:
    beside = abs(COLS - 20) < 3
    assert blurred_walls(np.where(beside, likeness, 0.0), beside) == pytest.approx(blur)
    assert blurred_walls(np.zeros((4, 5)), np.zeros((4, 5), bool)) == 1.0

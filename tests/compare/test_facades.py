"""Walls: where a surface crosses half their height."""

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sattools.compare.facades import Walls, find_walls, wall_figures, wall_offsets

CELL = 0.5


def box(grow: float = 0.0, east: float = 0.0) -> np.ndarray:
    """A building of 20 x 20 m, 10 m high, on a ground of 40 x 40 m, its walls moved by metres; cells are means."""
    fine = (np.arange(800) + 0.5) * 0.05
    inside_x = (fine > 10 - grow + east) & (fine < 30 + grow + east)
    inside_y = (fine > 10 - grow) & (fine < 30 + grow)
    height = 10.0 * (inside_y[:, None] & inside_x[None])
    return height.reshape(80, 10, 80, 10).mean(axis=(1, 3))


def test_the_same_surface_has_its_walls_in_place() -> None:
    offsets = wall_offsets(box(), box(), CELL)
    # four walls of 40 cells, without the 2 m beside every corner
    assert 4 * 30 <= offsets.size <= 4 * 34
    assert np.abs(offsets).max() < 1e-9


@pytest.mark.parametrize("grow", [1.0, -0.5, 2.5])
def test_a_larger_building_has_its_walls_outside_by_as_much(grow: Any) -> None:
    offsets = wall_offsets(box(grow), box(), CELL)
    # 2 m from a corner a normal is still turned by a fraction of a degree
    assert offsets == pytest.approx(np.full(offsets.size, grow), abs=0.01)


def test_walls_of_some_heights_alone() -> None:
    assert wall_offsets(box(), box(), CELL, heights=(9.0, 11.0)).size == wall_offsets(box(), box(), CELL).size
    assert wall_offsets(box(), box(), CELL, heights=(3.0, 10.0)).size == 0
    assert wall_offsets(box(), box(), CELL, heights=(10.5, np.inf)).size == 0


def test_parts_of_a_cell_are_seen() -> None:
    # the cells outside rise by 2 of 10 m; between their centres and the next ones the half height then lies at 3/8
    # of a cell instead of 1/2
    offsets = wall_offsets(box(0.1), box(), CELL)
    assert offsets == pytest.approx(np.full(offsets.size, 0.125 * CELL), abs=0.002)


def test_a_wall_between_two_samples_is_where_the_line_between_them_is() -> None:
    # the cells outside rise by 1 of 10 m: the half height lies at 4/9 of a cell; there are eight samples to a cell
    offsets = wall_offsets(box(0.05), box(), CELL)
    assert offsets == pytest.approx(np.full(offsets.size, (1 / 2 - 4 / 9) * CELL), abs=0.002)


def test_the_height_of_the_ground_does_not_matter() -> None:
    for ground in (50.0, -30.0):
        offsets = wall_offsets(box(1.0) + ground, box() + ground, CELL, heights=(9.0, 11.0))
        assert offsets.size == wall_offsets(box(1.0), box(), CELL).size
        assert offsets == pytest.approx(np.full(offsets.size, 1.0), abs=0.01)


def test_a_shift_moves_opposite_walls_to_opposite_sides() -> None:
    offsets = wall_offsets(box(east=1.0), box(), CELL)
    assert np.mean(np.abs(offsets) < 0.01) == pytest.approx(0.5, abs=0.01)
    assert np.mean(np.abs(offsets - 1.0) < 0.01) == pytest.approx(0.25, abs=0.01)
    assert np.mean(np.abs(offsets + 1.0) < 0.01) == pytest.approx(0.25, abs=0.01)


def test_what_all_walls_are_moved_by_is_no_error_of_a_wall() -> None:
    found = find_walls(box(0.5, east=1.0), box(), CELL)
    assert found.outward[:, 0].min() == pytest.approx(-1.0, abs=0.01)
    assert found.rise == pytest.approx(np.full(len(found.rise), 10.0))
    # too large by 0.5 m on all sides, wherever it lies
    assert found.without_shift().offset == pytest.approx(np.full(len(found.offset), 0.5), abs=0.01)


def test_some_walls_that_are_wrong_are_not_the_shift_of_all() -> None:
    found = find_walls(box(), box(), CELL)
    offset = np.where((found.outward[:, 0] > 0.9) & (np.arange(len(found.offset)) % 2 == 0), 2.0, 0.0)
    offset[:3] = np.nan
    kept = found._replace(offset=offset).without_shift().offset
    assert np.isnan(kept[:3]).all()
    # half of the walls of one side are 2 m off: least squares would move all by half a metre
    assert kept[3:] == pytest.approx(offset[3:], abs=0.05)


def test_where_no_wall_is_found_there_is_no_shift_to_take_off() -> None:
    nothing = Walls(np.array([np.nan]), np.array([[1.0, 0.0]]), np.array([5.0]))
    assert np.isnan(nothing.without_shift().offset).all()
    assert nothing.between((6.0, 9.0)).offset.size == 0


def test_figures_are_those_of_the_distances_and_the_mean_keeps_its_sign() -> None:
    figures = wall_figures(np.array([1.0, -1.0, 3.0, np.nan]))
    assert figures == {
        "pieces": 4,
        "missing": 0.25,
        "median": 1.0,
        "p90": pytest.approx(2.6),
        "mean": 1.0,
    }


def test_blur_does_not_move_a_wall() -> None:
    # the nearest corner lies 4 sigma away
    offsets = wall_offsets(gaussian_filter(box(), 1.0), box(), CELL)
    assert np.abs(offsets).max() < 0.02


def test_what_was_not_found_is_missing_and_not_zero() -> None:
    flat = np.zeros((80, 80))
    figures = wall_figures(wall_offsets(flat, box(), CELL))
    assert figures["missing"] == 1.0
    assert figures["median"] is None


def test_slopes_low_steps_and_trees_are_no_walls() -> None:
    ramp = np.linspace(0, 20, 80)[None].repeat(80, axis=0)
    assert wall_offsets(ramp, ramp, CELL).size == 0
    assert wall_offsets(0.29 * box(), 0.29 * box(), CELL).size == 0
    trees = np.where(box() > 0, 5, 2)
    assert wall_offsets(box(), box(), CELL, trees).size == 0
    # on one side of a wall they stand on its plateau; those in the middle of the roof on none
    west = np.where(np.arange(80) < 20, 5, 2)[None].repeat(80, axis=0)
    assert wall_offsets(box(), box(), CELL, west).size == pytest.approx(
        0.75 * wall_offsets(box(), box(), CELL).size, abs=1
    )
    roof = np.full((80, 80), 2)
    roof[38:42, 38:42] = 5
    assert wall_offsets(box(), box(), CELL, roof).size == wall_offsets(box(), box(), CELL).size

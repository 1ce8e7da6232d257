"""What is small and high and has ground all around is judged as a whole."""

from typing import Any

import numpy as np
import pytest

from sattools.prior.visibility.alone import stands_alone

CELL = 0.5
SIZE = 80


def town() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Level ground, of which ten views out of ten say so: heights, agreeing and seeing views."""
    height = np.zeros((SIZE, SIZE), np.float32)
    return height, np.full(height.shape, 10, np.uint8), np.full(height.shape, 10, np.uint8)


def put(of: tuple[np.ndarray, np.ndarray, np.ndarray], where: Any, high: float, agreeing: int) -> None:
    of[0][where], of[1][where] = high, agreeing


def test_a_tree_stands_with_its_rim() -> None:
    """No view agrees about the rim, nine do about the middle: 36 of 64 cells, more than half in the mean."""
    scene = town()
    crown, middle = (slice(20, 28), slice(20, 28)), (slice(21, 27), slice(21, 27))
    put(scene, crown, 8.0, 0)
    put(scene, middle, 8.0, 9)
    expected = np.zeros((SIZE, SIZE), bool)
    expected[crown] = True
    assert (stands_alone(*scene, CELL) == expected).all()


def test_a_tree_that_most_views_deny_does_not() -> None:
    scene = town()
    put(scene, (slice(20, 28), slice(20, 28)), 8.0, 4)
    assert not stands_alone(*scene, CELL).any()


def test_ground_that_rises_does_not_hide_a_tree() -> None:
    scene = town()
    scene[0][:] = 0.2 * np.arange(SIZE, dtype=np.float32)
    scene[0][20:28, 20:28] += 8.0
    assert stands_alone(*scene, CELL)[20:28, 20:28].all()
    assert stands_alone(*scene, CELL).sum() == 64


def test_a_roof_and_what_is_smeared_beside_it_is_no_such_thing() -> None:
    """Two metres of the ground beside a wall got the roof's height; six views of ten agree."""
    scene = town()
    put(scene, (slice(10, 50), slice(10, 50)), 8.0, 10)
    put(scene, (slice(10, 50), slice(50, 54)), 8.0, 6)
    assert not stands_alone(*scene, CELL).any()


def test_the_corners_of_a_roof_that_is_turned_are_no_such_thing() -> None:
    """An opening by a disk rounds them off: 1 to 2 m2 each."""
    scene = town()
    row, column = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    put(scene, np.nonzero(np.abs(row) + np.abs(column) < 30), 12.0, 10)
    assert not stands_alone(*scene, CELL).any()


@pytest.mark.parametrize(("high", "stands"), [(1.9, False), (24.0, True), (26.0, False)])
def test_what_is_as_high_as_trees_are(high: float, stands: bool) -> None:
    scene = town()
    put(scene, (slice(20, 28), slice(20, 28)), high, 10)
    assert stands_alone(*scene, CELL)[24, 24] == stands


def test_of_a_place_that_no_view_sees_nothing_is_said() -> None:
    scene = town()
    put(scene, (slice(20, 28), slice(20, 28)), 8.0, 0)
    scene[2][20:28, 20:28] = 0
    assert not stands_alone(*scene, CELL).any()


def test_on_cells_of_half_a_tree_nothing_is_said() -> None:
    scene = town()
    put(scene, (slice(20, 22), slice(20, 22)), 8.0, 10)
    assert stands_alone(*scene, 2.0)[20:22, 20:22].all()
    assert not stands_alone(*scene, 3.0).any()

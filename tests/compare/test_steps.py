"""Errors beside steps, worked out by hand."""

from typing import Any

import numpy as np
import pytest

from sattools.compare import Truth, compare_dsm, table
from sattools.compare.heights import height_errors
from sattools.compare.steps import beside_steps
from sattools.compare.tally import Steps
from sattools.scene import Grid

NAN = np.nan


def test_two_metres_on_either_side_of_a_step_are_beside_it() -> None:
    reference = np.zeros((3, 20))
    reference[:, 10:] = 4.0
    near = beside_steps(reference, 0.5)
    # the step lies between columns 9 and 10, both are on it; 2 m further are 4 cells
    np.testing.assert_array_equal(np.flatnonzero(near[1]), np.arange(5, 15))


def test_the_distance_is_in_metres() -> None:
    reference = np.zeros((3, 20))
    reference[:, 10:] = 4.0
    np.testing.assert_array_equal(np.flatnonzero(beside_steps(reference, 1.0)[1]), np.arange(7, 13))


@pytest.mark.parametrize("rise", [3.0, -3.0])
def test_a_step_has_more_than_three_metres(rise: Any) -> None:
    reference = np.zeros((6, 6))
    reference[3:] = rise
    assert not beside_steps(reference, 1.0).any()
    assert beside_steps(reference * 1.01, 1.0).all()


def test_the_distance_goes_along_rows_and_columns() -> None:
    reference = np.zeros((9, 9))
    reference[4, 4] = 5.0
    near = beside_steps(reference, 1.0)
    # 3 x 3 cells are on the step, and from its corner (3, 3) it is 2 m to (2, 2) but 3 m to (1, 2)
    assert near[2, 2]
    assert not near[1, 2]
    assert near[1, 3]


def test_the_border_of_what_is_known_is_no_step() -> None:
    reference = np.array([[0.0, 0.0, NAN, 9.0, 9.0]])
    assert not beside_steps(reference, 1.0).any()


def test_signed_and_absolute_error_in_either_part() -> None:
    steps = Steps()
    steps.add(np.array([-2.0, 1.0, -8.0]), np.array([True, True, True]))
    steps.add(np.array([0.5, -0.5]), np.array([False, False]))
    figures = steps.figures()
    assert figures["mae_centred"] == pytest.approx(12 / 5)
    assert figures["mae_capped_5m"] == pytest.approx(9 / 5)  # 8 counts as 5
    assert figures["near_steps"] == pytest.approx({"signed": -3.0, "absolute": 11 / 3, "share": 0.6})
    assert figures["away_from_steps"] == pytest.approx({"signed": 0.0, "absolute": 0.5, "share": 0.4})


def test_a_part_without_cells_has_no_error() -> None:
    steps = Steps()
    assert steps.figures()["mae_centred"] is None
    steps.add(np.array([1.0, -1.0]), np.array([False, False]))
    assert steps.figures()["near_steps"] == {"signed": None, "absolute": None, "share": 0.0}
    assert steps.figures()["away_from_steps"]["absolute"] == 1.0


def test_a_class_is_measured_about_the_median_of_all_cells() -> None:
    difference = np.array([[1.0] * 9 + [4.0, 5.0, NAN]])
    classes = np.array([[2] * 9 + [6, 6, 6]], np.uint8)
    figures = height_errors(difference, np.zeros((1, 12)), classes, cell_size=0.5)
    assert figures["mae_centred"] == pytest.approx((3 + 4) / 11)
    assert figures["classes"]["ground"]["mae_centred"] == 0.0
    assert figures["classes"]["buildings"]["mae_centred"] == 3.5  # 4 - 1, 5 - 1
    assert figures["classes"]["buildings"]["away_from_steps"]["signed"] == 3.5


def test_a_surface_too_low_beside_a_wall_shows_it_in_the_comparison() -> None:
    reference = np.zeros((40, 40), np.float32)
    reference[:, 20:] = 10.0
    predicted = reference.copy()
    predicted[:, 20:22] = 0.0  # the wall stands 1 m too far inside
    grid = Grid("EPSG:32617", 0.0, 20.0, 0.5, 40, 40)
    figures = compare_dsm(predicted, Truth("wall", "dsm", grid, reference), grid, method="none").figures
    # 10 of 40 columns are beside the step, 2 of them 10 m too low; the median error is 0
    assert figures["near_steps"] == pytest.approx({"signed": -2.0, "absolute": 2.0, "share": 0.25})
    assert figures["away_from_steps"] == pytest.approx({"signed": 0.0, "absolute": 0.0, "share": 0.75})
    assert figures["mae_centred"] == pytest.approx(0.5)
    assert figures["mae_capped_5m"] == pytest.approx(0.25)
    assert "beside steps (25 %) -2.000, |2.000| m" in table(figures)

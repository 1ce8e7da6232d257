"""Errors by the slope of the reference."""

import numpy as np
import pytest

from sattools.compare.heights import height_errors
from sattools.compare.slopes import slope_deg


def test_a_plane_has_its_slope_everywhere() -> None:
    rows, columns = np.mgrid[:20, :30]
    plane = 0.5 * (0.3 * columns + 0.4 * rows)  # cells of half a metre
    assert slope_deg(plane, 0.5) == pytest.approx(np.full((20, 30), np.degrees(np.arctan(0.5))))


def slopes_of(difference: np.ndarray, reference: np.ndarray) -> list[dict[str, float]]:
    rows: list[dict[str, float]] = height_errors(reference + difference, reference, cell_size=1.0)["slopes"]
    return rows


def test_errors_fall_into_the_range_of_their_slope() -> None:
    reference = np.zeros((40, 40))
    reference[:, 20:] = np.arange(20) * 1.0  # 45 degrees
    difference = np.where(np.arange(40) < 20, 0.1, -2.0) * np.ones((40, 1))
    difference[0, :] = np.nan
    found = slopes_of(difference, reference)
    assert [(row["from_deg"], row["to_deg"]) for row in found] == [(0.0, 5.0), (15.0, 30.0), (30.0, 60.0)]
    assert found[0]["mae"] == pytest.approx(0.1)
    assert found[2]["mae"] == pytest.approx(2.0)
    assert sum(row["n"] for row in found) == 39 * 40


def test_cells_whose_slope_is_not_known_belong_nowhere() -> None:
    reference = np.zeros((5, 5))
    reference[2, 2] = np.nan
    # the cell itself is not scored, and its four neighbours have no slope
    assert sum(row["n"] for row in slopes_of(np.ones((5, 5)), reference)) == 25 - 5

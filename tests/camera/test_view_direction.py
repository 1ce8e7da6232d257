"""One line of sight: its unit vector, its way over the grid, and what it does to a point that stands higher."""

import pytest

from sattools.camera.view_direction import ViewDirection


def test_the_unit_vector_leads_to_the_sensor() -> None:
    assert ViewDirection(0.75, 0.0).unit() == pytest.approx((0.6, 0.0, 0.8))
    assert ViewDirection(0.0, 0.0).unit() == (0.0, 0.0, 1.0)


def test_a_sensor_in_the_north_east_is_reached_upwards_over_smaller_rows_and_larger_columns() -> None:
    assert ViewDirection(0.5, 0.25).in_cells(0.5) == (-0.5, 1.0)


def test_what_stands_higher_is_displaced_away_from_the_sensor() -> None:
    direction = ViewDirection(0.5, 0.25)
    assert direction.parallax(0.5) == (0.5, -1.0)
    assert direction == (0.5, 0.25)  # east first, as everywhere

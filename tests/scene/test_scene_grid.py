"""The ground grid: north-up square cells, where row 0 is the northernmost."""

from typing import Any

import numpy as np
import pytest
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st

from sattools.errors import SceneError
from sattools.scene import Grid

GRID = Grid("EPSG:32617", 1000.0, 5000.0, 0.5, 8, 4)


def test_cell_centres_lie_half_a_cell_inside() -> None:
    assert GRID.x()[[0, -1]].tolist() == [1000.25, 1003.75]
    assert GRID.y()[[0, -1]].tolist() == [4999.75, 4998.25]


def test_shape_is_rows_then_columns_and_bounds_are_west_south_east_north() -> None:
    assert GRID.shape == (4, 8)
    assert GRID.bounds == (1000.0, 4998.0, 1004.0, 5000.0)
    assert GRID.transform == Affine(0.5, 0, 1000, 0, -0.5, 5000)


def test_a_coarser_grid_keeps_the_upper_left_corner_and_covers_all() -> None:
    coarse = GRID.resized(1.5)
    assert (coarse.left, coarse.top, coarse.cell_size) == (1000.0, 5000.0, 1.5)
    assert coarse.shape == (2, 3)


def test_resizing_to_the_same_cell_changes_nothing() -> None:
    assert GRID.resized(0.5) == GRID


@given(
    west=st.floats(0, 1e6),
    south=st.floats(0, 1e7),
    width=st.floats(1, 5000),
    height=st.floats(1, 5000),
    cell=st.sampled_from([0.3, 0.5, 1.0, 2.0, 7.0]),
)
def test_a_grid_from_bounds_covers_them_with_less_than_a_cell_to_spare(
    west: Any, south: Any, width: Any, height: Any, cell: Any
) -> None:
    asked = (west, south, west + width, south + height)
    found = Grid.from_bounds("EPSG:32617", asked, cell).bounds
    spare = np.array([asked[0] - found[0], asked[1] - found[1], found[2] - asked[2], found[3] - asked[3]])
    # 1e-4 of a cell: bounds that are whole cells but for rounding must not get another row
    assert spare.min() > -1e-4 * cell
    assert spare.max() < 2 * cell


def test_dictionary_form_survives_a_round_trip() -> None:
    assert Grid.from_dict(GRID.to_dict()) == GRID


@pytest.mark.parametrize("broken", [{"cell_size": 0.0}, {"cell_size": float("nan")}, {"width": 0}, {"height": "x"}])
def test_impossible_grids_are_refused(broken: Any) -> None:
    with pytest.raises(SceneError):
        Grid.from_dict({**GRID.to_dict(), **broken})


def test_a_missing_member_is_refused() -> None:
    data = GRID.to_dict()
    del data["top"]
    with pytest.raises(SceneError, match="expected crs, left, top"):
        Grid.from_dict(data)

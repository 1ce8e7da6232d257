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


def test_a_part_keeps_its_cells_where_they_are() -> None:
    assert GRID.part(slice(1, 3), slice(2, 6)) == Grid("EPSG:32617", 1001.0, 4999.5, 0.5, 4, 2)
    assert GRID.widened(2) == Grid("EPSG:32617", 999.0, 5001.0, 0.5, 12, 8)
    assert GRID.moved(10.0, 3.0) == Grid("EPSG:32617", 1010.0, 5003.0, 0.5, 8, 4)


def test_the_window_of_another_grid_is_where_its_cells_lie_and_ends_with_the_grid() -> None:
    assert GRID.window(GRID) == (slice(0, 4), slice(0, 8))
    assert GRID.window(GRID.part(slice(1, 3), slice(2, 6))) == (slice(1, 3), slice(2, 6))
    assert GRID.window(GRID.widened(5)) == (slice(0, 4), slice(0, 8))
    # two metres east and one north: four columns and two rows remain, the last and the first
    assert GRID.window(GRID.moved(2.0, 1.0)) == (slice(0, 2), slice(4, 8))
    # edges that are off the lattice by rounding do not cost a cell
    assert GRID.window(GRID.moved(1e-7, -1e-7)) == (slice(0, 4), slice(0, 8))
    assert GRID.window(GRID.moved(-1e-7, 1e-7)) == (slice(0, 4), slice(0, 8))


@pytest.mark.parametrize(("east_m", "north_m"), [(4.0, 0.0), (-4.0, 0.0), (0.0, 2.0), (0.0, -2.0), (0.0, 500.0)])
def test_a_grid_that_only_touches_or_lies_elsewhere_has_no_window(east_m: float, north_m: float) -> None:
    with pytest.raises(SceneError, match=r"outside \(1000\.0, 4998\.0, 1004\.0, 5000\.0\), expected some within"):
        GRID.window(GRID.moved(east_m, north_m))


@pytest.mark.parametrize(
    "bounds", [(3.0, 0.0, 3.0, 1.0), (4.0, 0.0, 3.0, 1.0), (0.0, 1.0, 3.0, 1.0), (0.0, 0.0, 1.0, -1.0)]
)
def test_bounds_without_an_area_are_refused(bounds: tuple[float, float, float, float]) -> None:
    with pytest.raises(SceneError, match="expected west < east and south < north"):
        Grid.from_bounds("EPSG:32617", bounds, 1.0)


def test_bounds_that_lie_on_the_lattice_stay_what_they_are() -> None:
    # 0.3 is no number of the machine: 436000.2 / 0.3 is a little above or below a whole number
    for west in (436000.2, 436000.5, 436000.8):
        assert Grid.from_bounds("EPSG:32617", (west, 3357000.0, west + 3.0, 3357003.0), 0.3).shape == (10, 10)
    on = Grid.from_bounds("EPSG:32617", (0.0, 0.0, 2.0, 1.0), 0.1)
    assert (on.left, on.top, on.shape) == (0.0, 1.0, (10, 20))


def test_a_missing_member_is_refused() -> None:
    data = GRID.to_dict()
    del data["top"]
    with pytest.raises(SceneError, match="expected crs, left, top"):
        Grid.from_dict(data)


@pytest.mark.parametrize("size", [0, -1.0, float("nan"), float("inf")])
def test_a_cell_has_a_size(size: float) -> None:
    for make in (GRID.resized, lambda s: Grid.from_bounds("EPSG:32617", (0, 0, 9, 9), s)):
        with pytest.raises(SceneError, match=rf"found cell size {size}, expected a positive number of metres"):
            make(size)


def test_a_grid_lies_somewhere() -> None:
    with pytest.raises(SceneError, match=r"found its corner at nan, 5000\.0, expected finite numbers of metres"):
        Grid("EPSG:32617", float("nan"), 5000.0, 0.5, 8, 4)

"""Maps on other grids: same place, same mean, holes neither shrunk nor grown."""

from __future__ import annotations

import numpy as np
import pytest

from sattools.errors import SattoolsError
from sattools.scene import Grid
from sattools.scene.regrid import (
    bounds_in,
    nearest_cells,
    reproject_map,
    resize_map,
    sample_map,
    split_cells,
    window_around,
)


def test_a_map_on_a_coarser_grid_is_the_mean_of_its_known_cells() -> None:
    fine, coarse = Grid("EPSG:32617", 0, 0, 1.0, 4, 4), Grid("EPSG:32617", 0, 0, 2.0, 2, 2)
    array = np.arange(16.0).reshape(4, 4)
    array[0, 0] = np.nan
    array[2:, 2:] = np.nan
    on_coarse = resize_map(array, fine, coarse)
    assert on_coarse[0].tolist() == pytest.approx([(1 + 4 + 5) / 3, (2 + 3 + 6 + 7) / 4])
    assert float(on_coarse[1, 0]) == pytest.approx((8 + 9 + 12 + 13) / 4)
    assert np.isnan(on_coarse[1, 1])


def test_a_coarser_cell_is_known_where_more_than_half_of_it_is() -> None:
    array = np.full((5, 15), np.nan)
    array.flat[[0, 15, 30, 45, 60]] = 3.0  # the westernmost column
    array[:, 5:10] = [7.0, 7.0, 1.0, np.nan, np.nan]  # 15 of 25
    array[:, 10:12] = 9.0
    array[:3, 12] = 9.0  # 13 of 25
    five = resize_map(array, Grid("EPSG:32617", 0, 0, 1.0, 15, 5), Grid("EPSG:32617", 0, 0, 5.0, 3, 1))
    np.testing.assert_allclose(five, [[np.nan, 5.0, 9.0]])
    half = resize_map(array[:2, 11:13], Grid("EPSG:32617", 0, 0, 1.0, 2, 2), Grid("EPSG:32617", 0, 0, 2.0, 1, 1))
    np.testing.assert_array_equal(half, [[9.0]])
    array[0, 12] = np.nan
    half = resize_map(array[:2, 12:14], Grid("EPSG:32617", 0, 0, 1.0, 2, 2), Grid("EPSG:32617", 0, 0, 2.0, 1, 1))
    assert np.isnan(half).all()


def test_cells_that_do_not_divide_are_shared_by_area() -> None:
    fine, coarse = Grid("EPSG:32617", 0, 0, 1.0, 3, 3), Grid("EPSG:32617", 0, 0, 1.5, 2, 2)
    array = np.broadcast_to([0.0, 6.0, 12.0], (3, 3))
    # 1 and 1/2 of the first two cells, 1/2 and 1 of the last two
    np.testing.assert_allclose(resize_map(array, fine, coarse), [[2.0, 10.0], [2.0, 10.0]], rtol=1e-6)


def test_a_map_on_a_finer_grid_is_bilinear_and_continues_its_border() -> None:
    coarse, fine = Grid("EPSG:32617", 0, 0, 2.0, 2, 1), Grid("EPSG:32617", 0, 0, 1.0, 4, 2)
    on_fine = resize_map(np.array([[0.0, 8.0]]), coarse, fine)
    np.testing.assert_allclose(on_fine, [[0.0, 2.0, 6.0, 8.0]] * 2)


@pytest.mark.parametrize(("cell", "width"), [(0.3, 167), (0.45, 112), (0.25, 199)])
def test_a_map_on_finer_cells_that_do_not_divide_it_keeps_its_place(cell: float, width: int) -> None:
    """It was stretched to whole cells: by a fifth of one at the far border, and by half of one in odd halves."""
    source, target = Grid("EPSG:32617", 0, 0, 0.5, 100, 100), Grid("EPSG:32617", 0, 0, cell, width, width)
    plane = source.x()[None] + 3 * source.y()[:, None]
    inner = target.x() < 49.7
    resized = resize_map(plane, source, target)[np.ix_(inner, inner)]
    expected = target.x()[None] + 3 * target.y()[:, None]
    np.testing.assert_allclose(resized[1:, 1:], expected[np.ix_(inner, inner)][1:, 1:], atol=1e-4)


def test_a_target_that_reaches_beyond_the_source_repeats_its_last_cells() -> None:
    source, target = Grid("EPSG:32617", 0, 0, 1.0, 2, 2), Grid("EPSG:32617", 0, 0, 1.0, 3, 3)
    larger = resize_map(np.array([[1.0, 2.0], [3.0, 4.0]]), source, target)
    np.testing.assert_array_equal(larger, [[1, 2, 2], [3, 4, 4], [3, 4, 4]])


@pytest.mark.parametrize("bands", [None, 3])
def test_a_map_on_another_grid_keeps_its_place(bands: int | None) -> None:
    source, target = Grid("EPSG:32617", 10.0, 50.0, 2.0, 20, 20), Grid("EPSG:32617", 15.0, 45.0, 1.0, 7, 5)
    x, y = np.meshgrid(source.x(), source.y())
    plane = x + 3 * y if bands is None else np.stack([x + 3 * y] * bands, axis=-1)
    x, y = np.meshgrid(np.arange(15.5, 22), np.arange(44.5, 40, -1))
    sampled = sample_map(plane, source, target)
    # a sum of values up to 170 in 32 bits
    np.testing.assert_allclose(sampled if bands is None else sampled[..., 1], x + 3 * y, atol=2e-5)


def test_beyond_the_source_stands_its_border_or_a_number() -> None:
    source = Grid("EPSG:32617", 0.0, 0.0, 1.0, 2, 2)
    wide = source.widened(1)
    array = np.array([[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(sample_map(array, source, wide)[0], [1, 1, 2, 2])
    np.testing.assert_array_equal(sample_map(array, source, wide, outside=-9.0)[:, 0], [-9, -9, -9, -9])
    np.testing.assert_array_equal(sample_map(array, source, wide, outside=-9.0)[1:3, 1:3], array)


def test_a_hole_stays_as_large_as_it_was_in_another_crs_or_lattice() -> None:
    source = Grid("EPSG:32617", 500000.0, 3400000.0, 1.0, 8, 8)
    array = np.full((8, 8), 5.0, np.float32)
    array[2:4, 2:4] = np.nan
    moved = reproject_map(array, source, source.moved(1.0, -1.0))
    assert np.isnan(moved).sum() == 4 + 8 + 7  # the hole, and a row and a column that lie outside now
    assert np.isnan(moved[1:3, 1:3]).all()
    assert float(np.nanmax(moved)) == float(np.nanmin(moved)) == 5.0


def test_codes_on_another_lattice_are_those_of_the_nearest_cell() -> None:
    source = Grid("EPSG:32617", 500000.0, 3400000.0, 1.0, 4, 2)
    # 0.4 m further east: the nearest cell's number, where a height would be between two
    there = source.moved(0.4, 0.0)
    codes = np.array([[2.0, 6.0, 9.0, 5.0]] * 2, np.float32)
    np.testing.assert_array_equal(reproject_map(codes, source, there, nearest=True), [[2, 6, 9, 5]] * 2)
    np.testing.assert_allclose(reproject_map(codes, source, there)[:, :3], [[3.6, 7.2, 7.4]] * 2, rtol=1e-6)


def test_around_a_window_there_are_four_cells_more_on_every_side() -> None:
    grid = Grid("EPSG:32617", 500000.0, 3400000.0, 0.5, 100, 80)
    assert window_around(grid, grid.part(slice(30, 40), slice(50, 70))) == (slice(26, 44), slice(46, 74))
    assert window_around(grid, grid.part(slice(0, 10), slice(90, 100))) == (slice(0, 14), slice(86, 100))
    # four of the larger cells, where the other grid has such
    coarse = Grid("EPSG:32617", 500025.0, 3399985.0, 2.0, 5, 2)
    assert window_around(grid, coarse) == (slice(14, 54), slice(34, 86))
    assert window_around(grid, grid.moved(1000.0, 0.0)) is None
    assert window_around(grid, grid.moved(0.0, -1000.0)) is None


def test_a_window_in_degrees_is_where_the_metres_are() -> None:
    """Bounds are west, south, east, north in any CRS; cells of a degree's millionths are about 0.1 m."""
    degrees = Grid("EPSG:4326", -81.001, 30.001, 1e-6, 2000, 2000)
    metres = Grid("EPSG:32617", 500000.0, 3318785.35, 1.0, 10, 10)  # the central meridian, 30 degrees north
    west, south, east, north = bounds_in("EPSG:4326", metres)
    assert (west, north) == pytest.approx((-81.0, 30.0), abs=1e-7)
    assert (east, south) == pytest.approx((-80.9998963, 29.9999098), abs=2e-7)
    rows, cols = window_around(degrees, metres)
    # 10 m are 104 cells across and 90 down; four of the metres' cells around are 42 cells more on every side
    assert (rows.start, rows.stop, cols.start, cols.stop) == pytest.approx((958, 1132, 958, 1146), abs=2)


def test_a_crs_of_no_place_on_earth_is_told_in_one_line() -> None:
    site = 'LOCAL_CS["site",LOCAL_DATUM["here",0],UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'
    source, target = Grid(site, 0.0, 0.0, 1.0, 2, 2), Grid("EPSG:32617", 0.0, 0.0, 1.0, 2, 2)
    with pytest.raises(SattoolsError, match="found no way from LOCAL_CS") as caught:
        reproject_map(np.zeros((2, 2)), source, target)
    assert "\n" not in str(caught.value)


def test_splitting_cells_keeps_their_values() -> None:
    np.testing.assert_array_equal(split_cells(np.array([[1, 2]])), [[1, 1, 2, 2], [1, 1, 2, 2]])


def test_means_over_cells_that_are_no_whole_number_wide_count_parts_of_cells() -> None:
    fine = Grid("EPSG:32617", 0.0, 0.0, 0.7, 10, 1)
    coarse = Grid("EPSG:32617", 0.0, 0.0, 1.0, 7, 1)
    column = np.arange(10.0) * 0.7  # west border of each cell
    found = resize_map(column[None], fine, coarse)
    # the first metre is a whole cell of 0 and 3/7 of one of 0.7: 0.3 m * 0.7
    np.testing.assert_allclose(found[0, 0], 0.21, atol=1e-6)
    # a slope stays one: whole cells' means lie half a fine cell below the borders' slope, without drifting eastwards
    middle = np.arange(7) + 0.5
    assert np.abs(found[0] - (middle - 0.35)).max() < 0.08


def test_a_slope_does_not_drift_when_cells_become_larger() -> None:
    fine = Grid("EPSG:32617", 0.0, 0.0, 0.35, 732, 4)
    coarse = Grid("EPSG:32617", 0.0, 0.0, 0.5, 512, 2)
    slope = np.tile(fine.x(), (4, 1))
    error = resize_map(slope, fine, coarse)[0] - coarse.x()
    assert np.abs(error).max() < 0.06  # a part of a fine cell has the value of its middle: up to 0.35 m * 0.15


def test_counts_are_taken_from_the_cell_in_the_middle() -> None:
    fine = Grid("EPSG:32617", 0.0, 0.0, 0.7, 10, 2)
    coarse = Grid("EPSG:32617", 0.0, 0.0, 1.0, 7, 1)
    counts = np.tile(np.arange(10, dtype=np.uint8), (2, 1))
    found = nearest_cells(counts, fine, coarse)
    assert found.dtype == np.uint8
    # centres at 0.5, 1.5 ... 6.5 m
    np.testing.assert_array_equal(found, [[0, 2, 3, 4, 6, 7, 9]])  # 3.5 m is a border: the cell before it
    np.testing.assert_array_equal(nearest_cells(counts, fine, fine), counts)

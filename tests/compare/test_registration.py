"""Shifts that were put in by hand come back out."""

from typing import Any

import numpy as np
import pytest

from sattools.compare import registration
from sattools.compare.registration import halved, pyramid_levels, register, search_margin, shifted
from sattools.errors import InputError


def blocks(size: int, seed: int = 0) -> np.ndarray:
    """A flat ground with 40 boxes of 3 to 20 m."""
    rng = np.random.default_rng(seed)
    heights = np.zeros((size, size))
    for _ in range(40):
        row, column = rng.integers(0, size - 20, 2)
        heights[row : row + rng.integers(6, 20), column : column + rng.integers(6, 20)] = rng.uniform(3, 20)
    return heights


def hills(size: int) -> np.ndarray:
    """Smooth hills, 60 cells from top to top, slopes to all sides."""
    y, x = np.mgrid[:size, :size] * (2 * np.pi / 60)
    return 8 * np.sin(x) * np.cos(0.8 * y) + 5 * np.cos(0.6 * x + 0.9 * y)


def test_pyramid_ends_at_100_cells_and_its_reach_is_the_margin() -> None:
    assert pyramid_levels((512, 512)) == 3
    assert pyramid_levels((100, 400)) == 0
    assert search_margin((512, 512)) == 80  # 5 * (8 + 4 + 2 + 1) = 75, rounded up to whole coarse cells of 8
    assert search_margin((60, 60)) == 5


def test_whole_cell_shift_and_height_offset_are_recovered_with_their_signs() -> None:
    world = blocks(300)
    reference = world[50:250, 50:250]
    # the prediction shows at (r, c) what lies 7 rows further south and 12 columns further west: it sits too far
    # north and east, so it has to move 12 columns west, 7 rows south, and 2.5 m down
    predicted = np.pad(world, 40, constant_values=np.nan)[40 + 50 + 7 : 40 + 250 + 7, 40 + 50 - 12 : 40 + 250 - 12]
    found = register(predicted + 2.5, reference)
    assert (found.columns, found.rows) == (-12, 7)
    assert found.up == pytest.approx(-2.5, abs=1e-9)
    assert found.metres(0.5) == pytest.approx((-6.0, -3.5, -2.5))
    assert found.correlation == pytest.approx(1.0)


def test_where_the_correlation_peaks_between_two_cells_is_told() -> None:
    world = hills(261)
    reference = world[30:230, 30:230]
    # 0.1 cells west and 0.4 north of where it belongs
    predicted = shifted(np.pad(world, 10, constant_values=np.nan), -0.1, -0.4, 10)[20:240, 20:240]
    found = register(predicted, reference, margin=10)
    assert (found.columns, found.rows) == (0, 0)
    # heights between cells are linear, which smooths them
    assert found.peak == pytest.approx((0.1, 0.4), abs=0.01)
    flat = register(np.zeros((80, 80)), np.zeros((60, 60)), margin=10)
    assert flat.peak == (0.0, 0.0)
    assert register(predicted, reference, "z", margin=10).peak is None


def test_shift_of_five_cells_of_the_coarsest_of_four_levels_is_found() -> None:
    world = blocks(700, seed=3)
    margin = search_margin((512, 512))
    reference = world[90:602, 90:602]
    rows, columns = 39, -36
    top, left = 90 - margin + rows, 90 - margin + columns
    predicted = np.pad(world, 100, constant_values=np.nan)[
        100 + top : 100 + top + 512 + 2 * margin, 100 + left : 100 + left + 512 + 2 * margin
    ]
    found = register(predicted, reference, margin=margin)
    assert (found.rows, found.columns) == (39, -36)
    moved = shifted(predicted, found.columns, found.rows, margin)
    np.testing.assert_array_equal(moved, reference)  # the margin delivers real heights, no cell is lost


def test_nan_cells_of_either_raster_do_not_disturb_the_shift() -> None:
    world = blocks(260)
    reference = world[30:230, 30:230].copy()
    reference[:, 100:] = np.nan  # like a truth of which only the west half is there
    predicted = world[27:227, 34:234].copy()
    predicted[np.random.default_rng(1).random(predicted.shape) < 0.3] = np.nan
    found = register(predicted, reference)
    assert (found.rows, found.columns) == (-3, 4)


def test_a_constant_surface_is_not_shifted() -> None:
    found = register(np.full((120, 120), 5.0), np.full((120, 120), 3.0))
    assert (found.rows, found.columns, found.up) == (0, 0, -2.0)


def test_z_removes_the_mean_difference_only_and_none_does_nothing() -> None:
    reference = blocks(80)
    predicted = np.roll(reference, 3, axis=1) + 4
    z = register(predicted, reference, "z")
    assert (z.columns, z.rows, z.correlation) == (0, 0, None)
    assert z.up == pytest.approx(-4.0)
    assert register(predicted, reference, "none").metres(1.0) == (0, 0, 0)


@pytest.mark.parametrize(("columns", "rows"), [(0.4, 0.0), (0.0, -0.7), (-1.3, 0.6)])
def test_nuth_kaab_finds_parts_of_a_cell(columns: Any, rows: Any) -> None:
    world = hills(220)
    reference = world[10:210, 10:210]
    predicted = shifted(world, -columns, -rows)[10:210, 10:210] + 1.5
    found = register(predicted, reference, "nuth-kaab")
    # linear interpolation of the test data itself is off by 3 % of a cell on these hills
    assert found.columns == pytest.approx(columns, abs=0.05)
    assert found.rows == pytest.approx(rows, abs=0.05)
    assert found.up == pytest.approx(-1.5, abs=0.05)


def test_nuth_kaab_finds_the_same_from_some_rows_of_a_large_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "SLOPES", 10_000)  # rows 0 to 15, 64 to 79, 128 to 143 and the last 8
    world = hills(220)
    predicted = shifted(world, 1.3, -0.6)[10:210, 10:210]
    found = register(predicted, world[10:210, 10:210], "nuth-kaab")
    assert (found.columns, found.rows) == pytest.approx((-1.3, 0.6), abs=0.05)


def test_nuth_kaab_refuses_a_surface_without_slopes() -> None:
    with pytest.raises(InputError, match="sloping cells"):
        register(np.zeros((50, 50)), np.zeros((50, 50)), "nuth-kaab")


def test_nothing_in_common_is_an_error() -> None:
    predicted, reference = np.full((40, 40), np.nan), np.ones((40, 40))
    for method in ("ncc", "z", "nuth-kaab"):
        with pytest.raises(InputError, match="in common"):
            register(predicted, reference, method)


def test_wrong_shape_is_an_error() -> None:
    with pytest.raises(InputError, match="expected"):
        register(np.zeros((40, 40)), np.zeros((40, 41)))


def test_halving_averages_what_is_known() -> None:
    array = np.array([[1.0, 3.0, np.nan, np.nan], [5.0, np.nan, np.nan, np.nan]])
    np.testing.assert_array_equal(halved(array), [[3.0, np.nan]])
    np.testing.assert_array_equal(halved(np.array([[np.nan, np.nan], [7.0, np.nan], [9.0, 9.0]])), [[7.0]])


def test_cells_move_east_and_south_and_what_comes_from_outside_is_unknown() -> None:
    array = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(shifted(array, 0.0, 0.0), array)
    np.testing.assert_array_equal(shifted(array, 1.0, 0.0), [[np.nan, 1, 2], [np.nan, 4, 5]])
    np.testing.assert_array_equal(shifted(array, 0.0, 1.0), [[np.nan] * 3, [1, 2, 3]])
    np.testing.assert_array_equal(shifted(array, -1.0, -1.0), [[5, 6, np.nan], [np.nan] * 3])
    np.testing.assert_array_equal(shifted(array, 9.0, 0.0), np.full((2, 3), np.nan))
    np.testing.assert_array_equal(shifted(array, 0.25, 0.0), [[np.nan, 1.75, 2.75], [np.nan, 4.75, 5.75]])
    np.testing.assert_array_equal(shifted(array, 1.0, 1.0, beyond=True), [[1, 1, 2], [1, 1, 2]])
    np.testing.assert_array_equal(shifted(array, 1.0, 0.0, part=slice(1, 2)), [[np.nan, 4, 5]])


def test_of_shifts_that_fit_alike_the_nearest_is_taken() -> None:
    """Along ridges every shift fits; ridges that are five cells apart fit in two places across."""
    ridges = np.tile(np.array([0.0, 3.0, 9.0, 4.0, 1.0]), (60, 12))
    found = register(np.roll(ridges, 2, axis=1), ridges)
    assert (found.rows, found.columns) == (0, -2)

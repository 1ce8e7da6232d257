"""What stands high by chance: `sattools.prior.visibility.chance`."""

from typing import Any

import numpy as np
import pytest

from sattools.prior.visibility.chance import _ground, without_lumps

CELL = 0.5
BLOCK = slice(60, 100)  # 20 m


def thing_on_plain(high: float, stands: float) -> tuple[Any, Any]:
    """A square of 20 m, so high above a plain that stands [m], of which a share does."""
    random = np.random.default_rng(3)
    height = np.full((160, 200), 12.0, np.float32)
    height[BLOCK, BLOCK] += np.float32(high)
    firm = random.uniform(size=height.shape) < 0.8
    firm[BLOCK, BLOCK] = random.uniform(size=(40, 40)) < stands
    return height, firm


def test_what_hardly_a_view_agrees_about_becomes_the_ground_around_it() -> None:
    height, stands = thing_on_plain(40.0, 0.01)
    np.testing.assert_array_equal(without_lumps(height, stands, CELL), 12.0)


@pytest.mark.parametrize("share", [0.2, 0.5, 1.0])
def test_a_roof_of_which_some_stands_stays(share: float) -> None:
    height, stands = thing_on_plain(40.0, share)
    np.testing.assert_array_equal(without_lumps(height, stands, CELL), height)


def test_lower_things_are_left_to_what_is_around_them() -> None:
    height, stands = thing_on_plain(7.0, 0.0)
    np.testing.assert_array_equal(without_lumps(height, stands, CELL), height)


def test_what_hangs_on_a_tower_goes_the_tower_stays() -> None:
    height, stands = thing_on_plain(60.0, 0.9)
    height[BLOCK, 100:140] = 50.0
    stands[BLOCK, 100:140] = False
    result = without_lumps(height, stands, CELL)
    np.testing.assert_array_equal(result[BLOCK, BLOCK], 72.0)
    np.testing.assert_array_equal(result[BLOCK, 108:140], 12.0)  # 4 m beside it the tower counts


@pytest.mark.parametrize("stands", [1.0, 0.4])
def test_a_mountain_side_stays(stands: float) -> None:
    """40 degrees, on cells as wide as such images have."""
    row, col = np.mgrid[:120, :100]
    height = (2.0 * np.tan(np.radians(40)) * row + 0.1 * col).astype(np.float32)
    firm = np.random.default_rng(5).uniform(size=height.shape) < stands
    np.testing.assert_array_equal(without_lumps(height, firm, 2.0), height)


def test_without_anything_that_stands_nothing_changes() -> None:
    height, _ = thing_on_plain(40.0, 0.0)
    np.testing.assert_array_equal(without_lumps(height, np.zeros(height.shape, bool), CELL), height)


@pytest.mark.parametrize("cell", [0.3, 1.7, 5.0, 40.0])
def test_cells_of_any_width_give_finite_heights_of_the_same_kind(cell: float) -> None:
    random = np.random.default_rng(0)
    height = random.uniform(0, 100, (41, 23)).astype(np.float32)
    result = without_lumps(height, random.uniform(size=height.shape) < 0.35, cell)
    assert result.dtype == np.float32
    assert result.shape == height.shape
    assert np.isfinite(result).all()
    assert (result <= height).all()


def test_the_ground_is_the_lower_third_of_the_pieces_around() -> None:
    """Against loops over pieces of 3 cells that say the same, with pieces of which nothing is known."""
    random = np.random.default_rng(1)
    height = random.uniform(0, 50, (14, 19)).astype(np.float32)
    height[random.uniform(size=height.shape) < 0.5] = np.inf
    height[:6, :9] = np.inf
    pieces = np.full((5, 7), np.inf)
    for r in range(5):
        for c in range(7):
            known = np.sort(height[3 * r : 3 * r + 3, 3 * c : 3 * c + 3], axis=None)
            known = known[np.isfinite(known)]
            if known.size:
                pieces[r, c] = known[(known.size - 1) // 2]
    low = _ground(height, 3, 1)
    assert low.shape == height.shape
    for r in range(14):
        for c in range(19):
            around = pieces[max(0, r // 3 - 1) : r // 3 + 2, max(0, c // 3 - 1) : c // 3 + 2]
            known = np.sort(around[np.isfinite(around)])
            if known.size:  # elsewhere the nearest piece that knows
                assert low[r, c] == pytest.approx(known[int((known.size - 1) * 0.3)])
    assert np.isfinite(low).all()

"""Means over large cells, and shifts found by them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from align_ground import CRS, GRID, surface, tilted

from sattools.align import means
from sattools.align.estimate import chosen, shift_to_dem
from sattools.align.means import CellMeans
from sattools.errors import InputError
from sattools.scene.grid import Grid

LARGE = Grid(CRS, 436000.0, 3355400.0, 10.0, 40, 40)


def test_means_are_those_of_the_cells_below() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(30, 5, GRID.shape)
    values[3:9, 20:40] = np.nan
    mean, share = CellMeans([values], GRID).over(LARGE, 0.0, 0.0)[0]
    below = values.reshape(40, 10, 40, 10).swapaxes(1, 2).reshape(40, 40, 100)
    assert mean == pytest.approx(np.nanmean(below, axis=2), abs=1e-9)
    assert share == pytest.approx(np.isfinite(below).mean(axis=2), abs=1e-9)


def test_parts_of_cells_count_as_parts() -> None:
    heights = np.array([[1.0, 5.0], [1.0, 5.0]])
    own, one = Grid(CRS, 0.0, 2.0, 1.0, 2, 2), Grid(CRS, 0.0, 2.0, 2.0, 1, 1)
    # half a cell to the east: of the large cell's 4 columns of halves, one is empty, two have 1, one has 5
    mean, share = CellMeans([heights], own).over(one, 0.5, 0.0)[0]
    assert mean[0, 0] == pytest.approx((2 * 1 + 5) / 3)
    assert share[0, 0] == pytest.approx(0.75)
    # northwards a quarter: a quarter of the cell is empty at its southern side, which changes no mean
    mean, share = CellMeans([heights], own).over(one, 0.0, 0.5)[0]
    assert (mean[0, 0], share[0, 0]) == (pytest.approx(3.0), pytest.approx(0.75))


def blocks(moved: tuple[float, float] = (0.0, 0.0), cell: float = 1.0, fine: int = 1) -> tuple[Any, Grid]:
    """A town of flat roofs and walls, averaged to cells from parts of them; moved [m]."""
    count = round(400 / cell)
    grid = Grid(CRS, 436000.0, 3355400.0, cell, count, count)
    small = Grid(CRS, 436000.0, 3355400.0, cell / fine, count * fine, count * fine)
    x, y = np.meshgrid(small.x() - 436000.0 - moved[0], small.y() - 3355000.0 - moved[1])
    heights = np.zeros(x.shape, np.float32)
    rng = np.random.default_rng(5)
    for west, south, roof in zip(*rng.uniform(20, 350, (2, 60)), rng.uniform(4, 20, 60), strict=True):
        heights[(x > west) & (x < west + 21) & (y > south) & (y < south + 15)] = roof
    return heights.reshape(count, fine, count, fine).mean(axis=(1, 3)), grid


def test_a_towns_walls_are_found_on_cells_of_ten_metres() -> None:
    town, grid = blocks(fine=5)
    onto, large = blocks((3.0, -2.0), cell=10.0, fine=20)
    found = shift_to_dem(town, grid, onto + np.float32(5), large)
    assert (found.east, found.north, found.up) == pytest.approx((3.0, -2.0, 5.0), abs=0.05)
    # planes of cells that walls have made slopes of do not come as near
    planes = shift_to_dem(town, grid, onto + np.float32(5), large, "icp")
    assert np.hypot(found.east - 3, found.north + 2) < np.hypot(planes.east - 3, planes.north + 2)


def test_cells_that_may_be_wrong_count_less() -> None:
    town, grid = blocks(fine=5)
    onto, large = blocks((3.0, -2.0), cell=10.0, fine=20)
    wrong = town.copy()
    wrong[:, 1:][np.diff(town, axis=1) < -1] += 8.0  # every eastern wall stands a metre too far east
    wrong[200:, :] = np.where(wrong[200:] > 0, town[200:], 0)  # in the northern half
    error = np.full(grid.shape, 0.3, np.float32)
    error[:200] = 10.0
    off = {
        name: np.hypot(found.east - 3, found.north + 2)
        for name, found in (
            ("alike", shift_to_dem(wrong, grid, onto, large)),
            ("by errors", shift_to_dem(wrong, grid, onto, large, error=error)),
        )
    }
    assert off["by errors"] < 0.5 * off["alike"]
    assert off["by errors"] < 0.05


def test_holes_at_walls_do_not_move_the_rest() -> None:
    town, grid = blocks(fine=5)
    onto, large = blocks((3.0, -2.0), cell=10.0, fine=20)
    town = np.array(town)
    town[np.random.default_rng(1).uniform(size=town.shape) < 0.2] = np.nan
    found = shift_to_dem(town, grid, onto, large)
    assert (found.east, found.north) == pytest.approx((3.0, -2.0), abs=0.1)


def test_large_surfaces_are_averaged_first(monkeypatch: Any) -> None:
    monkeypatch.setattr(means, "MOST_CELLS", 50_000)
    monkeypatch.setattr(means, "LEAST_PARTS", 2)
    sizes = []
    inner = means.CellMeans.__init__

    def counted(self: Any, maps: Any, grid: Grid) -> None:
        sizes.append(grid.cell_size)
        inner(self, maps, grid)

    monkeypatch.setattr(means.CellMeans, "__init__", counted)
    found = shift_to_dem(surface(GRID), GRID, surface(LARGE, (3.0, -2.0, 5.0), fine=10), LARGE)
    assert 2.0 in sizes
    assert (found.east, found.north, found.up) == pytest.approx((3.0, -2.0, 5.0), abs=0.1)


def test_a_tilt_is_found_on_large_cells() -> None:
    reference = tilted(surface(LARGE, (3.0, -2.0, 5.0), fine=10), LARGE, (2e-3, -5e-3))
    found = shift_to_dem(surface(GRID), GRID, reference, LARGE, "means", tilt=True)
    assert (found.tilt_east, found.tilt_north) == pytest.approx((2e-3, -5e-3), abs=1e-4)
    assert (found.east, found.north) == pytest.approx((3.0, -2.0), abs=0.05)


def test_what_auto_stands_for() -> None:
    assert chosen("auto", GRID, LARGE) == "means"
    assert chosen("auto", GRID, GRID) == "icp"
    assert chosen("nuth-kaab", GRID, LARGE) == "nuth-kaab"
    with pytest.raises(InputError, match=r"cells of 1 m, expected 2 m or more for --method means"):
        chosen("means", GRID, GRID)

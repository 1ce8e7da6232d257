"""Cutting a grid into tiles: they cover it, keep to its cells, and their weights add up to one."""

import math
from typing import Any

import numpy as np
import pytest

from sattools.errors import SceneError
from sattools.scene import Grid
from sattools.scene.tiles import common_cell, make_tiles, widest_part

WHOLE = Grid("EPSG:32617", 1000.0, 5000.0, 0.5, 500, 300)  # 250 m x 150 m


def test_tiles_are_of_one_size_and_reach_into_their_neighbours() -> None:
    tiles = make_tiles(WHOLE, 100.0, 16.0, 2.0)
    assert [tile.name for tile in tiles] == ["r0c0", "r0c1", "r0c2", "r1c0", "r1c1", "r1c2"]
    # 250 m: 100 m in the middle and half of the rest on either side, the edges on multiples of 2 m = 4 cells, and 32
    # cells more where there is a neighbour; 150 m in halves
    assert [(t.cols.start, t.cols.stop) for t in tiles[:3]] == [(0, 184), (120, 384), (320, 500)]
    assert [(t.rows.start, t.rows.stop) for t in tiles[::3]] == [(0, 184), (120, 300)]
    middle = tiles[4]
    assert middle.grid == Grid("EPSG:32617", 1060.0, 4940.0, 0.5, 264, 180)
    assert middle.shared == (64, 0, 64, 64)


@pytest.mark.parametrize("step", [1.0, 2.0, 7.0])
def test_the_largest_tile_is_the_same_whatever_the_area(step: float) -> None:
    margin, full = math.ceil(32 / step) * step, math.floor(512 / step) * step
    for edge in (1025, 1040, 1100, 1536, 1537, 2000, 2083, 3125, 4165, 5000, 5201):  # 1 to 27 km2
        tiles = make_tiles(Grid("EPSG:32633", 0.0, 0.0, 1.0, edge, edge), 512.0, 32.0, step)
        sizes = sorted({size for tile in tiles for size in tile.grid.shape})
        assert sizes[-1] == full + 2 * margin
        assert sizes[0] >= full / 2 - step + margin  # those at the border: no slivers
        # and no more of them than the area needs, so that they share no more than they must
        assert len(tiles) == math.ceil(edge / full) ** 2
        foreseen = widest_part(edge, 512.0, 32.0)
        assert abs(sizes[-1] - foreseen) < 3 * step


def test_areas_of_two_tiles_are_halved() -> None:
    for edge in (513, 700, 1000, 1024):
        tiles = make_tiles(Grid("EPSG:32633", 0.0, 0.0, 1.0, edge, edge), 512.0, 32.0, 1.0)
        assert len(tiles) == 4
        widest = max(tile.grid.width for tile in tiles)
        assert widest == math.ceil(edge / 2) + 32
        assert abs(widest - widest_part(edge, 512.0, 32.0)) <= 0.5
    assert widest_part(512, 512.0, 32.0) == 512


@pytest.mark.parametrize("cell", [0.5, 1.0, 2.0])
def test_weights_add_up_to_one_everywhere_and_fade_towards_a_tiles_border(cell: Any) -> None:
    tiles = make_tiles(WHOLE, 100.0, 16.0, 2.0)
    whole = WHOLE.resized(cell)
    total = np.zeros(whole.shape)
    for tile in tiles:
        grid = tile.grid.resized(cell)
        rows, cols = tile.place(whole, grid.shape)
        assert (rows.stop - rows.start, cols.stop - cols.start) == grid.shape
        total[rows, cols] += tile.weights(grid.shape, cell)
    # rounding of 32-bit weights
    assert np.abs(total - 1).max() < 1e-6
    weights = tiles[1].weights(tiles[1].grid.resized(cell).shape, cell)
    quarter = round(8.0 / cell)  # of the 32 m that two tiles share
    assert (weights[:, :quarter] == 0).all()
    assert (weights[: -2 * quarter - quarter, 4 * quarter : -4 * quarter] == 1).all()


def test_an_area_no_larger_than_a_tile_is_one_tile() -> None:
    [tile] = make_tiles(WHOLE, 250.0, 16.0, 2.0)
    assert tile.grid == WHOLE
    assert (tile.weights(WHOLE.shape, 0.5) == 1).all()


@pytest.mark.parametrize(
    ("tile", "overlap", "words"),
    [(64.0, 32.0, "--overlap: found 32 m, expected less than half of --tile 64 m"),
     (20.0, 4.0, r"--tile: found 20 m, expected at least 32 m \(16 x 2 m, the distance at which")],
)  # fmt: skip
def test_tiles_that_make_no_sense_are_refused(tile: Any, overlap: Any, words: Any) -> None:
    with pytest.raises(SceneError, match=words):
        make_tiles(WHOLE, tile, overlap, 2.0)


def test_edges_of_tiles_lie_on_the_cells_of_all_grids() -> None:
    assert common_cell([0.5, 1.0]) == 1.0
    assert common_cell([0.5, 0.8]) == 4.0
    assert common_cell([0.3, 0.6, 1.2]) == pytest.approx(1.2)

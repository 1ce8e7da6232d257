"""A surface of finer cells than its reference's is scored by its means over these."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sattools.cli import main
from sattools.compare.maps import compare_map
from sattools.compare.surface import HeldSurface, compare_surface
from sattools.compare.truth import Truth
from sattools.scene import Grid
from sattools.scene.raster import write_cog
from sattools.scene.regrid import reproject_map

CRS = "EPSG:32617"
FINE = Grid(CRS, 436000.0, 3357800.0, 0.25, 320, 320)
COARSE = Grid(CRS, 436000.0, 3357800.0, 1.0, 80, 80)


def town() -> np.ndarray:
    """Blocks of 8 to 14 m whose walls lie anywhere between the cells of 1 m."""
    rng = np.random.default_rng(4)
    heights = np.zeros(FINE.shape, np.float32)
    for row in range(4, 300, 64):
        for col in range(4, 300, 64):
            height, width = rng.integers(32, 57, 2)
            heights[row : row + height, col : col + width] = rng.uniform(4.0, 15.0)
    return heights


def block_means(heights: np.ndarray, cells: int) -> np.ndarray:
    rows, cols = heights.shape
    return heights.reshape(rows // cells, cells, cols // cells, cells).mean(axis=(1, 3), dtype=np.float64)


TOWN = town()


def saved(path: Path, cells: int) -> str:
    write_cog(path, block_means(TOWN, cells).astype(np.float32), FINE.resized(0.25 * cells))
    return str(path)


def ran(*arguments: str) -> Any:
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.parametrize("cells", [1, 2])
@pytest.mark.parametrize("register", ["none", "ncc"])
def test_a_perfect_surface_of_finer_cells_has_no_errors(tmp_path: Path, cells: int, register: str) -> None:
    """Walls of this town cost 0.3 m with a kernel that is two of the reference's cells wide."""
    fine, coarse = saved(tmp_path / "fine.tif", cells), saved(tmp_path / "coarse.tif", 4)
    figures = ran("compare", "--predicted", fine, "--dsm", coarse, "--register", register)
    assert figures["mae"] == pytest.approx(0.0, abs=1e-5)  # float32
    assert figures["shift_m"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    assert figures["completeness"] == 1.0
    blurred = reproject_map(block_means(TOWN, cells), FINE.resized(0.25 * cells), COARSE)
    assert np.abs(blurred - block_means(TOWN, 4)).mean() > 0.3


def test_cells_that_overlap_two_of_the_references_count_in_both_by_their_shares(tmp_path: Path) -> None:
    """Cells of 0.75 m: the first of 1 m has all of one and a third of the next."""
    fine = Grid(CRS, 436000.0, 3357800.0, 0.75, 4, 4)
    heights = np.tile(np.array([0.0, 3.0, 6.0, 12.0], np.float32), (4, 1))
    coarse = Grid(CRS, 436000.0, 3357800.0, 1.0, 3, 3)
    found = reproject_map(heights, fine, coarse, means=True)
    # 0.75 x 0 + 0.25 x 3; 0.5 x 3 + 0.5 x 6; 0.25 x 6 + 0.75 x 12
    np.testing.assert_allclose(found, np.tile([0.75, 4.5, 10.5], (3, 1)), atol=1e-5)


@pytest.mark.parametrize("size", [1.0, 0.96, 1.6])
def test_surfaces_of_the_references_cells_and_of_coarser_ones_are_interpolated_as_ever(size: float) -> None:
    rng = np.random.default_rng(0)
    own = Grid(CRS, 436000.3, 3357799.6, size, 70, 70)
    heights = rng.uniform(0.0, 9.0, own.shape).astype(np.float32)
    ever = reproject_map(heights, own, COARSE)
    np.testing.assert_array_equal(reproject_map(heights, own, COARSE, means=True), ever)


def test_means_of_cells_of_one_size_are_what_interpolation_gives() -> None:
    """So nothing jumps where cells become finer: 0.3 of a cell to the east, a mean has 0.7 and 0.3 of two."""
    heights = np.arange(6400.0, dtype=np.float32).reshape(80, 80) ** 2 / 1e4
    found = reproject_map(heights, COARSE.moved(0.3, 0.0), COARSE, means=True)
    np.testing.assert_allclose(found[:, 1:], 0.7 * heights[:, 1:] + 0.3 * heights[:, :-1], rtol=1e-5)


def test_holes_of_a_finer_surface_neither_grow_nor_shrink_and_do_not_count_in_means() -> None:
    heights = block_means(TOWN, 2).astype(np.float32)
    heights[40:60, 40:60] = np.nan
    heights[10, 10] = np.nan  # one of the four of a cell
    own = FINE.resized(0.5)
    truth = Truth("town", "dsm", COARSE, block_means(TOWN, 4).astype(np.float32))
    result = compare_surface(HeldSurface(heights, own), truth, "none")
    # the 100 cells of the hole, and the single one where it is the nearest
    assert 1.0 - 101 / 6400 <= result.figures["completeness"] <= 1.0 - 100 / 6400
    assert result.figures["mae"] == pytest.approx(0.0, abs=1e-3)


def test_a_later_date_of_finer_cells_has_changed_nowhere(tmp_path: Path) -> None:
    fine, coarse = saved(tmp_path / "fine.tif", 2), saved(tmp_path / "coarse.tif", 4)
    table = ran("change", coarse, fine, "--out", str(tmp_path / "out"), "--rim", "0", "--min-area", "1")
    assert table["regions"] == []
    assert table["nmad_m"] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, -0.25)])
def test_a_perfect_parameter_map_of_finer_cells_has_no_errors(tmp_path: Path, shift: tuple[float, float]) -> None:
    """Of two bands, also where its surface was moved onto the reference's."""
    fine, coarse = tmp_path / "fine.tif", tmp_path / "coarse.tif"
    write_cog(fine, np.stack([TOWN, 2 * TOWN]), FINE.moved(-shift[0], -shift[1]))
    write_cog(coarse, np.stack([block_means(TOWN, 4), block_means(2 * TOWN, 4)]).astype(np.float32), COARSE)
    figures, (own, reference) = compare_map("albedo", fine, coarse, shift)
    np.testing.assert_allclose(own, reference, atol=1e-5)
    assert figures["rmse"] == pytest.approx(0.0, abs=1e-5)
    assert figures["n"] == 2 * 80 * 80

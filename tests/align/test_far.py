"""Shifts beyond the few cells that registration looks around in a small map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from align_ground import CRS

from sattools.align.far import _correlations, shift_within
from sattools.align.options import AlignOptions
from sattools.align.surface import SurfaceFiles, shift_to_raster
from sattools.errors import InputError
from sattools.scene.grid import Grid
from sattools.scene.raster import write_cog

GRID = Grid(crs=CRS, left=436000.0, top=3355400.0, cell_size=1.0, width=96, height=96)
WIDE = GRID.widened(100)


def town(grid: Grid, seed: int = 5) -> np.ndarray:
    """Houses of 4 to 15 m at places of the ground, whatever the grid."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(grid.x() - GRID.left, GRID.top - grid.y())
    heights = 2 * np.sin(x / 40) * np.cos(y / 55)
    for _ in range(200):
        west, north, width, depth = *rng.uniform(-150, 250, 2), *rng.uniform(8, 25, 2)
        inside = (x > west) & (x < west + width) & (y > north) & (y < north + depth)
        heights = np.where(inside, heights + rng.uniform(4, 15), heights)
    return heights.astype(np.float32)


@pytest.mark.parametrize("far", [(3.0, -4.0), (21.0, -14.0), (-64.0, 48.0)])
def test_a_shift_is_found_as_far_as_the_largest_one_that_is_allowed(far: tuple[float, float]) -> None:
    found = shift_within(town(GRID.moved(*far)) - 7, GRID, town(WIDE), WIDE, reach=90.0)
    assert (found.east, found.north, found.up) == pytest.approx((*far, 7.0), abs=0.05)
    assert found.after < 0.05 < found.before
    assert (found.x, found.y) == (436048.0, 3355352.0)  # where the surface's middle was


def test_a_reference_of_the_surfaces_own_extent_is_enough() -> None:
    reference = GRID.moved(30.0, -20.0)
    found = shift_within(town(GRID), GRID, town(GRID) + 2, reference, reach=90.0)
    assert (found.east, found.north, found.up) == pytest.approx((30.0, -20.0, 2.0), abs=0.05)


def test_missing_cells_and_larger_ones_do_not_hide_the_place() -> None:
    cells = Grid(CRS, WIDE.left, WIDE.top, 4.0, 74, 74)
    reference = town(WIDE).reshape(74, 4, 74, 4).mean(axis=(1, 3))
    reference[np.random.default_rng(0).random(reference.shape) < 0.2] = np.nan
    found = shift_within(town(GRID.moved(-40.0, 33.0)), GRID, reference, cells, reach=90.0)
    assert (found.east, found.north) == pytest.approx((-40.0, 33.0), abs=0.2)


def test_nothing_is_looked_for_beyond_the_largest_shift_and_the_refusal_says_how_far_that_is() -> None:
    with pytest.raises(InputError, match=r"; nor is anything like it further off, to 40 m \(--max-shift\)"):
        shift_within(town(GRID.moved(-64.0, 48.0)), GRID, town(WIDE), WIDE, reach=40.0)


@pytest.mark.parametrize("seed", range(6, 12))
def test_another_town_is_nowhere_taken_for_the_surface(seed: int) -> None:
    try:
        found = shift_within(town(GRID), GRID, town(WIDE, seed), WIDE, reach=90.0)
    except InputError:
        return
    assert found.left > 0.65  # which `align` warns of


def test_level_ground_is_looked_for_nowhere() -> None:
    with pytest.raises(InputError, match=r"method z moves in height only$"):
        shift_within(np.zeros(GRID.shape), GRID, town(WIDE), WIDE, reach=90.0)


def test_files_are_looked_at_as_far_as_max_shift(tmp_path: Path) -> None:
    write_cog(tmp_path / "dsm.tif", town(GRID.moved(-64.0, 48.0)), GRID)
    write_cog(tmp_path / "reference.tif", town(WIDE), WIDE)
    surface = SurfaceFiles(tmp_path / "dsm.tif", None, None)
    options = AlignOptions(to="reference.tif")
    shift, _ = shift_to_raster(surface, tmp_path / "reference.tif", options)
    assert (shift.east, shift.north) == pytest.approx((-64.0, 48.0), abs=0.05)
    with pytest.raises(InputError, match="to 50 m"):
        shift_to_raster(surface, tmp_path / "reference.tif", replace(options, max_shift=50.0))


def test_correlations_of_all_places_are_those_of_what_both_maps_know() -> None:
    """Against numpy's of one place after the other, also at the edges, where transforms would go round."""
    rng = np.random.default_rng(0)
    wide = rng.normal(20.0, 3.0, (23, 31))
    part = wide[5:14, 17:28] + rng.normal(0.0, 0.3, (9, 11))
    wide[rng.uniform(size=wide.shape) < 0.1] = np.nan
    part[2] = np.nan
    found = _correlations(wide, part)
    assert found.shape == (15, 21)
    for row in range(15):
        for column in range(21):
            there = wide[row : row + 9, column : column + 11]
            both = np.isfinite(there) & np.isfinite(part)
            # sums of 99 numbers in double precision
            expected = np.corrcoef(there[both], part[both])[0, 1]
            assert found[row, column] == pytest.approx(expected, abs=1e-9)
    assert np.unravel_index(found.argmax(), found.shape) == (5, 17)


def test_a_search_in_vain_says_how_far_it_has_come() -> None:
    heard: list[tuple[float, str]] = []
    with pytest.raises(InputError):
        shift_within(
            town(GRID), GRID, town(WIDE, 9), WIDE, "icp", reach=90.0, progress=lambda *told: heard.append(told)
        )
    shares, messages = zip(*heard, strict=True)
    assert messages[:2] == ("registering, whole cells", "looking further off, to 90 m")
    assert list(shares) == sorted(shares)
    heard.clear()
    shift_within(town(GRID), GRID, town(WIDE), WIDE, "icp", progress=lambda *told: heard.append(told))
    assert [message for _, message in heard][:2] == ["registering, whole cells", "registering, step 1"]

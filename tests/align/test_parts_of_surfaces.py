"""Surfaces of many cells are brought onto a reference by parts of them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sattools.align import surface as looked
from sattools.align.options import AlignOptions
from sattools.align.surface import SurfaceFiles, shift_to_raster
from sattools.scene import Grid
from sattools.scene.raster import write_cog

GRID = Grid("EPSG:32617", 436000.0, 3357800.0, 1.0, 420, 400)


def town(grid: Grid) -> np.ndarray:
    """Houses and hills at places of the ground, whatever the grid."""
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(grid.x() - GRID.left, GRID.top - grid.y())
    heights = 6 * np.sin(x / 40) * np.cos(y / 55)
    for _ in range(220):
        west, north, width, depth = rng.uniform(-20, 420), rng.uniform(-20, 400), *rng.uniform(8, 25, 2)
        inside = (x > west) & (x < west + width) & (y > north) & (y < north + depth)
        heights = np.where(inside, heights + rng.uniform(4, 15), heights)
    return heights.astype(np.float32)


def surface_in(folder: Path) -> SurfaceFiles:
    """The town 2 m too far west, 1 m too far north and 3 m too low; a part of it is filled, not measured."""
    heights = town(GRID.moved(2.0, -1.0)) - 3.0 + np.random.default_rng(1).normal(0, 0.1, GRID.shape)
    validity = np.ones(GRID.shape, np.uint8)
    heights[40:80, 60:120], validity[40:80, 60:120] = 99.0, 2
    for name, array in (("dsm", heights), ("validity", validity), ("error", np.full(GRID.shape, 0.4))):
        write_cog(folder / f"{name}.tif", np.asarray(array, np.uint8 if name == "validity" else np.float32), GRID)
    return SurfaceFiles(folder / "dsm.tif", folder / "validity.tif", folder / "error.tif")


def reference_in(folder: Path, cell: float) -> Path:
    fine = Grid(GRID.crs, GRID.left - 60, GRID.top + 60, 1.0, 540, 520)
    heights = town(fine)
    if cell > 1:
        n = int(cell)
        heights = heights[: 520 // n * n, : 540 // n * n].reshape(520 // n, n, 540 // n, n).mean(axis=(1, 3))
    grid = Grid(GRID.crs, fine.left, fine.top, cell, heights.shape[1], heights.shape[0])
    write_cog(folder / f"reference_{cell:g}.tif", heights, grid)
    return folder / f"reference_{cell:g}.tif"


@pytest.mark.parametrize(
    ("cell", "tilt", "method", "tolerance"),
    [
        (1.0, False, "icp", 0.05),
        (5.0, False, "means", 0.05),
        (5.0, True, "means", 0.3),  # of the whole, on cells twice as large on either side
        (20.0, False, "means", 0.15),  # of the whole: squares have too few of such cells
    ],
)
def test_the_shift_of_a_large_surface_is_that_of_all_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cell: float, tilt: bool, method: str, tolerance: float
) -> None:
    surface, reference = surface_in(tmp_path), reference_in(tmp_path, cell)
    options = AlignOptions(to=str(reference), max_shift=40.0, tilt=tilt)
    whole, _ = shift_to_raster(surface, reference, options)
    monkeypatch.setattr(looked, "MOST_CELLS", 50_000)
    monkeypatch.setattr(looked, "PART_CELLS", 150)
    found, how = shift_to_raster(surface, reference, options)
    assert how == method
    for shift in (whole, found):
        assert (shift.east, shift.north, shift.up) == pytest.approx((2.0, -1.0, 3.0), abs=tolerance)
    assert found.after < found.before
    assert (found.x, found.y) == (GRID.left + 210.0, GRID.top - 200.0)


def test_parts_without_a_reference_leave_it_to_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    surface, reference = surface_in(tmp_path), reference_in(tmp_path, 1.0)
    monkeypatch.setattr(looked, "MOST_CELLS", 50_000)
    monkeypatch.setattr(looked, "PART_CELLS", 150)
    read = looked.heights_around
    parts: list[Grid] = []

    def some(path: Path, grid: Grid, reach: float, step: int = 1) -> Any:
        parts.append(grid)
        if len(parts) == 2:
            raise looked.InputError("nothing there")
        return read(path, grid, reach, step)

    monkeypatch.setattr(looked, "heights_around", some)
    found, _ = shift_to_raster(surface, reference, AlignOptions(to=str(reference), max_shift=40.0))
    assert (found.east, found.north, found.up) == pytest.approx((2.0, -1.0, 3.0), abs=0.05)
    assert [part.shape for part in parts] == [(150, 150)] * 5


def test_means_over_larger_cells_are_of_what_was_measured(tmp_path: Path) -> None:
    surface = surface_in(tmp_path)
    height, error, grid = surface.read(GRID, 4)
    assert grid == Grid(GRID.crs, GRID.left, GRID.top, 4.0, 105, 100)
    assert np.isnan(height[10:20, 15:30]).all()
    assert np.isfinite(height).sum() == 100 * 105 - 10 * 15
    assert error is not None
    np.testing.assert_allclose(error, 0.4, rtol=1e-6)

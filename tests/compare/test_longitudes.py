"""Surfaces and references in degrees: longitudes up to 360, and those on both sides of the antimeridian."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from rasterio.warp import transform as transform_points

from sattools.align.reference import heights_around
from sattools.cli import main
from sattools.scene import Grid
from sattools.scene.raster import write_cog

FLORIDA = Grid("EPSG:32617", 436000.0, 3357800.0, 1.0, 80, 60)
FIJI = Grid("EPSG:32760", 819411.0, 8118028.0, 1.0, 80, 60)  # 180 degrees run through its middle
PLACES = {"florida": (FLORIDA, 278.334), "fiji, east": (FIJI, 179.9996), "fiji, west": (FIJI, -180.0004)}


def in_metres(path: Path, grid: Grid) -> Path:
    """A plane that rises by 0.5 a metre to the east."""
    write_cog(path, np.tile(0.5 * np.arange(80, dtype=np.float32), (60, 1)), grid)
    return path


def in_degrees(path: Path, grid: Grid, left: float) -> Path:
    """The same plane on cells of 0.00001 degrees, the longitude of whose western edge is given."""
    _, (top,) = transform_points(grid.crs, "EPSG:4326", [grid.left], [grid.top])
    cells = Grid("EPSG:4326", left, top, 1e-5, 90, 54)
    lon, lat = np.meshgrid(cells.x(), cells.y())
    east, _ = transform_points("EPSG:4326", grid.crs, lon.ravel(), lat.ravel())
    x = np.asarray(east).reshape(cells.shape) - grid.left - 0.5
    write_cog(path, np.where((x > -0.5) & (x < 79.5), 0.5 * x, np.nan).astype(np.float32), cells)
    return path


def compared(surface: Path, reference: Path) -> Any:
    arguments = ["compare", "--predicted", str(surface), "--dsm", str(reference), "--register", "none"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.parametrize("place", PLACES)
def test_a_surface_or_a_reference_in_degrees_is_where_it_lies(tmp_path: Path, place: str) -> None:
    """Surfaces with longitudes up to 360, and references on both sides of 180 degrees, lay nowhere."""
    grid, left = PLACES[place]
    metres, degrees = in_metres(tmp_path / "metres.tif", grid), in_degrees(tmp_path / "degrees.tif", grid, left)
    for surface, reference in ((degrees, metres), (metres, degrees), (degrees, degrees)):
        figures = compared(surface, reference)
        assert figures["mae"] < 0.05  # resampled twice
        assert figures["completeness"] > 0.95


def test_two_rasters_on_different_sides_of_the_antimeridian_are_of_one_place(tmp_path: Path) -> None:
    east = in_degrees(tmp_path / "east.tif", FIJI, 179.9996)
    west = in_degrees(tmp_path / "west.tif", FIJI, -180.0004)
    assert compared(east, west)["mae"] < 0.001
    assert compared(west, east)["completeness"] == 1.0


@pytest.mark.parametrize("left", [179.9996, -180.0004])
def test_a_scene_is_moved_onto_a_reference_on_both_sides_of_the_antimeridian(tmp_path: Path, left: float) -> None:
    heights, around = heights_around(in_degrees(tmp_path / "degrees.tif", FIJI, left), FIJI, 5.0)
    known = np.isfinite(heights)
    assert known.sum() * around.cell_size**2 == pytest.approx(80 * 60, abs=100)  # m2
    plane = np.broadcast_to(0.5 * (around.x() - FIJI.left - 0.5), heights.shape)
    assert np.abs(heights - plane)[known].mean() < 0.05

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
from sattools.scene.raster import read_on, write_cog
from sattools.scene.regrid import reproject_map
from sattools.scene.warped import read_warped

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


FIJI_ISLANDS = Grid("EPSG:32760", 815451.0, 8120998.0, 100.0, 80, 60)  # 8 km, 180 degrees in their middle
ACCRA = Grid("EPSG:32630", 828404.0, 620624.0, 100.0, 80, 60)  # 0 degrees in its middle
GLOBES = {  # where, the longitude of the western edge, columns
    "from -180": (FIJI_ISLANDS, -180.0, 36000),
    "from 0": (ACCRA, 0.0, 36000),
    "middles on both edges": (FIJI_ISLANDS, -180.005, 36001),
}


def around_the_globe(path: Path, grid: Grid, left: float, width: int) -> Path:
    """A plane that rises by 0.01 a metre to the east on the grid, on cells of 0.01 degrees all around the globe."""
    west, south, east, north = grid.bounds
    (lon,), (lat,) = transform_points(grid.crs, "EPSG:4326", [(west + east) / 2], [(south + north) / 2])
    cells = Grid("EPSG:4326", left, round(lat, 2) + 0.1, 0.01, width, 20)
    east = (cells.x() - lon + 180.0) % 360.0 - 180.0
    x, _ = transform_points("EPSG:4326", grid.crs, (lon + np.clip(east, -0.1, 0.1)), np.full(width, lat))
    row = np.where(np.abs(east) < 0.1, 0.01 * (np.asarray(x) - grid.left), np.nan)
    write_cog(path, np.tile(row.astype(np.float32), (20, 1)), cells)
    return path


@pytest.mark.parametrize("globe", GLOBES)
def test_a_raster_around_the_globe_is_read_on_both_of_its_edges(tmp_path: Path, globe: str) -> None:
    """Only one half of what lies across its edges was."""
    grid, left, width = GLOBES[globe]
    path = around_the_globe(tmp_path / "globe.tif", grid, left, width)
    plane = np.broadcast_to(0.01 * (grid.x() - grid.left), grid.shape)
    heights, around = heights_around(path, grid, 0.0)
    found = {"on": read_on(path, grid)[0], "warped": read_warped(path, grid)[0]}
    found["reference"] = reproject_map(heights, around, grid)
    for values in found.values():
        # meridians are not parallel to the grid: 40 m, and cells of 1 km
        np.testing.assert_allclose(values, plane, atol=0.5)


def test_a_globe_is_no_reference_of_compare(tmp_path: Path) -> None:
    path = around_the_globe(tmp_path / "globe.tif", *GLOBES["from -180"])
    surface = in_metres(tmp_path / "metres.tif", FIJI)
    result = CliRunner().invoke(main, ["compare", "--predicted", str(surface), "--dsm", str(path)])
    assert result.exit_code == 1
    assert "globe.tif: found a raster around the globe, expected one of its place (crop it)" in result.stderr

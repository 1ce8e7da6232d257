"""Areas, volumes, slopes and shifts are measured on maps of metres, onto which `change` and `compare` bring others."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from pyproj import Geod, Transformer

from sattools.change.surfaces import read_surface
from sattools.cli import main
from sattools.scene.grid import Grid
from sattools.scene.raster import raster_grid, write_cog


def surface(path: Path, crs: str, left: float, top: float, cell: float, rise: float = 0.0) -> str:
    heights = np.add.outer(np.linspace(0.0, 9.0, 40), np.linspace(0.0, 9.0, 40)).astype(np.float32)
    heights[10:20, 10:20] += np.float32(rise)
    write_cog(path, heights, Grid(crs, left, top, cell, 40, 40))
    return str(path)


def run(*arguments: str) -> Any:
    return CliRunner().invoke(main, arguments)


@pytest.mark.parametrize(
    ("crs", "lon", "lat", "cell", "metres"),
    [
        ("EPSG:2236", -81.66, 30.35, 3.0, 0.3048**2 * 9),  # feet: volumes would be 11 times too large
        ("EPSG:3857", -81.66, 30.35, 1.0, np.cos(np.radians(30.35)) ** 2),  # metres at the equator
        ("EPSG:4326", -81.66, 30.35, 1e-5, 1e-10 * 110_856 * 96_139),  # of a degree of latitude and of longitude there
    ],
)
@pytest.mark.parametrize("later", ["same", "EPSG:32617"])
def test_dates_on_maps_that_count_no_metres_come_onto_cells_in_metres(
    tmp_path: Path, crs: str, lon: float, lat: float, cell: float, metres: float, later: str
) -> None:
    left, top = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    before = surface(tmp_path / "before.tif", crs, left, top, cell)
    after = surface(tmp_path / "after.tif", crs, left, top, cell, rise=8.0)
    if later != "same":
        where = read_surface(after, later).grid
        (heights,) = read_surface(after, later).on("height", where)
        write_cog(tmp_path / "after.tif", heights, where)
    done = run("change", before, after, "--out", str(tmp_path / "out"), "--register", "none")
    assert done.exit_code == 0, done.stderr
    (region,) = json.loads(done.stdout)["regions"]
    assert region["volume_m3"] == pytest.approx(8.0 * 100 * metres, rel=0.03)  # 10 x 10 cells
    grid = raster_grid(tmp_path / "out/height_change.tif")
    assert grid.crs == "EPSG:32617"
    assert grid.cell_size == pytest.approx(np.sqrt(metres), rel=0.05)


def test_coordinates_that_a_crs_does_not_reach_are_told(tmp_path: Path) -> None:
    before, after = (surface(tmp_path / f"{k}.tif", "EPSG:32617", 9e8, 9e8, 1.0, rise=k * 8.0) for k in (0, 1))
    for command, named in (
        (["change", before, after], after),
        (["compare", "--predicted", after, "--dsm", before], before),
    ):
        done = run(*command, "--out", str(tmp_path / "out"))
        assert done.exit_code == 1
        told = "found coordinates that its CRS, EPSG:32617, does not reach, expected those of its place"
        assert done.stderr == f"sattools {command[0]}: error: {named}: {told}\n"
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("crs", "lon", "lat"),
    [
        ("EPSG:32617", -87.0, 30.0),  # an edge of the zone and another zone away
        ("EPSG:32617", -81.0, 30.0),  # the middle of the zone
        ("EPSG:3395", 10.0, 5.0),  # Mercator near the equator
        ("EPSG:3035", 30.0, 60.0),  # of equal areas, though not of equal lengths
    ],
)
def test_areas_and_volumes_are_those_on_the_ground_not_those_of_the_map(
    tmp_path: Path, crs: str, lon: float, lat: float
) -> None:
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    left, top = (round(v) for v in to_map.transform(lon, lat))
    before, after = (surface(tmp_path / f"{k}.tif", crs, left, top, 2.0, rise=k * 8.0) for k in (0, 1))
    done = run("change", before, after, "--out", str(tmp_path / "out"), "--register", "none")
    assert done.exit_code == 0, done.stderr
    (region,) = json.loads(done.stdout)["regions"]
    # 10 x 10 cells of 2 m that have risen, along the ellipsoid
    x, y = np.array([20.0, 40, 40, 20]) + left, top - np.array([20.0, 20, 40, 40])
    on_ground = abs(Geod(ellps="WGS84").polygon_area_perimeter(*to_map.transform(x, y, direction="INVERSE"))[0])
    assert region["area_m2"] == pytest.approx(on_ground, rel=2e-4)  # 4 digits are told
    assert region["volume_m3"] == pytest.approx(8.0 * on_ground, rel=2e-4)
    assert region["mean_m"] == 8.0


def test_a_surface_in_feet_east_and_north_is_scored_on_cells_in_metres(tmp_path: Path) -> None:
    predicted = surface(tmp_path / "feet.tif", "EPSG:2236", 452_000.0, 2_190_000.0, 3.0)
    done = run("compare", "--predicted", predicted, "--dsm", predicted, "--out", str(tmp_path / "out"))
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["mae"] == pytest.approx(0.0, abs=1e-6)
    (difference,) = (tmp_path / "out").rglob("*.tif")
    grid = raster_grid(difference)
    assert grid.crs == "EPSG:32617"
    assert grid.cell_size == pytest.approx(0.914, abs=0.01)  # 3 feet


def test_rims_wider_than_any_wall_are_wrong_usage(tmp_path: Path) -> None:
    flat = surface(tmp_path / "flat.tif", "EPSG:32617", 436_000.0, 3_357_000.0, 1.0)
    done = run("change", flat, flat, "--out", str(tmp_path / "out"), "--rim", "1e9")
    assert done.exit_code == 2
    assert "0.0<=x<=100.0" in done.stderr

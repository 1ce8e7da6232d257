"""Heights above a geoid say so in the file's own CRS, and everything that reads rasters takes such files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from pyproj import CRS

from sattools.cli import main
from sattools.scene import Grid
from sattools.scene.datums import compound_crs, horizontal
from sattools.scene.raster import raster_vertical, read_raster, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 1.0, 60, 60)
HEIGHTS = np.zeros(GRID.shape, np.float32)
HEIGHTS[20:32, 20:40] = 10.0


@pytest.fixture
def geoid(tmp_path: Path) -> Path:
    path = tmp_path / "geoid.tif"
    write_cog(path, HEIGHTS + 2, GRID, units="m", vertical="EPSG:5773")
    return path


def test_a_height_raster_above_a_geoid_has_both_codes_and_the_same_grid(geoid: Path) -> None:
    with rasterio.open(geoid) as data:
        crs = CRS.from_wkt(data.crs.to_wkt())
        assert data.crs.is_projected
    assert [part.to_epsg() for part in crs.sub_crs_list] == [32617, 5773]
    assert crs.name == "WGS 84 / UTM zone 17N + EGM96 height"
    _, grid = read_raster(geoid)
    assert grid == GRID
    assert raster_vertical(geoid) == "EPSG:5773"


@pytest.mark.parametrize("name", ["", "+title=Site "])
def test_a_crs_without_a_code_is_the_same_above_a_geoid(name: str, tmp_path: Path) -> None:
    """GeoTIFF gives its part on the map the name of both: `compare` found the DSM and its validity on two grids."""
    crs = f"+proj=tmerc +lat_0=30.3 +lon_0=-81 +ellps=WGS84 +units=m {name}"
    local = Grid(crs, -63000.0, 5700.0, 1.0, 60, 60)
    write_cog(tmp_path / "plain.tif", HEIGHTS, local)
    write_cog(tmp_path / "geoid.tif", HEIGHTS, local, vertical="EPSG:5773")
    _, plain = read_raster(tmp_path / "plain.tif")
    _, above = read_raster(tmp_path / "geoid.tif")
    assert above == plain
    assert raster_vertical(tmp_path / "geoid.tif") == "EPSG:5773"
    write_cog(tmp_path / "again.tif", HEIGHTS, above, vertical="EPSG:5773")
    assert read_raster(tmp_path / "again.tif")[1] == plain


def test_a_raster_without_a_vertical_part_stays_as_it_was(tmp_path: Path) -> None:
    write_cog(tmp_path / "a.tif", HEIGHTS, GRID)
    with rasterio.open(tmp_path / "a.tif") as data:
        assert data.crs.to_epsg() == 32617
    assert raster_vertical(tmp_path / "a.tif") is None


@pytest.mark.parametrize(
    "crs", [compound_crs("EPSG:32617", "EPSG:3855"), CRS("EPSG:32617").to_3d(), CRS("EPSG:32617")], ids=str
)
def test_the_place_on_the_map_is_the_same_whatever_the_heights_are_above(crs: Any) -> None:
    assert horizontal(rasterio.crs.CRS.from_wkt(crs.to_wkt("WKT2_2019"))) == "EPSG:32617"


def test_compare_takes_compound_references(geoid: Path, tmp_path: Path) -> None:
    write_cog(tmp_path / "plain.tif", HEIGHTS, GRID, units="m")
    arguments = ["compare", "--predicted", str(tmp_path / "plain.tif"), "--dsm", str(geoid), "--register", "none"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["mae"] == pytest.approx(2.0)


def test_change_takes_compound_surfaces(geoid: Path, tmp_path: Path) -> None:
    write_cog(tmp_path / "plain.tif", HEIGHTS, GRID, units="m")
    arguments = ["change", str(geoid), str(tmp_path / "plain.tif"), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["shift_m"] == pytest.approx([0.0, 0.0, 2.0])

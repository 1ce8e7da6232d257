"""Surfaces whose heights are above different things are compared with a warning."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from pyproj import CRS

from sattools.cli import main
from sattools.scene.datums import difference
from sattools.scene.grid import Grid
from sattools.scene.raster import heights_above, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3357000.0, 1.0, 40, 40)


@pytest.fixture
def surfaces(tmp_path: Path) -> Any:
    rng = np.random.default_rng(0)
    ground = rng.random((1, 40, 40)).astype(np.float32)
    write_cog(tmp_path / "ellipsoid.tif", ground, GRID, tags={"VERTICAL_DATUM": "WGS84 ellipsoid"})
    write_cog(tmp_path / "egm96.tif", ground - 30, GRID, vertical="EPSG:5773")
    write_cog(tmp_path / "silent.tif", ground, GRID)
    solid = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "dtype": "float32", "transform": GRID.transform}
    with rasterio.open(tmp_path / "solid.tif", "w", crs=CRS(GRID.crs).to_3d().to_wkt("WKT2_2019"), **solid) as data:
        data.write(ground)
    return tmp_path


def test_files_say_what_their_heights_are_above(surfaces: Any) -> None:
    assert heights_above(surfaces / "ellipsoid.tif") == "ellipsoid"
    assert heights_above(surfaces / "egm96.tif") == "EPSG:5773"
    assert heights_above(surfaces / "silent.tif") is None
    assert heights_above(surfaces / "solid.tif") == "ellipsoid"


def test_only_what_is_known_can_differ() -> None:
    assert difference({"a": "ellipsoid", "b": None}) is None
    assert difference({"a": "EPSG:5773", "b": "EPSG:5773"}) is None
    assert "a above the ellipsoid, b above EGM96 height (EPSG:5773)" in str(
        difference({"a": "ellipsoid", "b": "EPSG:5773"})
    )


@pytest.mark.parametrize(("reference", "warned"), [("egm96", True), ("silent", False), ("ellipsoid", False)])
def test_compare_warns_and_keeps_the_note(surfaces: Any, reference: str, warned: bool) -> None:
    files = ("--predicted", str(surfaces / "ellipsoid.tif"), "--dsm", str(surfaces / f"{reference}.tif"))
    done = CliRunner().invoke(main, ["compare", *files, "--register", "none"])
    assert done.exit_code == 0, done.output
    assert ("heights are above different things" in done.stderr) == warned
    figures = json.loads(done.stdout.splitlines()[-1])
    assert ("notes" in figures) == warned
    assert (figures["mae"] > 5.0) == warned  # predictions far beyond the reference count as ten metres off


@pytest.mark.parametrize("before", ["ellipsoid.tif", "before/egm96.tif"])
def test_change_warns_and_keeps_the_note(surfaces: Any, tmp_path: Path, before: str) -> None:
    """Dates were told apart by their names: of two files or scenes of one name nothing was said."""
    (tmp_path / "before").mkdir()
    shutil.copy(surfaces / "ellipsoid.tif", tmp_path / "before/egm96.tif")
    files = [str(tmp_path / before), str(surfaces / "egm96.tif")]
    done = CliRunner().invoke(main, ["change", *files, "--out", str(tmp_path / "c")])
    said = f"({Path(before).stem} before above the ellipsoid, egm96 after above EGM96 height (EPSG:5773))"
    assert said in done.stderr
    assert said in json.loads(done.stdout)["notes"][0]

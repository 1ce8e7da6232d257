"""Two dates whose bands have other orders or names, and polygons that reach beyond the maps."""

import json
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from shapely.geometry import MultiPolygon, Point, Polygon, box

from sattools.cli import main
from sattools.scene import Scene
from sattools.scene.grid import Grid
from sattools.scene.raster import read_raster, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3355040.0, 1.0, 40, 40)
LEVELS = {"blue": 0.1, "green": 0.2, "red": 0.3, "nir": 0.4}


def heights(seed: int) -> Any:
    noise = np.random.default_rng(seed).normal(0.0, 0.1, GRID.shape)
    noise[5:15, 5:15] += 8.0  # something to correlate
    return noise.astype(np.float32)


def date(folder: Path, name: str, bands: list[str], redder: float = 0.0) -> Path:
    """A scene with three levels in every band, whose later date is redder in one corner."""
    scene = Scene(name, folder / name, grid=GRID, products={"dsm": "dsm.tif", "albedo": "albedo.tif"})
    write_cog(scene.output("dsm.tif"), heights(len(bands)), GRID, units="m")
    rows, cols = np.indices(GRID.shape)
    board = ((rows + cols) % 3).astype(np.float32) * np.float32(0.05)
    albedo = np.stack([LEVELS.get(band.removesuffix("08"), 0.2) + board for band in bands])
    for layer, band in zip(albedo, bands, strict=True):
        if band == "red":
            layer[30:, 30:] += redder
    write_cog(scene.output("albedo.tif"), albedo, GRID, descriptions=[f"albedo {band}" for band in bands])
    scene.write()
    return scene.root / "scene.json"


def change(*arguments: Any) -> Any:
    return CliRunner().invoke(main, ["change", *map(str, arguments)])


def test_bands_in_another_order_are_compared_by_their_names(tmp_path: Path) -> None:
    before = date(tmp_path, "A", ["blue", "green", "red", "nir"])
    after = date(tmp_path, "B", ["nir08", "red", "green", "blue"], redder=0.125)
    result = change(before, after, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    found = read_raster(tmp_path / "out" / "albedo_change.tif")[0]
    with rasterio.open(tmp_path / "out" / "albedo_change.tif") as data:
        assert [text.split(", ")[-1] for text in data.descriptions] == ["blue", "green", "red", "nir"]
    assert found[2, 30:, 30:] == pytest.approx(0.125, abs=1e-6)
    found[2, 30:, 30:] = 0.0
    assert found == pytest.approx(0.0, abs=1e-6)


def test_bands_that_have_numbers_only_are_compared_by_them(tmp_path: Path) -> None:
    before = date(tmp_path, "A", ["3", "1"])
    after = date(tmp_path, "B", ["1", "3"])
    with rasterio.open(after.parent / "albedo.tif", "r+", IGNORE_COG_LAYOUT_BREAK="YES") as data:
        first = data.read(1)  # which is number 1
        first[30:, 30:] += 0.125
        data.write(first, 1)
    assert change(before, after, "--out", tmp_path / "out").exit_code == 0
    found = read_raster(tmp_path / "out" / "albedo_change.tif")[0]
    assert found[0] == pytest.approx(0.0, abs=1e-6)
    assert found[1, 30:, 30:] == pytest.approx(0.125, abs=1e-6)
    with rasterio.open(tmp_path / "out" / "albedo_change.tif") as data:
        assert [text.split(", ")[-1] for text in data.descriptions] == ["band 3", "band 1"]


@pytest.mark.parametrize(
    ("old", "new"), [(["blue", "green", "red"], ["green", "red", "nir"]), (["1", "2", "3"], ["2", "3", "4"])]
)
def test_albedos_of_other_bands_are_not_subtracted(tmp_path: Path, old: list[str], new: list[str]) -> None:
    before = date(tmp_path, "A", old)
    after = date(tmp_path, "B", new)
    result = change(before, after, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    note = f"albedo: found {', '.join(old)} before and {', '.join(new)} after, expected the same bands: no map of"
    assert note in result.stderr
    assert note in json.loads(result.stdout)["notes"][0]
    assert not (tmp_path / "out" / "albedo_change.tif").exists()


def test_a_map_of_the_albedo_of_other_dates_does_not_stay_beside_new_ones(tmp_path: Path) -> None:
    before, after = date(tmp_path, "A", ["blue", "green"]), date(tmp_path, "B", ["blue", "green"])
    other, out = date(tmp_path, "C", ["red", "nir"]), tmp_path / "out"
    assert change(before, after, "--out", out).exit_code == 0
    refused = change(before, other, "--out", out)
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr
    assert (out / "albedo_change.tif").exists()
    assert change(before, other, "--out", out, "--overwrite").exit_code == 0
    assert not (out / "albedo_change.tif").exists()


def test_bands_without_names_are_taken_in_their_order(tmp_path: Path) -> None:
    before = date(tmp_path, "A", ["1", "2", "3"])
    after = date(tmp_path, "B", ["blue", "green", "red"])
    assert change(before, after, "--out", tmp_path / "out").exit_code == 0
    with rasterio.open(tmp_path / "out" / "albedo_change.tif") as data:
        assert [text.split(", ")[-1] for text in data.descriptions] == ["band 1", "band 2", "band 3"]


def test_a_polygon_that_reaches_beyond_the_maps_is_known_in_part(tmp_path: Path) -> None:
    for name, seed in (("old", 1), ("new", 2)):
        write_cog(tmp_path / f"{name}.tif", heights(seed), GRID, units="m")
    half = box(436030.0, 3355010.0, 436050.0, 3355020.0)  # 20 m wide, 10 m of them on the maps
    within = box(436010.0, 3355010.0, 436020.0, 3355020.0)
    crossed = Polygon([(436020.0, 3355010.0), (436030.0, 3355020.0), (436030.0, 3355010.0), (436020.0, 3355020.0)])
    places = geopandas.GeoDataFrame(geometry=[half, within, crossed], crs="EPSG:32617")
    places.to_file(tmp_path / "places.gpkg")
    given = ["--polygons", tmp_path / "places.gpkg", "--out", tmp_path / "out"]
    result = change(tmp_path / "old.tif", tmp_path / "new.tif", *given)
    assert result.exit_code == 0, result.stderr
    rows = json.loads(result.stdout)["polygons"]
    # 100 cells of 1 m, which are 1.0007 m2 on the ground so near the middle of the zone
    assert [(row["known_share"], row["area_m2"]) for row in rows[:2]] == [(0.5, 100.1), (1.0, 100.1)]
    assert rows[2]["known_share"] == 1.0


def test_the_numbers_of_polygons_are_their_places_in_the_file(tmp_path: Path) -> None:
    for name, seed in (("old", 1), ("new", 2)):
        write_cog(tmp_path / f"{name}.tif", heights(seed), GRID, units="m")
    one, other = box(436010.0, 3355010.0, 436020.0, 3355020.0), box(436010.0, 3355010.0, 436015.0, 3355020.0)
    places = geopandas.GeoDataFrame(geometry=[Point(436012.0, 3355012.0), one, None, other], crs="EPSG:32617")
    places.to_file(tmp_path / "places.gpkg")
    given = ["--polygons", tmp_path / "places.gpkg", "--out", tmp_path / "out"]
    rows = json.loads(change(tmp_path / "old.tif", tmp_path / "new.tif", *given).stdout)["polygons"]
    assert [(row["number"], row["area_m2"]) for row in rows] == [(1, 100.1), (3, 50.03)]


def test_surfaces_that_are_not_moved_have_no_negative_zero(tmp_path: Path) -> None:
    for name, seed in (("old", 1), ("new", 2)):
        write_cog(tmp_path / f"{name}.tif", heights(seed), GRID, units="m")
    result = change(tmp_path / "old.tif", tmp_path / "new.tif", "--register", "none", "--out", tmp_path / "out")
    assert '"shift_m": [0.0, 0.0, 0.0]' in result.stdout


def test_polygons_on_the_other_side_of_the_earth_are_left_out(tmp_path: Path) -> None:
    for name, seed in (("old", 1), ("new", 2)):
        write_cog(tmp_path / f"{name}.tif", heights(seed), GRID, units="m")
    crossed = Polygon([(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
    here = box(-81.67, 30.31, -81.66, 30.33)
    places = geopandas.GeoDataFrame(geometry=[crossed, MultiPolygon([here, box(8.0, 0.0, 9.0, 1.0)])], crs="EPSG:4326")
    places.to_file(tmp_path / "places.gpkg")
    given = ["--polygons", tmp_path / "places.gpkg", "--out", tmp_path / "out"]
    result = change(tmp_path / "old.tif", tmp_path / "new.tif", *given)
    assert result.exit_code == 0, result.stderr
    assert (
        "places.gpkg: 2 of its features left out, as far as their places cannot be brought to EPSG:32617"
        in result.stderr
    )
    assert [(row["number"], row["area_m2"]) for row in json.loads(result.stdout)["polygons"]] == [(1, 1601.0)]

"""Scenes that were adjusted one by one are joined, and their seams say whether they fit together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from sattools.batch.join import Part, join, seam
from sattools.cli import main
from sattools.errors import InputError, SceneError
from sattools.scene import Scene
from sattools.scene.grid import Grid
from sattools.scene.raster import heights_above, raster_vertical, read_raster, write_cog

CRS = "EPSG:32617"
WHOLE = Grid(CRS, 436000.0, 3355200.0, 0.5, 640, 400)
SHIFTS = {"WEST": (1.7, -0.8, 2.0), "EAST": (-1.1, 0.6, -1.5)}  # the datum that each has by itself


def relief(grid: Grid, moved: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
    x, y = np.meshgrid(grid.x() - 436000.0 - moved[0], grid.y() - 3355000.0 - moved[1])
    return 9 * np.sin(x / 25.0) * np.cos(y / 22.0) + 5 * np.sin((x + 2 * y) / 31.0) + moved[2]


@pytest.fixture
def tiles(tmp_path: Path) -> list[Scene]:
    """Two surfaces of 200 m that share 60 m, each off by a shift of its own, with noise of 0.2 m."""
    scenes = []
    for number, (name, shift) in enumerate(SHIFTS.items()):
        grid = WHOLE.part(slice(0, 400), slice(240 * number, 240 * number + 400))
        noise = np.random.default_rng(number).normal(0, 0.2, grid.shape)
        root = tmp_path / name
        write_cog(root / "export/dsm.tif", (relief(grid, shift) + noise).astype(np.float32), grid, units="m")
        write_cog(root / "export/dsm_std.tif", np.full(grid.shape, 0.2, np.float32), grid, units="m")
        scene = Scene(name, root, [], grid, products={"dsm": "export/dsm.tif", "dsm_std": "export/dsm_std.tif"})
        scene.write()
        scenes.append(scene)
    return scenes


def errors(folder: Path) -> Any:
    heights, grid = read_raster(folder / "dsm.tif")
    return heights[0] - relief(grid)


def test_a_scene_counts_by_the_distance_to_its_border_and_not_beyond() -> None:
    part = Part(Scene("A", Path("a")), Grid(CRS, 436000.0, 3355200.0, 2.0, 4, 3))
    # centres of cells lie 1 and 3 m from the border
    want = np.pad([[1, 1, 1, 1], [1, 3, 3, 1], [1, 1, 1, 1]], 1)
    np.testing.assert_array_equal(part.weights(part.grid.widened(1)), want)


def test_scenes_that_only_touch_have_no_seam() -> None:
    """Their files are not even looked at."""
    part = Part(Scene("A", Path("a")), Grid(CRS, 436000.0, 3355200.0, 2.0, 4, 3))
    for east, north in ((8.0, 0.0), (-8.0, 0.0), (0.0, 6.0), (0.0, -6.0), (500.0, 2.0)):
        assert seam(part, Part(Scene("B", Path("b")), part.grid.moved(east, north))) is None


def test_tiles_aligned_one_by_one_join_without_a_seam(tiles: list[Scene], tmp_path: Path, caplog: Any) -> None:
    before = join(tiles, tmp_path / "before")
    (seam,) = before["seams"]
    assert (seam["a"], seam["b"]) == ("WEST", "EAST")
    # up to what the slopes make of the shift sideways
    assert seam["median_m"] == pytest.approx(SHIFTS["EAST"][2] - SHIFTS["WEST"][2], abs=0.5)
    assert "EAST lies -3." in caplog.text
    assert "[align]" in caplog.text

    coarse = Grid(CRS, 435950.0, 3355250.0, 5.0, 84, 60)
    fine = Grid(CRS, coarse.left, coarse.top, 0.5, 840, 600)
    write_cog(tmp_path / "dem.tif", relief(fine).reshape(60, 10, 84, 10).mean(axis=(1, 3)).astype(np.float32), coarse)
    for scene in tiles:
        result = CliRunner().invoke(main, ["align", "--to", str(tmp_path / "dem.tif"), str(scene.output("scene.json"))])
        assert result.exit_code == 0, result.stderr
    caplog.clear()
    after = join([Scene.from_file(scene.output("scene.json")) for scene in tiles], tmp_path / "after")
    assert json.loads((tmp_path / "after/seams.json").read_text()) == after
    (seam,) = after["seams"]
    assert abs(seam["median_m"]) < 0.1
    assert seam["nmad_m"] < 0.3 < 2 * before["seams"][0]["nmad_m"]
    assert not caplog.text
    # no step where one ends within the other: 120 and 200 m from the west
    profile = np.nanmedian(errors(tmp_path / "after")[:, 10:-10], axis=0)
    assert np.abs(np.diff(profile)).max() < 0.1
    assert np.nanmean(np.abs(errors(tmp_path / "after"))) < 0.25
    assert np.nanmean(np.abs(errors(tmp_path / "before"))) > 1.0  # m


def test_the_whole_has_all_cells_and_the_maps_of_all(tiles: list[Scene], tmp_path: Path) -> None:
    made = join(tiles, tmp_path / "out")
    assert made["maps"] == ["dsm", "dsm_std"]
    heights, grid = read_raster(tmp_path / "out/dsm.tif")
    assert grid == WHOLE
    assert np.isfinite(heights).all()
    west, _ = read_raster(tiles[0].path("export/dsm.tif"))
    np.testing.assert_array_equal(heights[0, :, :230], west[0, :, :230])  # where it is alone
    std, _ = read_raster(tmp_path / "out/dsm_std.tif")
    np.testing.assert_allclose(std, 0.2, atol=1e-6)


def test_cells_that_one_does_not_know_come_from_the_other(tiles: list[Scene], tmp_path: Path) -> None:
    heights, grid = read_raster(tiles[0].path("export/dsm.tif"))
    heights[0, 50:90, 300:340] = np.nan
    heights[0, 50:90, 100:140] = np.nan  # where there is no other
    write_cog(tiles[0].path("export/dsm.tif"), heights, grid)
    join(tiles, tmp_path / "out")
    joined, _ = read_raster(tmp_path / "out/dsm.tif")
    east, _ = read_raster(tiles[1].path("export/dsm.tif"))
    np.testing.assert_array_equal(joined[0, 50:90, 300:340], east[0, 50:90, 60:100])
    assert np.isnan(joined[0, 50:90, 100:140]).all()


def test_datums_are_kept_and_must_be_one(tiles: list[Scene], tmp_path: Path) -> None:
    for scene in tiles:
        heights, grid = read_raster(scene.path("export/dsm.tif"))
        write_cog(
            scene.path("export/dsm.tif"), heights, grid, vertical="EPSG:5773", tags={"VERTICAL_DATUM": "EGM96 geoid"}
        )
    join(tiles, tmp_path / "out")
    assert raster_vertical(tmp_path / "out/dsm.tif") == "EPSG:5773"
    with rasterio.open(tmp_path / "out/dsm.tif") as data:
        assert data.tags()["VERTICAL_DATUM"] == "EGM96 geoid"
    write_cog(tiles[1].path("export/dsm.tif"), heights, grid, tags={"VERTICAL_DATUM": "WGS84 ellipsoid"})
    with pytest.raises(InputError, match="EAST: found heights above the ellipsoid, expected EPSG:5773 as of WEST"):
        join(tiles, tmp_path / "other")
    assert not (tmp_path / "other").exists()
    join(tiles[1:], tmp_path / "one")
    assert heights_above(tmp_path / "one/dsm.tif") == "ellipsoid"
    with rasterio.open(tmp_path / "one/dsm.tif") as data:
        assert data.tags()["VERTICAL_DATUM"] == "WGS84 ellipsoid"


def test_what_cannot_be_joined_is_named(tiles: list[Scene], tmp_path: Path) -> None:
    heights, grid = read_raster(tiles[1].path("export/dsm.tif"))
    write_cog(tiles[1].path("export/dsm.tif"), heights, Grid("EPSG:32618", *list(vars(grid).values())[1:]))
    with pytest.raises(InputError, match="EAST: found EPSG:32618, expected EPSG:32617 as of WEST"):
        join(tiles, tmp_path / "out")
    del tiles[0].products["dsm"]
    with pytest.raises(SceneError, match="WEST: found no DSM"):
        join(tiles, tmp_path / "out")

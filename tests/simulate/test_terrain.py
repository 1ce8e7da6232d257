"""Scenes over a given surface model."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sattools.errors import InputError
from sattools.scene import Grid
from sattools.scene.raster import read_image, read_raster, write_cog
from sattools.simulate import SimulateOptions, simulate, stage
from sattools.simulate.terrain import build_terrain, window

GRID = Grid("EPSG:32633", 400_000.0, 5_200_000.0, 1.0, 60, 50)


def hill() -> np.ndarray:
    x, y = np.meshgrid(np.arange(60.0), np.arange(50.0))
    return 300 + 0.2 * x - 0.1 * y


def test_smooth_relief_is_joined_without_steps() -> None:
    world = build_terrain(hill(), GRID, None, 0.25, np.random.default_rng(0))
    assert world.cell_size == 0.25
    assert world.shape == (200, 240)
    inner = (slice(20, -20), slice(20, -20))
    assert world.slope_x[inner] == pytest.approx(np.full((160, 200), 0.2), abs=1e-3)
    assert world.slope_y[inner] == pytest.approx(np.full((160, 200), -0.1), abs=1e-3)
    # 7.3 m east and 4.1 m south of the middle of cell (10, 20)
    x, y = GRID.x()[20] + 7.3, GRID.y()[10] - 4.1
    assert world.surface(np.array(x), np.array(y)) == pytest.approx(300 + 0.2 * 27.3 - 0.1 * 14.1, abs=0.01)


def test_a_step_stays_a_wall_and_holes_take_the_nearest_height() -> None:
    heights = np.zeros((50, 60))
    heights[:, 30:] = 20
    heights[10:12, 10:12] = np.nan
    world = build_terrain(heights, GRID, None, 0.5, np.random.default_rng(0))
    assert set(np.unique(world.height)) == {0.0, 20.0}
    assert not world.slope_x.any()


def test_classes_choose_the_colours() -> None:
    classes = np.full((50, 60), 2, np.uint8)
    classes[:20, :20] = 9
    classes[30:, 30:] = 5
    world = build_terrain(np.zeros((50, 60)), GRID, classes, 1.0, np.random.default_rng(0))
    assert world.albedo[classes == 9].mean() < 0.06
    assert (world.albedo[classes == 5][:, 1] > world.albedo[classes == 5][:, 0]).all()  # leaves are green


def test_the_middle_of_a_large_dsm_is_taken_with_its_surroundings() -> None:
    grid, wide, (rows, columns) = window(Grid("EPSG:32633", 0.0, 1000.0, 1.0, 400, 300), 100.0, 20.0)
    assert grid.bounds == (150.0, 800.0, 250.0, 900.0)
    np.testing.assert_array_equal(rows, range(80, 220))
    np.testing.assert_array_equal(columns, range(130, 270))
    assert wide.bounds == (130.0, 780.0, 270.0, 920.0)
    *_, (rows, columns) = window(GRID, 100.0, 4.0)  # 50 rows, 60 columns: surroundings beyond the edge are mirrored
    assert list(rows[:6]) == [3, 2, 1, 0, 0, 1]
    assert list(rows[-6:]) == [48, 49, 49, 48, 47, 46]
    assert list(columns[:3]) == [1, 2, 3]
    with pytest.raises(InputError, match="extent"):
        window(Grid("EPSG:32633", 0.0, 1000.0, 1.0, 10, 300), 100.0, 20.0)


def test_truth_of_the_scene_is_the_given_surface(tmp_path: Path) -> None:
    heights = hill().astype(np.float32)
    heights[20:30, 25:35] += 12
    write_cog(tmp_path / "dsm.tif", heights, GRID)
    options = SimulateOptions(dsm=str(tmp_path / "dsm.tif"), size=40, views=2, gsd=0.5)
    scene = simulate(options, tmp_path / "scene")
    truth, grid = read_raster(scene.path(scene.products["truth_dsm"]))
    assert grid.crs == "EPSG:32633"
    assert grid.shape == (40, 40)
    # the grid's cells are the DSM's; joining by slopes averages nothing at their centres but rounds to the fine cell
    assert truth[0] == pytest.approx(heights[5:45, 10:50], abs=0.15)
    for item in scene.items:
        assert np.isfinite(read_image(scene.path(item.assets["image"].href))).all()


def test_class_map_on_another_grid_is_refused(tmp_path: Path) -> None:
    write_cog(tmp_path / "dsm.tif", hill(), GRID)
    write_cog(tmp_path / "cls.tif", np.full((25, 30), 2, np.uint8), GRID.resized(2.0), nodata=None)
    options = SimulateOptions(dsm=str(tmp_path / "dsm.tif"), classes=str(tmp_path / "cls.tif"), size=40)
    with pytest.raises(InputError, match=r"cls\.tif: found Grid"):
        simulate(options, tmp_path / "scene")


def test_real_terrain_makes_a_scene(data_dir: Any, tmp_path: Path) -> None:
    options = SimulateOptions(dsm=str(data_dir / "terrain/TM1_564_146.tif"), size=100, views=2, gsd=1.0)
    scene = simulate(options, tmp_path)
    assert scene.grid.crs == "EPSG:3794"
    low, high = scene.height_range_m
    truth = read_raster(scene.path(scene.products["truth_dsm"]))[0]
    assert low < truth.min() < truth.max() < high
    lit = read_image(scene.path(scene.items[0].assets["truth_lit"].href))
    assert lit.mean() > 0.5


@pytest.mark.parametrize("terrain", ["city", "natural"])
def test_heights_that_are_not_of_the_earth_are_refused(tmp_path: Path, terrain: Any) -> None:
    heights = np.zeros((120, 120), np.float32)
    heights[60, 60] = 1e30
    write_cog(tmp_path / "dsm.tif", heights, Grid("EPSG:32617", 436000.0, 3357000.0, 1.0, 120, 120))
    options = SimulateOptions(terrain=terrain, dsm=str(tmp_path / "dsm.tif"), size=32.0, views=2)
    with pytest.raises(InputError, match=r"dsm\.tif: found heights from 0 to 1e\+30 m, expected some of the Earth"):
        simulate(options, tmp_path / "out")


@pytest.mark.parametrize("terrain", ["city", "natural"])
def test_relief_that_no_place_has_is_refused(tmp_path: Path, terrain: Any) -> None:
    heights = np.zeros((120, 120), np.float32)
    heights[50:70, 50:70] = 7500.0  # oblique images of such a tower would reach kilometres beyond the scene
    write_cog(tmp_path / "dsm.tif", heights, Grid("EPSG:32617", 436000.0, 3357000.0, 1.0, 120, 120))
    options = SimulateOptions(terrain=terrain, dsm=str(tmp_path / "dsm.tif"), size=32.0, views=2)
    with pytest.raises(InputError, match=r"dsm\.tif: found 7500 m between the lowest and the highest place"):
        simulate(options, tmp_path / "out")


@pytest.mark.parametrize("terrain", ["city", "natural"])
@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857"])
def test_a_surface_whose_map_does_not_count_metres_is_refused_by_its_name(
    tmp_path: Path, terrain: Any, crs: str
) -> None:
    cell = {"EPSG:4326": 1e-5, "EPSG:3857": 1.0}[crs]
    left, top = {"EPSG:4326": (12.0, 60.0), "EPSG:3857": (1_335_000.0, 8_400_000.0)}[crs]
    write_cog(tmp_path / "dsm.tif", hill().astype(np.float32), Grid(crs, left, top, cell, 60, 50))
    options = SimulateOptions(terrain=terrain, dsm=str(tmp_path / "dsm.tif"), size=32.0, views=2)
    with pytest.raises(InputError, match=r"dsm\.tif: CRS .*expected"):
        simulate(options, tmp_path / "out")


@pytest.mark.parametrize(
    ("terrain", "unknown", "share"), [("city", False, "10"), ("natural", False, "10"), ("city", True, "100")]
)
def test_ground_without_heights_in_the_given_surface_is_told(
    tmp_path: Path, terrain: Any, unknown: bool, share: str, caplog: pytest.LogCaptureFixture
) -> None:
    heights = hill().astype(np.float32)
    heights[20:30, 20:36] = np.nan
    if unknown:
        heights[1:] = np.nan  # the row at the edge lies beyond the scene
    write_cog(tmp_path / "dsm.tif", heights, GRID)
    options = SimulateOptions(terrain=terrain, dsm=str(tmp_path / "dsm.tif"), size=40.0, views=2)
    simulate(options, tmp_path / "out")
    assert (
        f"dsm.tif: no height in {share} % of the scene, which has the nearest one there, and the truth too"
        in caplog.text
    )


def test_a_town_whose_sun_is_down_is_refused(tmp_path: Path) -> None:
    write_cog(tmp_path / "dsm.tif", hill().astype(np.float32), Grid("EPSG:32633", 5e5, 8.66e6, 1.0, 60, 50))
    options = SimulateOptions(dsm=str(tmp_path / "dsm.tif"), size=32.0, views=6)
    with pytest.raises(InputError, match=r"dsm\.tif: found a sun -?\d+\.\d degrees high at 78\.0 N on 201"):
        simulate(options, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.tif"))


def test_the_season_of_trees_is_that_of_the_given_surfaces_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []
    monkeypatch.setattr(stage, "leaves_on", lambda day, lat: asked.append(lat) or 1.0)
    grid = Grid("EPSG:32756", 334_000.0, 6_250_000.0, 1.0, 60, 50)  # Sydney
    write_cog(tmp_path / "dsm.tif", hill().astype(np.float32), grid)
    options = SimulateOptions(terrain="downtown", dsm=str(tmp_path / "dsm.tif"), size=32.0, views=2, bias_px=0.0)
    simulate(options, tmp_path / "out")
    assert asked == pytest.approx([-33.9, -33.9], abs=0.1)

"""What has changed between two dates."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
from click.testing import CliRunner, Result
from shapely.geometry import box

from sattools.change.dates import register_dates
from sattools.change.detect import HeightChange, cell_sigma, find_regions, sums
from sattools.change.options import ChangeOptions
from sattools.change.surfaces import Surface
from sattools.cli import main
from sattools.scene.grid import Grid
from sattools.scene.raster import read_raster, write_cog

CRS = "EPSG:32617"
SIZE = 80  # cells of 1 m
GRID = Grid(crs=CRS, left=436000.0, top=3355080.0, cell_size=1.0, width=SIZE, height=SIZE)
WIDE = Grid(crs=CRS, left=436000.0, top=3355080.0, cell_size=0.5, width=2 * SIZE, height=2 * SIZE)


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(main, ["change", *map(str, arguments)])


def city(seed: int, *, noise: float = 0.3, houses: tuple[tuple[int, int], ...] = ((10, 10), (10, 50), (50, 10))) -> Any:
    """Houses of 12 x 12 m and 8 m height; errors of a surface go together over about 5 cells."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(seed)
    errors = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 2.0)
    heights = noise * errors / errors.std()
    for row, column in houses:
        heights[row : row + 12, column : column + 12] += 8.0
    return heights.astype(np.float32)


def saved(path: Path, heights: Any, grid: Grid = GRID) -> Path:
    write_cog(path, heights, grid, units="m")
    return path


def regions_between(old: Any, new: Any, **options: Any) -> Any:
    difference = new - old
    chosen = ChangeOptions(**options)
    return find_regions(HeightChange(difference, cell_sigma(difference, None), 1.0, chosen.correlation), chosen)


def test_a_house_that_went_and_one_that_came_are_found_with_their_volumes() -> None:
    old = city(1)
    new = city(2, houses=((10, 10), (10, 50), (50, 50)))
    labels, regions = regions_between(old, new)
    assert len(regions) == 2
    sunk = min(regions, key=lambda r: r.mean_m)
    risen = max(regions, key=lambda r: r.mean_m)
    # the noise of both dates is 0.4 m, of a mean over 144 m2 0.2 m
    assert sunk.mean_m == pytest.approx(-8.0, abs=0.6)
    assert risen.volume_m3 == pytest.approx(8.0 * 144, rel=0.1)
    assert abs(risen.volume_m3 - 8.0 * risen.area_m2) < 3 * risen.volume_std_m3
    assert max(r.p_value for r in regions) < 1e-6
    assert (labels[52:60, 52:60] == risen.label).all()
    assert (labels[52:60, 12:20] == sunk.label).all()


@pytest.mark.parametrize(("size", "rim"), [(4, 1.5), (7, 1.5), (7, 3.0), (12, 3.0), (30, 10.0)])
def test_a_square_that_has_risen_has_its_whole_area_and_volume(size: int, rim: float) -> None:
    difference = np.zeros((SIZE, SIZE), np.float32)
    difference[20 : 20 + size, 20 : 20 + size] = 4.0
    difference[70, :] = 4.0  # a wall one cell apart
    heights = HeightChange(difference, cell_sigma(difference, None), 1.0, 5.0)
    (region,) = find_regions(heights, ChangeOptions(rim=rim, min_area=1.0))[1]
    assert (region.area_m2, region.volume_m3) == (size**2, 4.0 * size**2)


def test_a_wall_beside_a_change_is_none() -> None:
    difference = np.zeros((2 * SIZE, 2 * SIZE), np.float32)
    difference[10:150, 40:80] = difference[10:150, 81] = 4.0
    heights = HeightChange(difference, cell_sigma(difference, None), 1.0, 5.0)
    (region,) = find_regions(heights, ChangeOptions(rim=5.0))[1]
    assert region.area_m2 == 140 * 40


@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_found_where_nothing_has_changed(seed: int) -> None:
    # walls one cell apart, as surfaces of two dates have them
    moved = city(100 + seed, houses=((10, 11), (9, 50), (50, 10)))
    assert regions_between(city(seed), moved)[1] == []


def test_one_noisy_surface_hides_a_small_change_that_a_sure_one_shows() -> None:
    difference = np.zeros((SIZE, SIZE), np.float32)
    difference[20:26, 20:26] = 2.5
    options = ChangeOptions()
    for std, found in ((0.1, 1), (1.5, 0)):
        sigma = cell_sigma(difference, np.full_like(difference, std))
        assert len(find_regions(HeightChange(difference, sigma, 1.0, 5.0), options)[1]) == found


def test_what_matching_was_not_sure_of_is_no_change() -> None:
    difference = np.zeros((SIZE, SIZE), np.float32)
    difference[20:26, 20:26] = difference[50:60, 50:60] = 6.0
    confidence = np.full_like(difference, 0.2)  # enough for 100 m2, not for 36
    heights = HeightChange(difference, cell_sigma(difference, None), 1.0, 5.0, confidence)
    labels, regions = find_regions(heights, ChangeOptions())
    assert len(regions) == 1
    assert (labels[52:58, 52:58] == 1).all()
    assert len(find_regions(heights, ChangeOptions(min_confidence=0.0))[1]) == 2


def test_cells_without_a_height_do_not_count() -> None:
    difference = np.full((4, 4), 2.0, np.float32)
    difference[0] = np.nan
    change = HeightChange(difference, np.full_like(difference, 0.5), 2.0, 0.0)
    assert change.area_m2 == 48.0
    figures = sums(np.ones((4, 4), bool), change)
    assert (figures.area_m2, figures.mean_m, figures.volume_m3) == (48.0, 2.0, 96.0)
    assert figures.volume_std_m3 == pytest.approx(0.5 * 48.0 / np.sqrt(12))


def test_a_change_of_albedo_is_later_minus_earlier_in_the_earlier_ones_light(tmp_path: Path) -> None:
    """The later date lies 2 m further east, its first band is half as bright and hazy, its second has more contrast."""
    earlier = np.random.default_rng(5).uniform(0.1, 0.4, (2, SIZE, SIZE)).astype(np.float32)
    meant, labels = earlier.copy(), np.zeros((SIZE, SIZE), np.int32)
    meant[:, 50:60, 50:60] += np.float32(0.2)
    labels[50:60, 50:60] = 1
    seen = np.stack([0.5 * meant[0] + 0.3, 2 * meant[1]])
    wider = Grid(crs=CRS, left=435990.0, top=3355090.0, cell_size=1.0, width=SIZE + 20, height=SIZE + 20)
    surfaces = []
    for name, grid, pad, maps in (("old", GRID, 0, (city(1), earlier)), ("new", wider, 10, (city(2), seen))):
        layers = {}
        for layer, array in zip(("height", "albedo"), maps, strict=True):
            sides = [(0, 0)] * (array.ndim - 2) + [(pad, pad)] * 2
            padded = np.roll(np.pad(array, sides, constant_values=np.nan), pad // 5, axis=-1)
            layers[layer] = saved(tmp_path / f"{name}_{layer}.tif", padded, grid)
        surfaces.append(Surface(name, layers, None, grid, ()))
    dates = register_dates(*surfaces, "ncc", tmp_path)
    assert dates.shift_m[:2] == (-2.0, 0.0)
    change = dates.albedo_change(labels)
    rows = slice(40, 70)
    # float32, and what is unchanged tells gain and offset exactly
    np.testing.assert_allclose(change(rows), (meant - earlier)[:, rows], atol=1e-5)


def test_what_only_one_date_has_counts_alone(tmp_path: Path) -> None:
    half, third = np.full((SIZE, SIZE), 0.5), np.full((SIZE, SIZE), 0.3)
    height = saved(tmp_path / "height.tif", city(1))
    sure = {"height": height, "std": saved(tmp_path / "sure.tif", third)}
    unsure = {"height": height, "std": saved(tmp_path / "unsure.tif", half)}
    for old, new, want in ((sure, unsure, 0.5), (sure, {"height": height}, 0.3), ({"height": height}, unsure, 0.5)):
        pair = (Surface("old", old, None, GRID, ()), Surface("new", new, None, GRID, ()))
        found = register_dates(*pair, "none", tmp_path).together("std", np.maximum)
        np.testing.assert_allclose(found, np.full(GRID.shape, want), rtol=1e-6)
    pair = [Surface(name, {"height": height}, None, GRID, ()) for name in ("old", "new")]
    assert register_dates(*pair, "none", tmp_path).together("std", np.maximum) is None


@pytest.mark.drawn
def test_the_command_writes_maps_polygons_and_a_table(tmp_path: Path) -> None:
    old = saved(tmp_path / "old.tif", city(1))
    wider = Grid(crs=CRS, left=435990.0, top=3355090.0, cell_size=1.0, width=SIZE + 20, height=SIZE + 20)
    later = np.pad(city(2, houses=((10, 10), (10, 50), (50, 50))), 10, constant_values=np.nan)
    new = saved(tmp_path / "new.tif", np.roll(later + 3.0, 2, axis=1), wider)  # 2 m east and 3 m up
    area = geopandas.GeoDataFrame(geometry=[box(436045, 3355015, 436067, 3355035)], crs=CRS)
    area.to_crs("EPSG:4326").to_file(tmp_path / "area.gpkg")
    out = tmp_path / "out"
    result = run(old, new, "--out", out, "--polygons", tmp_path / "area.gpkg")
    assert result.exit_code == 0, result.stderr
    table = json.loads(result.stdout)
    # rasters do not say where matching failed
    assert [note.split(":")[0] for note in table["notes"]] == [str(old), str(new)]
    assert all(f"{path}: found heights without the confidence" in result.stderr for path in (old, new))
    assert (
        "where matching failed, along the rim of what the images show above all, looks like a change" in result.stderr
    )
    assert table["shift_m"][:2] == [-2.0, 0.0]
    assert table["shift_m"][2] == pytest.approx(-3.0, abs=0.1)
    assert sorted(np.sign(region["mean_m"]) for region in table["regions"]) == [-1, 1]
    assert table["polygons"][0]["volume_m3"] == pytest.approx(8 * 144, rel=0.1)
    frame = geopandas.read_file(out / "changes.gpkg")
    assert sorted(frame["kind"]) == ["risen", "sunk"]
    assert frame.crs.to_epsg() == 32617
    on_ground = sum(region["area_m2"] for region in table["regions"])
    assert frame.area.sum() * 1.0007 == pytest.approx(on_ground, rel=1e-3)  # a square metre of the map there
    heights, grid = read_raster(out / "height_change.tif")
    assert grid == GRID
    assert np.nanmean(heights[0, 52:60, 52:60]) == pytest.approx(8.0, abs=0.5)
    assert (out / "height_change.png").stat().st_size > 1000
    # again: refused, and nothing replaced
    assert run(old, new, "--out", out).exit_code == 1
    assert run(old, new, "--out", out, "--overwrite").exit_code == 0


def test_scenes_are_compared_where_images_have_measured(make_town: Any, tmp_path: Path) -> None:
    from sattools.export.options import ExportOptions
    from sattools.export.stage import export
    from sattools.fit.options import FitOptions
    from sattools.fit.stage import fit

    town = make_town()
    options = FitOptions(resolution=2.0, coarsest=2.0, epochs=(1,), prior_weight=0.0)
    from sattools.progress import silent

    fit(town, options, silent)
    export(town, ExportOptions(), silent)
    document = town.output("scene.json")
    document.write_text(town.to_json() + "\n")
    result = run(document, document, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    table = json.loads(result.stdout)
    assert table["regions"] == []
    assert table["nmad_m"] == 0.0
    assert (tmp_path / "out" / "albedo_change.tif").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("old.tif", "nowhere.tif"), "nowhere.tif"),
        (("old.tif", "far.tif"), "expected overlap"),
        (("old.tif", "scene"), "found a folder, expected the scene document"),
        (("old.tif", "old.tif", "--polygons", "old.tif"), "found another format, expected polygons"),
        (("old.tif", "old.tif", "--polygons", "broken.gpkg"), "found another format"),
        (("old.tif", "old.tif", "--polygons", "points.gpkg"), "found no polygon"),
    ],
)
def test_bad_input_is_told_in_one_line(arguments: Any, message: str, tmp_path: Path) -> None:
    saved(tmp_path / "old.tif", city(1))
    away = Grid(crs=CRS, left=536000.0, top=3355080.0, cell_size=1.0, width=SIZE, height=SIZE)
    saved(tmp_path / "far.tif", city(1), away)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "scene.json").write_text("{}")
    (tmp_path / "broken.gpkg").write_text("no database")
    geopandas.GeoDataFrame(geometry=geopandas.points_from_xy([436010], [3355010]), crs=CRS).to_file(
        tmp_path / "points.gpkg"
    )
    result = run(*[a if a.startswith("--") else tmp_path / a for a in arguments], "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def hills(seed: int, rise: float = 0.0) -> Any:
    """Rolling ground of 4 m, and a heap with steep sides on it."""
    x, y = np.meshgrid(np.arange(SIZE * 2.0), np.arange(SIZE * 2.0))
    heights = 50 + 3 * np.sin(x / 30) * np.cos(y / 22) + np.random.default_rng(seed).normal(0, 0.1, x.shape)
    heights[50:80, 50:70] += rise
    return heights.astype(np.float32)


def test_a_large_change_does_not_move_ground_that_has_not(tmp_path: Path) -> None:
    files = [saved(tmp_path / f"{k}.tif", hills(k, rise), WIDE) for k, rise in ((1, 0.0), (2, 10.0))]
    done = run(*files, "--out", tmp_path / "out")
    assert done.exit_code == 0
    table = json.loads((tmp_path / "out" / "change.json").read_text())
    assert (table["registration"], table["shift_m"][:2]) == ("z", [0.0, 0.0])
    assert "left where it is, but for its height" in table["notes"][0]
    (region,) = table["regions"]
    assert region["volume_m3"] == pytest.approx(10 * 15 * 10, rel=0.01)


def test_heights_in_feet_that_do_not_say_so_are_told(tmp_path: Path) -> None:
    """Where the shapes are alike it is an error, else a note about their level."""
    old, new = hills(1), hills(2, 10.0) / np.float32(0.3048)
    write_cog(tmp_path / "feet.tif", hills(2) / np.float32(0.3048), WIDE)
    done = run(saved(tmp_path / "old.tif", old, WIDE), tmp_path / "feet.tif", "--out", tmp_path / "none")
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert "feet.tif: found heights that are 3.28 times the other surface's, as feet are" in done.stderr
    done = run(
        saved(tmp_path / "old2.tif", old, WIDE), saved(tmp_path / "new.tif", new, WIDE), "--out", tmp_path / "out"
    )
    assert done.exit_code == 0
    assert "which is taken out: are both in metres above the same datum?" in done.stderr


@pytest.mark.parametrize("units", ["m", None])
@pytest.mark.parametrize("radius", [25.0, 80.0])
def test_a_heap_that_has_grown_to_three_times_its_height_is_not_in_feet(
    tmp_path: Path, units: str | None, radius: float
) -> None:
    x, y = np.meshgrid(np.arange(SIZE) - 40.0, np.arange(SIZE) - 40.0)
    heap = np.maximum(0.0, 1 - np.hypot(x, y) / radius)
    for name, top in (("old", 6.0), ("new", 6.0 / 0.3048)):
        noise = np.random.default_rng(int(top)).normal(0, 0.1, heap.shape)
        write_cog(tmp_path / f"{name}.tif", (30 + top * heap + noise).astype(np.float32), GRID, units=units)
    done = run(tmp_path / "old.tif", tmp_path / "new.tif", "--out", tmp_path / "out")
    # where all of it has grown, only the file can say so
    assert done.exit_code == (1 if units is None and radius > 40 else 0)
    assert ("-units ft, or -units m if they are)" in done.stderr) == bool(done.exit_code)


def test_rasters_of_other_numbers_than_heights_are_refused(tmp_path: Path) -> None:
    write_cog(tmp_path / "albedo.tif", np.ones((3, SIZE, SIZE), np.float32), GRID)
    done = run(tmp_path / "albedo.tif", saved(tmp_path / "new.tif", city(1)), "--out", tmp_path / "out")
    assert (done.exit_code, (tmp_path / "out").exists()) == (1, False)
    assert "albedo.tif: found 3 bands, expected one of heights [m]" in done.stderr


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ("none.json", "neither.tif", "none.json: no such file, expected a scene document or a raster of heights"),
        ("none.tif", "neither.json", "none.tif: no such file, expected a scene document or a raster of heights"),
        ("text.tif", "neither.tif", "text.tif: found no readable image"),
        ("text.json", "neither.tif", "text.json: found"),
    ],
)
def test_of_two_dates_that_cannot_be_read_the_first_is_told(tmp_path: Path, first: str, second: str, told: str) -> None:
    for name in ("text.tif", "text.json"):
        (tmp_path / name).write_text("neither heights nor a scene")
    done = run(tmp_path / first, tmp_path / second, "--out", tmp_path / "out")
    assert (done.exit_code, done.stderr.count("\n"), (tmp_path / "out").exists()) == (1, 1, False)
    assert done.stderr.startswith(f"sattools change: error: {tmp_path}/{told}")

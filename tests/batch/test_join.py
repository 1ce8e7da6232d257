"""Scenes that were adjusted one by one are joined, and their seams say whether they fit together."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from sattools.batch.join import Part, inner_distance, join, seam
from sattools.batch.queue import Batch
from sattools.batch.stage import _join
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


def part_of(grid: Grid) -> Part:
    return Part(Scene("A", Path("a")), grid, inner_distance(np.ones(grid.shape, bool), grid.cell_size), grid)


def test_a_scene_counts_by_the_distance_to_its_border_and_not_beyond() -> None:
    part = part_of(Grid(CRS, 436000.0, 3355200.0, 2.0, 4, 3))
    # centres of cells lie 1 and 3 m from the border
    want = np.pad([[1, 1, 1, 1], [1, 3, 3, 1], [1, 1, 1, 1]], 1)
    np.testing.assert_allclose(part.weights(part.grid.widened(1)), want, atol=1e-6)


def test_scenes_that_only_touch_have_no_seam() -> None:
    """Their files are not even looked at."""
    part = part_of(Grid(CRS, 436000.0, 3355200.0, 2.0, 4, 3))
    for east, north in ((8.0, 0.0), (-8.0, 0.0), (0.0, 6.0), (0.0, -6.0), (500.0, 2.0)):
        assert seam(part, part_of(part.grid.moved(east, north))) is None


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


def rewrite(scene: Scene, heights: Any, validity: Any = None) -> None:
    """Give a scene these heights ``[h, w]``, and what its validity says of them."""
    write_cog(scene.path("export/dsm.tif"), np.asarray(heights, np.float32), scene.grid, units="m")
    if validity is not None:
        write_cog(scene.path("export/validity.tif"), np.asarray(validity, np.uint8), scene.grid, nodata=None)
        scene.products["validity"] = "export/validity.tif"


def test_there_is_no_step_where_the_data_of_a_scene_end_within_its_grid(tiles: list[Scene], tmp_path: Path) -> None:
    """The edge of a strip runs across the west scene; the east one lies 1 m higher."""
    rows, cols = np.mgrid[:400, :400]
    rewrite(tiles[0], np.where(cols + rows / 4 < 350, 10.0, np.nan))
    rewrite(tiles[1], np.full((400, 400), 11.0))
    join(tiles, tmp_path / "out")
    joined = read_raster(tmp_path / "out/dsm.tif")[0][0]
    # at the outer border of both, the ramps of both end
    assert np.nanmax(np.abs(np.diff(joined[50:350], axis=1))) < 0.1
    assert (joined[200, 239], joined[200, 300]) == (10.0, 11.0)


def test_measured_heights_come_before_filled_ones(tiles: list[Scene], tmp_path: Path) -> None:
    """Of `export --fill`: the eastern half of the west scene is unseen, and a street of the east one filled."""
    unseen, street = np.ones((400, 400)), np.ones((400, 400))
    unseen[:, 250:], street[100:110, :] = 0, 2
    rewrite(tiles[0], np.where(unseen == 0, 90.0, 10.0), unseen)
    rewrite(tiles[1], np.where(street == 2, 50.0, 10.0), street)
    made = join(tiles, tmp_path / "out")
    (seam,) = made["seams"]
    assert (seam["cells"], seam["median_m"], seam["nmad_m"]) == (390 * 10, 0.0, 0.0)  # columns 240 to 249
    joined = read_raster(tmp_path / "out/dsm.tif")[0][0]
    np.testing.assert_allclose(joined[:, :250], 10.0, atol=1e-3)
    np.testing.assert_allclose(np.delete(joined, np.s_[100:110], axis=0), 10.0, atol=1e-3)
    # nobody has measured it: what is filled from beside comes before what two images do not reach
    np.testing.assert_allclose(joined[100:110, 260:], 50.0, atol=1e-3)
    assert made["maps"] == ["dsm", "dsm_std", "validity"]
    codes = read_raster(tmp_path / "out/validity.tif")[0][0]
    assert (codes == 2).sum() == 10 * (640 - 250)
    assert (codes == 1).sum() == codes.size - 10 * (640 - 250)


def test_the_least_that_is_measured_comes_before_all_that_is_filled(tmp_path: Path) -> None:
    """The overview that weights are read from lacks the last column, which only one scene has measured."""
    scenes = []
    for name, width, height, code in (("SMALL", 1001, 10.0, 1), ("LARGE", 1401, 90.0, 2)):
        grid = Grid(CRS, 436000.0, 3355200.0, 0.5, width, 1001)
        scene = Scene(name, tmp_path / name, [], grid, products={"dsm": "export/dsm.tif"})
        rewrite(scene, np.full(grid.shape, height), np.full(grid.shape, code))
        scenes.append(scene)
    join(scenes, tmp_path / "out")
    joined = read_raster(tmp_path / "out/dsm.tif")[0][0]
    np.testing.assert_allclose(joined[:, :1001], 10.0, atol=1e-3)
    np.testing.assert_allclose(joined[:, 1001:], 90.0, atol=1e-3)


def test_cells_outside_the_areas_of_all_are_no_unseen_ones(tiles: list[Scene], tmp_path: Path) -> None:
    for scene in tiles:
        codes = np.ones((400, 400))
        codes[:50], codes[50:60] = 3, 0
        rewrite(scene, np.where(codes == 1, 10.0, np.nan), codes)
    codes[:20] = 0  # asked for by the east scene alone
    rewrite(tiles[1], np.where(codes == 1, 10.0, np.nan), codes)
    join(tiles, tmp_path / "out")
    found = read_raster(tmp_path / "out/validity.tif")[0][0]
    assert (found[20:50] == 3).all()
    assert (found[50:60] == 0).all()
    assert (found[:20, :240] == 3).all()
    assert (found[:20, 240:] == 0).all()


def test_maps_of_an_earlier_surface_do_not_stay_beside_another(tiles: list[Scene], tmp_path: Path) -> None:
    for scene in tiles:
        rewrite(scene, np.full((400, 400), 10.0), np.ones((400, 400)))
    assert join(tiles, tmp_path / "out")["maps"] == ["dsm", "dsm_std", "validity"]
    del tiles[0].products["validity"], tiles[1].products["dsm_std"]
    assert join(tiles, tmp_path / "out")["maps"] == ["dsm"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["dsm.tif", "seams.json"]


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


@pytest.mark.parametrize(("crs", "flags"), [("EPSG:26917", ()), ("EPSG:26917", ("--dry-run",)), ("UTM 17", ())])
def test_a_batch_refuses_to_join_scenes_of_two_crs_before_its_work(
    make_town: Any, tmp_path: Path, crs: str, flags: tuple[str, ...]
) -> None:
    a, b = make_town("A"), make_town("B")
    text = (b.root / "scene.json").read_text()
    (b.root / "scene.json").write_text(text.replace("EPSG:32617", crs))
    documents = (str(a.root / "scene.json"), str(b.root / "scene.json"))
    result = CliRunner().invoke(main, ["batch", *documents, "--join", "--out", str(tmp_path / "out"), *flags])
    assert result.exit_code == 1
    assert f"scene B: found {crs}, expected EPSG:32617 as of A" in result.stderr
    assert not (tmp_path / "out").exists()


def test_one_crs_may_be_spelled_in_several_ways(make_town: Any, tmp_path: Path) -> None:
    a, b = make_town("A"), make_town("B")
    text = (b.root / "scene.json").read_text()
    (b.root / "scene.json").write_text(text.replace("EPSG:32617", "epsg:32617"))
    documents = (str(a.root / "scene.json"), str(b.root / "scene.json"))
    result = CliRunner().invoke(main, ["batch", *documents, "--join", "--out", str(tmp_path / "out"), "--dry-run"])
    assert result.exit_code == 0, result.stderr


def test_a_joined_surface_does_not_give_way_to_one_of_fewer_scenes(make_town: Any, tmp_path: Path) -> None:
    """Its folder is that of a batch, which takes it up again without being asked."""
    out = tmp_path / "out"
    folder = out / "joined/default"
    folder.mkdir(parents=True)
    (out / "digests.json").write_text("{}")
    (folder / "dsm.tif").write_text("of both")
    (folder / "seams.json").write_text('{"scenes": ["A", "B"]}')
    call = ["batch", str(make_town("A").root / "scene.json"), "--join", "--out", str(out), "--dry-run"]
    result = CliRunner().invoke(main, call)
    assert result.exit_code == 1
    assert f"{folder / 'dsm.tif'}: found a surface with B, expected none but those given" in result.stderr
    for others in ([str(make_town("B").root / "scene.json")], ["--overwrite"]):
        assert CliRunner().invoke(main, [*call, *others]).exit_code == 0


def test_scenes_that_a_joined_surface_lacks_are_named(tiles: list[Scene], tmp_path: Path, caplog: Any) -> None:
    done = {("WEST", "usual"): {"scene_json": str(tiles[0].output("scene.json"))}}
    rows = [("WEST", "usual"), ("EAST", "usual"), ("EAST", "other")]
    joined = _join(cast(Batch, SimpleNamespace(rows=rows, results=done)), "usual", tmp_path)
    assert joined is not None
    assert joined["scenes"] == ["WEST"]
    assert "usual: the joined surface is without EAST, which failed" in caplog.text


def test_a_joined_surface_of_before_is_told_where_all_scenes_have_failed(tmp_path: Path, caplog: Any) -> None:
    batch = cast(Batch, SimpleNamespace(rows=[("WEST", "usual")], results={}))
    assert _join(batch, "usual", tmp_path) is None
    assert not caplog.text
    before = tmp_path / "joined/usual/dsm.tif"
    before.parent.mkdir(parents=True)
    before.touch()
    assert _join(batch, "usual", tmp_path) is None
    assert f"usual: nothing to join; {before} is still that of an earlier call" in caplog.text


def test_what_cannot_be_joined_is_named(tiles: list[Scene], tmp_path: Path) -> None:
    heights, grid = read_raster(tiles[1].path("export/dsm.tif"))
    write_cog(tiles[1].path("export/dsm.tif"), heights, Grid("EPSG:32618", *list(vars(grid).values())[1:]))
    with pytest.raises(InputError, match="EAST: found EPSG:32618, expected EPSG:32617 as of WEST"):
        join(tiles, tmp_path / "out")
    del tiles[0].products["dsm"]
    with pytest.raises(SceneError, match="WEST: found no DSM"):
        join(tiles, tmp_path / "out")


def test_water_that_was_laid_level_gives_way_to_what_another_scene_measured(tiles: list[Scene], tmp_path: Path) -> None:
    """West of 15 m of land, the first scene has taken all for water at 3 m, of which the other has measured 10 m."""
    water = np.full((400, 400), 4)
    water[:, 370:] = 1
    rewrite(tiles[0], np.where(water == 4, 3.0, 9.9), water)
    rewrite(tiles[1], np.full((400, 400), 10.0), np.ones((400, 400)))
    made = join(tiles, tmp_path / "out")
    (seam,) = made["seams"]
    assert seam["median_m"] == pytest.approx(0.1, abs=1e-5)  # of what both have measured
    assert seam["cells"] == 30 * 400
    heights, codes = (read_raster(tmp_path / f"out/{name}.tif")[0][0] for name in ("dsm", "validity"))
    np.testing.assert_allclose(heights[:, 245:365], 10.0, atol=1e-5)
    assert set(np.unique(heights[:, :239])) == {3.0}
    assert set(np.unique(codes[:, :239])) == {4}
    assert set(np.unique(codes[:, 241:])) == {1}

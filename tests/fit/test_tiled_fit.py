"""An area fitted in tiles is the area fitted at once, with the memory of a tile."""

import json
import math
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from in_tiles import TILED, Interrupted, assert_same, model, tile, until
from towns import Done, copied

from sattools.cli import main
from sattools.compare import compare_dsm, read_reference
from sattools.errors import SceneError
from sattools.fit.around import casting
from sattools.fit.checkpoint import load
from sattools.fit.stage import check_start, fit
from sattools.fit.surface import job
from sattools.fit.tiles import mosaic
from sattools.fit.tiles import plan as tile_plan
from sattools.fit.tiles.shared import Coarse
from sattools.prior import PriorOptions
from sattools.prior.cells import grids
from sattools.prior.files import read_prior
from sattools.render import sun_visibility
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster
from sattools.scene.tiles import reach_beyond

WHOLE = replace(TILED, tile=None)
SHORT = replace(TILED, epochs=[2])
GO_ON = replace(TILED, resume=True)


@pytest.fixture(scope="module")
def whole(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene fitted at once; tests must leave its files alone."""
    scene = copied(hamlet_source, tmp_path_factory.mktemp("whole") / "HAMLET")
    fit(scene, WHOLE)
    return scene


@pytest.fixture(scope="module")
def joined(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """The small scene fitted in four tiles, one after the other. Every cell that is put back is told."""
    scene = copied(hamlet_source, tmp_path_factory.mktemp("joined") / "HAMLET")
    said, progress = until()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(job, "WORTH_SAYING", 0.0)
        return Done(scene, fit(scene, TILED, progress), said)


def test_tiles_leave_what_a_fit_of_the_whole_leaves(whole: Scene, joined: Done) -> None:
    tiled = joined.scene
    (one, about), (other, about_other) = model(whole), model(tiled)
    assert {name: t.shape for name, t in one.items()} == {name: t.shape for name, t in other.items()}
    assert about.keys() == about_other.keys()
    assert about["grid"] == about_other["grid"]
    assert tiled.products.keys() == whole.products.keys()
    assert "4 tiles of up to 16 m" in joined.found["notes"]
    assert not (tiled.root / "fit/tiles").exists()
    for name in ("dsm", "confidence", "normals", "water"):
        assert (tiled.root / f"prior/{name}.tif").exists()


def test_tiles_are_as_good_as_the_whole_and_show_no_seam(whole: Scene, joined: Done) -> None:
    truth = read_reference(whole.path(whole.products["truth_dsm"]))
    grid = whole.require_grid().resized(1.0)
    heights = [model(scene)[0]["height"].numpy() for scene in (whole, joined.scene)]
    errors = [compare_dsm(height, truth, grid).figures["mae"] for height in heights]
    # tiles of 24 cells are mostly border: half of a per cent of the height range; benchmarks/tiles.py has real sizes
    assert errors[1] == pytest.approx(errors[0], abs=0.1)
    difference = heights[1] - heights[0]
    for axis in (0, 1):
        steps = np.abs(np.diff(difference, axis=axis)).mean(axis=1 - axis)
        seam = 15  # the cells on either side of the middle, where four tiles meet
        assert steps[seam] <= np.percentile(np.delete(steps, seam), 95)


def test_a_fit_in_tiles_tells_how_far_it_is(joined: Done) -> None:
    shares = [share for share, _ in joined.told]
    assert shares == sorted(shares)
    assert joined.told[0][1].startswith("whole area, coarsely: ")


def test_an_interrupted_tiled_fit_does_only_what_is_left(begun_tiles: Scene, joined: Done, tmp_path: Path) -> None:
    scene = copied(begun_tiles, tmp_path / "CUT")
    for begin in (check_start, fit):
        with pytest.raises(
            SceneError,
            match="found a checkpoint of other options, images or cameras, expected the same; give",
        ):
            begin(scene, replace(GO_ON, seed=1))
    check_start(scene, GO_ON)
    with pytest.raises(Interrupted):
        fit(scene, GO_ON, until("tile 3 of 4", "epoch 6")[1])
    said, progress = until()
    fit(scene, GO_ON, progress)
    assert {message.split(":")[0] for _, message in said if ":" in message} == {"tile 3 of 4", "tile 4 of 4"}
    assert not any("epoch 1 of" in message for _, message in said if "tile 3" in message)
    # the same as without interruption
    assert_same(model(scene)[0], model(joined.scene)[0])


def test_tiles_fitted_one_by_one_anywhere_are_joined_to_the_same(
    begun_tiles: Scene, finished_tiles: Scene, joined: Done, tmp_path: Path
) -> None:
    with pytest.raises(SceneError, match=r"r1c0/fit/model\.safetensors: no such file, expected the model of a fitted"):
        fit(copied(begun_tiles, tmp_path / "HALF"), replace(TILED, part="mosaic"))
    scene = copied(finished_tiles, tmp_path / "PARTS")
    fit(scene, replace(TILED, part="mosaic"))
    assert_same(model(scene)[0], model(joined.scene)[0])


def test_priors_of_tiles_know_what_stands_within_48_metres(begun_tiles: Scene) -> None:
    """A narrow overlap had them know 16 m beyond it: what stands further away hides and shades parts of a tile."""
    assert TILED.overlap == 4.0
    assert {tile(begun_tiles, name).surroundings_m for name in ("r0c0", "r0c1", "r1c0", "r1c1")} == {44.0}
    assert [reach_beyond(overlap) for overlap in (8.0, 31.0, 32.0, 64.0)] == [40.0, 17.0, None, None]


def test_images_have_the_same_colours_and_poses_in_all_tiles(begun_tiles: Scene) -> None:
    one, two = (load(begun_tiles.root / f"fit/tiles/{name}/fit/model.safetensors")[0] for name in ("r0c0", "r0c1"))
    common = load(begun_tiles.root / "fit/tiles/common.safetensors")[0]
    for name in ("gain", "offset", "ambient", "pose"):
        assert torch.equal(one[name], two[name])
        assert torch.equal(one[name], common[name])
    assert float(common["gain"].std()) > 0.01


def test_the_coarse_fit_of_the_whole_is_matched_on_its_own_cells(make_hamlet: Any) -> None:
    coarse = tile_plan.Plan.make(make_hamlet(), TILED)._coarse_scene()
    assert coarse.require_grid().cell_size > 0.75  # wide for the pixels of 0.5 m, and so large an area has many of them
    assert grids(coarse, coarse.items, PriorOptions()) == (coarse.grid, coarse.grid)


@dataclass(frozen=True)
class Read:
    """Parts that have read a prior, and cells that they read of it."""

    cells: dict[str, int]

    def noting(self, *given: Any) -> Any:
        found = read_prior(*given)
        self.cells[given[0].root.name] = found[0].size
        return found


@pytest.fixture(scope="module")
def piloted(matched_hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Read]:
    """The small scene with its prior, split after pilot tiles, and what those read; tests must leave it alone."""
    scene, read = copied(matched_hamlet_source, tmp_path_factory.mktemp("piloted") / "HAMLET"), Read({})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tile_plan, "FINE_ENOUGH", 1)
        patch.setattr("sattools.prior.files.read_prior", read.noting)
        fit(scene, replace(SHORT, part="split"))
    return scene, read


def test_pilot_tiles_settle_what_the_coarse_fit_cannot_see(piloted: tuple[Scene, Read]) -> None:
    scene, _ = piloted
    pilots = sorted(path.name for path in (scene.root / "fit/tiles").glob("pilot.*"))
    assert pilots == ["pilot.r0c0", "pilot.r0c1", "pilot.r1c0", "pilot.r1c1"]
    own = [load(scene.root / f"fit/tiles/{name}/fit/model.safetensors")[0] for name in pilots]
    common = load(scene.root / "fit/tiles/common.safetensors")[0]
    for name in ("gain", "offset", "ambient", "pose"):
        assert torch.equal(common[name], torch.stack([t[name] for t in own]).median(dim=0).values)


def test_pilots_may_be_fitted_by_commands_of_their_own(
    piloted: tuple[Scene, Read], make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tile_plan, "FINE_ENOUGH", 1)
    scene = make_matched_hamlet("APART")
    names = fit(scene, replace(SHORT, part="coarse"))["pilots"]
    assert names == ["pilot.r0c0", "pilot.r0c1", "pilot.r1c0", "pilot.r1c1"]
    assert not list((scene.root / "fit/tiles").glob("r*"))
    for name in names:
        # 20 m wide with what they share, and told of tiles of 16 m as a batch tells them
        fit(tile(scene, name), SHORT)
    begun = {name: (scene.root / f"fit/tiles/{name}/fit/model.safetensors").stat().st_mtime_ns for name in names}
    found = fit(scene, replace(SHORT, part="split", resume=True))["tiles"]
    assert found == ["r0c0", "r0c1", "r1c0", "r1c1"]
    (one, _), (other, _) = (load(s.root / "fit/tiles/common.safetensors") for s in (piloted[0], scene))
    assert_same(one, other)
    done = {name: (scene.root / f"fit/tiles/{name}/fit/model.safetensors").stat().st_mtime_ns for name in names}
    assert done == begun


def test_no_part_reads_more_of_a_given_prior_than_shows_its_own_ground(
    piloted: tuple[Scene, Read], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory must not grow with the area, and a prior of 100 million cells is larger than all else."""
    source, of_pilots = piloted
    scene, read = copied(source, tmp_path / "GIVEN"), Read(dict(of_pilots.cells))
    monkeypatch.setattr("sattools.prior.files.read_prior", read.noting)
    fit(scene, replace(SHORT, resume=True))
    cells = {name: count for name, count in read.cells.items() if name != "coarse"}
    assert sorted(cells) == sorted(f"{kind}r{row}c{col}" for kind in ("pilot.", "") for row in (0, 1) for col in (0, 1))
    whole = read_raster(scene.path(scene.products["prior_dsm"]))[0].size
    # 16 of 32 m and 4 m of the neighbour, each way
    assert all(count <= (20 / 32) ** 2 * whole for count in cells.values())


def test_a_scene_moved_with_unfinished_tiles_goes_on_with_its_own_files(
    piloted: tuple[Scene, Read], tmp_path: Path
) -> None:
    """With those of the place where it was cut, a copy would show whatever has become of the original since."""
    stays, cut = (copied(piloted[0], tmp_path / name) for name in ("STAYS", "CUT"))
    shutil.move(cut.root, tmp_path / "elsewhere")
    moved = Scene.from_file(tmp_path / "elsewhere/scene.json")
    first = tile(moved, "r0c0")
    files = [first.path(asset.href) for item in first.items for asset in item.assets.values()]
    files += [first.path(href) for href in first.products.values()]
    assert len(files) > 10
    assert all(path.exists() and path.is_relative_to(moved.root) for path in files)
    fit(first, replace(WHOLE, epochs=[2]))  # as an array job does
    fit(tile(stays, "r0c0"), SHORT)
    assert_same(model(first)[0], model(tile(stays, "r0c0"))[0])
    said, progress = until("tile 2 of 4")
    with pytest.raises(Interrupted):
        fit(moved, replace(SHORT, resume=True), progress)
    assert len(said) == 1


def test_what_is_put_back_in_the_coarse_fit_is_no_news(joined: Done) -> None:
    """Cells of 2 m lie 2 m off their prior wherever a wall stands, and nothing of them is in the result."""
    told = [text for text in joined.found["notes"] if "strayed from the prior" in text]
    assert len(told) == 4
    assert all(text.startswith("tile r") for text in told)


def test_a_tile_that_too_few_images_show_takes_the_coarse_surface(make_hamlet: Any) -> None:
    """Three of four images are cut off east of the middle: the eastern tiles have one image left."""
    import rasterio

    scene = make_hamlet("HALF")
    for item in scene.items[1:]:
        path = scene.path(item.assets["image"].href)
        with rasterio.open(path, "r+") as image:
            image.nodata = 0
            numbers = image.read()
            # UTM's north lies up in these images: what is right of the middle is east of it
            numbers[:, :, numbers.shape[2] // 2 - 16 :] = 0
            image.write(numbers)
    said = fit(scene, SHORT)["notes"]
    assert [text for text in said if text.startswith("tile")][:2] == [
        "tile r0c1: 1 image shows it, its surface is the coarse one",
        "tile r1c1: 1 image shows it, its surface is the coarse one",
    ]
    assert torch.isfinite(model(scene)[0]["height"]).all()


def test_what_stands_outside_a_tile_throws_its_shadow_into_it() -> None:
    """A wall of 30 m, 10 m east of the tile; the sun in the east, 30 degrees high: 52 m of shadow, 42 m in the tile."""
    whole, tile = Grid("EPSG:32617", 0.0, 100.0, 2.0, 100, 50), Grid("EPSG:32617", 0.0, 100.0, 1.0, 100, 100)
    height = torch.zeros(whole.shape)
    height[:, 55:57] = 30.0  # 110 to 114 m east
    coarse = Coarse({}, {}, height, whole, tile)
    sun = (math.cos(math.radians(30)), 0.0, 0.5)
    flat = torch.zeros(tile.shape)
    assert (sun_visibility(flat, 1.0, sun) == 1).all()
    cast = casting(coarse.around(None))
    lit = cast(flat, 1.0, sun)
    assert lit.shape == flat.shape
    # the edge of the wall is a ramp of a coarse cell
    assert int((lit[50] < 0.5).sum()) == pytest.approx(42, abs=2)
    assert (lit[:, :50] == 1).all()
    # from the other side it stands in nobody's way
    assert (cast(flat, 1.0, (-sun[0], 0.0, 0.5)) == 1).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--tile", "32"],
            "found 32 m, expected less than half of --tile 32 m (a smaller --overlap, or tiles of more than 64 m)",
        ),
        (["--part", "mosaic"], "found mosaic, expected --tile beside it"),
        (["--tile", "-1"], "-1.0 is not in the range"),
    ],
)
def test_wrong_use_is_told_at_once(options: Any, words: Any) -> None:
    result = CliRunner().invoke(main, ["fit", *options, "none.json"])
    assert result.exit_code == 2
    assert words in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--preset", "eonerf"], "--tile: found --field mlp of --preset eonerf, expected --field surface: a field of"),
        (["--preset", "eonerf", "--overlap", "32"], "found --field mlp of --preset eonerf, expected --field surface"),
        (["--field", "voxel"], "--tile: found --field voxel, expected --field surface: a field of rays has no maps"),
        (["--brdf", "hapke"], "--tile: found --brdf hapke, expected --brdf lambert: materials are found for an area"),
        (["--budget", "9"], "a tile needs the time it needs (without --tile all is fitted at once)"),
        (["--budget", "9", "--dry-run"], "--tile: found --budget 9.0, expected none: a tile needs the time it needs"),
        (["--overlap", "2", "--tile", "8"], "--tile: found 8 m, expected at least"),
    ],
)
def test_what_does_not_go_with_tiles_is_one_line(make_hamlet: Any, options: Any, words: Any) -> None:
    scene = make_hamlet()
    result = CliRunner().invoke(
        main, ["fit", "--tile", "32", "--overlap", "8", *options, str(scene.root / "scene.json")]
    )
    assert result.exit_code == 1
    assert words in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_a_tile_size_of_0_is_a_fit_at_once(make_matched_hamlet: Any) -> None:
    scene = make_matched_hamlet("ZERO")
    fit(scene, replace(WHOLE, tile=0.0, epochs=[1]))
    assert not any(json.loads(text).get("tiles") for text in [json.dumps(model(scene)[1])])
    assert not (scene.root / "fit/tiles").exists()


def test_strips_of_any_height_join_to_the_same_model(
    finished_tiles: Scene, joined: Done, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that has been joined so far was one strip."""
    assert joined.scene.require_grid().height < mosaic.STRIP_ROWS
    monkeypatch.setattr(mosaic, "STRIP_ROWS", 7)
    scene = copied(finished_tiles, tmp_path / "STRIPS")
    fit(scene, replace(TILED, part="mosaic"))
    assert_same(model(scene)[0], model(joined.scene)[0])
    for name in ("dsm", "normals"):
        found, expected = (read_raster(one.root / f"prior/{name}.tif")[0] for one in (scene, joined.scene))
        np.testing.assert_array_equal(found, expected)


def test_what_was_begun_in_tiles_goes_on_in_them_without_their_size(
    begun_tiles: Scene, finished_tiles: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As where `fit` had chosen it by the memory that was free then."""
    scene = copied(begun_tiles, tmp_path / "OPEN")
    said, progress = until("tile 4 of 4")
    with pytest.raises(Interrupted):
        fit(scene, replace(GO_ON, tile=None), progress)
    assert "goes on in the tiles of 16 m that were begun" in caplog.text
    assert {message.split(":")[0] for _, message in said if ":" in message} == {"tile 3 of 4", "tile 4 of 4"}
    assert_same(model(tile(scene, "r1c0"))[0], model(tile(finished_tiles, "r1c0"))[0])

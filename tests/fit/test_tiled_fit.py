"""An area fitted in tiles is the area fitted at once, with the memory of a tile."""

import json
import math
import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from towns import copied

from sattools.cli import main
from sattools.compare import compare_dsm, read_reference
from sattools.errors import SceneError
from sattools.fit.around import casting
from sattools.fit.checkpoint import load
from sattools.fit.options import FitOptions
from sattools.fit.stage import check_start, fit
from sattools.fit.surface import job
from sattools.fit.tiles import mosaic
from sattools.fit.tiles import plan as tile_plan
from sattools.fit.tiles.shared import Coarse
from sattools.prior import PriorOptions
from sattools.prior.files import read_prior
from sattools.prior.gate import grids
from sattools.render import sun_visibility
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster

WHOLE = FitOptions(resolution=1.0, epochs=[8])
TILED = replace(WHOLE, tile=32.0, overlap=8.0)
SMALL = replace(WHOLE, tile=16.0, overlap=4.0)  # of the small scene, four tiles too
SHORT = replace(SMALL, epochs=[2])


def model(scene: Any) -> Any:
    return load(scene.root / "fit/model.safetensors")


class Interrupted(Exception):
    """Stands for whatever ends a process."""


@pytest.fixture(scope="module")
def both(town_source: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The simulated town fitted at once and in four tiles."""
    scenes = []
    for name, options in (("WHOLE", WHOLE), ("TILED", TILED)):
        scene = copied(town_source, tmp_path_factory.mktemp("tiles") / name)
        scenes.append((scene, fit(scene, options)))
    return scenes


@pytest.fixture(scope="module")
def joined(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    """The model of the small scene's tiles, fitted one after the other."""
    scene = copied(hamlet_source, tmp_path_factory.mktemp("joined") / "HAMLET")
    fit(scene, SMALL)
    return model(scene)[0]


def test_tiles_leave_what_a_fit_of_the_whole_leaves(both: Any) -> None:
    (whole, _), (tiled, said) = both
    (one, about), (other, about_other) = model(whole), model(tiled)
    assert {name: t.shape for name, t in one.items()} == {name: t.shape for name, t in other.items()}
    assert about.keys() == about_other.keys()
    assert about["grid"] == about_other["grid"]
    assert tiled.products.keys() == whole.products.keys()
    assert "4 tiles of up to 32 m" in said["notes"]
    assert not (tiled.root / "fit/tiles").exists()
    for name in ("dsm", "confidence", "normals", "water"):
        assert (tiled.root / f"prior/{name}.tif").exists()


def test_tiles_are_as_good_as_the_whole_and_show_no_seam(both: Any) -> None:
    (whole, _), (tiled, _) = both
    truth = read_reference(whole.path(whole.products["truth_dsm"]))
    grid = whole.require_grid().resized(1.0)
    heights = [model(scene)[0]["height"].numpy() for scene in (whole, tiled)]
    errors = [compare_dsm(height, truth, grid).figures["mae"] for height in heights]
    # tiles of 48 cells are mostly border: half of a per cent of the height range; benchmarks/tiles.py has real sizes
    assert errors[1] == pytest.approx(errors[0], abs=0.1)
    difference = heights[1] - heights[0]
    for axis in (0, 1):
        steps = np.abs(np.diff(difference, axis=axis)).mean(axis=1 - axis)
        seam = 31  # the cells on either side of the middle, where four tiles meet
        assert steps[seam] <= np.percentile(np.delete(steps, seam), 95)


def test_an_interrupted_tiled_fit_does_only_what_is_left(joined: Any, make_hamlet: Any) -> None:
    scene = make_hamlet("CUT")
    said = []

    def stop(fraction: Any, message: Any) -> None:
        said.append((fraction, message))
        if "tile 3 of 4" in message and "epoch 6" in message:
            raise Interrupted

    with pytest.raises(Interrupted):
        fit(scene, SMALL, stop)
    shares = [share for share, _ in said]
    assert shares == sorted(shares)
    assert said[0][1].startswith("whole area, coarsely: ")
    assert [(scene.root / f"fit/tiles/{n}/fit/model.safetensors").exists() for n in ("r0c1", "r1c0")] == [True, False]
    said.clear()
    for begin in (check_start, fit):
        with pytest.raises(
            SceneError,
            match="found a checkpoint of other options, images or cameras, expected the same; give",
        ):
            begin(scene, replace(SMALL, seed=1, resume=True))
    check_start(scene, replace(SMALL, resume=True))
    fit(scene, replace(SMALL, resume=True), lambda share, message: said.append((share, message)))
    assert {message.split(":")[0] for _, message in said if ":" in message} == {"tile 3 of 4", "tile 4 of 4"}
    # the same as without interruption, bit for bit
    found, expected = model(scene)[0], joined
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_tiles_fitted_one_by_one_anywhere_are_joined_to_the_same(joined: Any, make_hamlet: Any) -> None:
    scene = make_hamlet("PARTS")
    documents = fit(scene, replace(SMALL, part="split"))["tiles"]
    assert documents == ["r0c0", "r0c1", "r1c0", "r1c1"]
    with pytest.raises(SceneError, match=r"r0c0/fit/model\.safetensors: no such file, expected the model of a fitted"):
        fit(scene, replace(SMALL, part="mosaic"))
    for name in reversed(documents):
        fit(Scene.from_file(scene.root / f"fit/tiles/{name}/scene.json"), SMALL)
    fit(scene, replace(SMALL, part="mosaic"))
    found, expected = model(scene)[0], joined
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_images_have_the_same_colours_and_poses_in_all_tiles(make_matched_hamlet: Any) -> None:
    scene = make_matched_hamlet("SHARED")
    names = fit(scene, replace(SHORT, part="split"))["tiles"]
    for name in names[:2]:
        fit(Scene.from_file(scene.root / f"fit/tiles/{name}/scene.json"), SHORT)
    one, two = (load(scene.root / f"fit/tiles/{name}/fit/model.safetensors")[0] for name in names[:2])
    common = load(scene.root / "fit/tiles/common.safetensors")[0]
    for name in ("gain", "offset", "ambient", "pose"):
        assert torch.equal(one[name], two[name])
        assert torch.equal(one[name], common[name])
    assert float(common["gain"].std()) > 0.01


def test_the_coarse_fit_of_the_whole_is_matched_on_its_own_cells(make_town: Any) -> None:
    coarse = tile_plan.Plan.make(make_town(), TILED)._coarse_scene()
    assert coarse.require_grid().cell_size > 0.75  # wide for the pixels of 0.5 m, and so large an area has many of them
    assert grids(coarse, coarse.items, PriorOptions()) == (coarse.grid, coarse.grid)


def test_pilot_tiles_settle_what_the_coarse_fit_cannot_see(
    make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tile_plan, "FINE_ENOUGH", 1)
    scene = make_matched_hamlet("PILOTS")
    fit(scene, replace(SHORT, part="split"))
    pilots = sorted(path.name for path in (scene.root / "fit/tiles").glob("pilot.*"))
    assert pilots == ["pilot.r0c0", "pilot.r0c1", "pilot.r1c0", "pilot.r1c1"]
    own = [load(scene.root / f"fit/tiles/{name}/fit/model.safetensors")[0] for name in pilots]
    common = load(scene.root / "fit/tiles/common.safetensors")[0]
    for name in ("gain", "offset", "ambient", "pose"):
        assert torch.equal(common[name], torch.stack([t[name] for t in own]).median(dim=0).values)


def test_pilots_may_be_fitted_by_commands_of_their_own(
    make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tile_plan, "FINE_ENOUGH", 1)
    options = SHORT
    whole, apart = make_matched_hamlet("WHOLE"), make_matched_hamlet("APART")
    fit(whole, replace(options, part="split"))
    names = fit(apart, replace(options, part="coarse"))["pilots"]
    assert names == ["pilot.r0c0", "pilot.r0c1", "pilot.r1c0", "pilot.r1c1"]
    assert not list((apart.root / "fit/tiles").glob("r*"))
    for name in names:
        # 20 m wide with what they share, and told of tiles of 16 m as a batch tells them
        fit(Scene.from_file(apart.root / f"fit/tiles/{name}/scene.json"), options)
    begun = {name: (apart.root / f"fit/tiles/{name}/fit/model.safetensors").stat().st_mtime_ns for name in names}
    found = fit(apart, replace(options, part="split", resume=True))["tiles"]
    assert found == ["r0c0", "r0c1", "r1c0", "r1c1"]
    (one, _), (other, _) = (load(scene.root / "fit/tiles/common.safetensors") for scene in (whole, apart))
    assert all(torch.equal(one[name], other[name]) for name in one)
    done = {name: (apart.root / f"fit/tiles/{name}/fit/model.safetensors").stat().st_mtime_ns for name in names}
    assert done == begun


def test_no_part_reads_more_of_a_given_prior_than_shows_its_own_ground(
    make_matched_town: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory must not grow with the area, and a prior of 100 million cells is larger than all else."""
    monkeypatch.setattr(tile_plan, "FINE_ENOUGH", 1)
    scene = make_matched_town("GIVEN")
    read = []

    def noting(*args: Any) -> Any:
        found = read_prior(*args)
        read.append((args[0].root.name, found[0].shape))
        return found

    monkeypatch.setattr("sattools.prior.files.read_prior", noting)
    fit(scene, replace(TILED, epochs=[1]))
    names = [f"{kind}r{row}c{col}" for kind in ("pilot.", "") for row in (0, 1) for col in (0, 1)]
    assert sorted(name for name, _ in read if name != "coarse") == sorted(names)
    cells = {name: n * m for name, (n, m) in read}
    # 32 of 64 m and 8 m of the neighbour, each way
    assert all(cells[name] <= (40 / 64) ** 2 * cells_of(scene) for name in names)


def test_a_scene_moved_with_unfinished_tiles_goes_on_with_its_own_files(
    make_matched_hamlet: Any, tmp_path: Any
) -> None:
    """With those of the place where it was cut, a copy would show whatever has become of the original since."""
    options = SHORT
    whole, cut = make_matched_hamlet("ONCE"), make_matched_hamlet("CUT")
    fit(whole, options)
    fit(cut, replace(options, part="split"))
    cut.write()
    shutil.move(cut.root, tmp_path / "elsewhere")
    moved = Scene.from_file(tmp_path / "elsewhere/scene.json")
    first = Scene.from_file(moved.root / "fit/tiles/r0c0/scene.json")
    files = [first.path(asset.href) for item in first.items for asset in item.assets.values()]
    files += [first.path(href) for href in first.products.values()]
    assert len(files) > 10
    assert all(path.exists() and path.is_relative_to(moved.root) for path in files)
    fit(first, options=replace(WHOLE, epochs=[2]))  # as an array job does
    fit(moved, replace(options, resume=True))
    (one, _), (other, _) = model(whole), model(moved)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_what_is_put_back_in_the_coarse_fit_is_no_news(make_matched_town: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells of 24 m lie 2 m off their prior wherever the ground slopes, and nothing of them is in the result."""
    monkeypatch.setattr(job, "WORTH_SAYING", 0.0)
    said = fit(make_matched_town("STRAY"), replace(TILED, epochs=[1]))["notes"]
    told = [text for text in said if "strayed from the prior" in text]
    assert len(told) == 4
    assert all(text.startswith("tile r") for text in told)


def cells_of(scene: Scene) -> int:
    """Cells of a scene's prior."""
    return int(np.prod(read_raster(scene.path(scene.products["prior_dsm"]))[0].shape))


def test_a_tile_that_too_few_images_show_takes_the_coarse_surface(make_town: Any) -> None:
    """Five of six images are cut off east of the middle: the eastern tiles have one image left."""
    import rasterio

    scene = make_town("HALF")
    for item in scene.items[1:]:
        path = scene.path(item.assets["image"].href)
        with rasterio.open(path, "r+") as image:
            image.nodata = 0
            numbers = image.read()
            # UTM's north lies up in these images: what is right of the middle is east of it
            numbers[:, :, numbers.shape[2] // 2 - 16 :] = 0
            image.write(numbers)
    said = fit(scene, replace(TILED, epochs=[2]))["notes"]
    assert [text for text in said if text.startswith("tile")][:2] == [
        "tile r0c1: 1 images show it, its surface is the coarse one",
        "tile r1c1: 1 images show it, its surface is the coarse one",
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
def test_what_does_not_go_with_tiles_is_one_line(make_town: Any, options: Any, words: Any) -> None:
    scene = make_town()
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


def test_strips_of_any_height_join_to_the_same_model(make_hamlet: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    for rows in (256, 7):
        scene = make_hamlet(f"STRIPS{rows}")
        monkeypatch.setattr(mosaic, "STRIP_ROWS", rows)
        fit(scene, SHORT)
        made.append((model(scene)[0], [read_raster(scene.root / f"prior/{n}.tif")[0] for n in ("dsm", "normals")]))
    (one, maps), (other, other_maps) = made
    assert one.keys() == other.keys()
    for name, tensor in one.items():
        assert torch.equal(tensor.nan_to_num(-1), other[name].nan_to_num(-1)), name
    for values, others in zip(maps, other_maps, strict=True):
        np.testing.assert_array_equal(values, others)


def test_what_was_begun_in_tiles_goes_on_in_them_without_their_size(
    joined: Any, make_hamlet: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """As where `fit` had chosen it by the memory that was free then."""
    scene = make_hamlet("OPEN")

    def stop(fraction: Any, message: Any) -> None:
        if "tile 2 of 4" in message:
            raise Interrupted

    with pytest.raises(Interrupted):
        fit(scene, SMALL, stop)
    said = []
    fit(scene, replace(SMALL, tile=None, resume=True), lambda share, message: said.append(message))
    assert "goes on in the tiles of 16 m that were begun" in caplog.text
    assert not any(message.startswith(("whole area", "tile 1 of 4")) for message in said)
    found, expected = model(scene)[0], joined
    assert all(torch.equal(found[name], expected[name]) for name in expected)

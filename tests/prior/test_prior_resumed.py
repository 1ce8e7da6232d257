"""A matching in tiles that was interrupted goes on with those that are finished, and ends as one that was not."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from towns import copied

from sattools import api
from sattools.cli.plans import of_prior
from sattools.errors import OutputExistsError, SattoolsError, SceneError
from sattools.fit.options import FitOptions
from sattools.fit.tiles.clearing import remove_parts
from sattools.prior import PriorOptions, foresight, resume, tiled
from sattools.prior.foresight import START_S, foresee_matching
from sattools.prior.gate import check_start
from sattools.scene import Scene
from sattools.scene.document import FIT_ROLE

GIVEN = PriorOptions(rough_passes=1, pairs=6)
MATCHED = "rough pass 1 of 1"  # told once of every tile that is matched


class Interrupted(Exception):
    """Stands for whatever ends a process."""


def cut_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The small scene is matched in four tiles."""
    for name, value in {"AT_ONCE": 1000, "TILE_CELLS": 56, "OVERLAP_M": 6.0, "OVERLAP_CELLS": 8}.items():
        monkeypatch.setattr(tiled, name, value)


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    cut_small(monkeypatch)


def until(*words: str) -> tuple[list[str], Callable[[float, str], None]]:
    """A list of what is told, and what fills it and interrupts a matching that tells one of these words."""
    said: list[str] = []

    def progress(share: float, message: str) -> None:
        said.append(message)
        if message in words:
            raise Interrupted

    return said, progress


def interrupted(scene: Scene, at: str = "tile 3 of 4", options: PriorOptions = GIVEN, **flags: Any) -> Scene:
    """The scene with what a matching leaves that is interrupted at that word."""
    with pytest.raises(Interrupted):
        api.match(scene, options, progress=until(at)[1], **flags)
    return scene


def matched_of(scene: Scene, options: PriorOptions = GIVEN, **flags: Any) -> int:
    """Match a scene; how many tiles that took."""
    said, progress = until()
    api.match(scene, options, progress=progress, **flags)
    return said.count(MATCHED)


def files(scene: Scene) -> dict[str, bytes]:
    """All that a matching has made, by name."""
    folder = scene.root / "prior"
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def kept(scene: Scene) -> set[str]:
    return {path.stem for path in resume.kept_files(scene)}


@pytest.fixture(scope="module")
def whole(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene matched without interruption; tests must leave its files alone."""
    scene = copied(hamlet_source, tmp_path_factory.mktemp("whole") / "HAMLET")
    with pytest.MonkeyPatch.context() as change:
        cut_small(change)
        return api.match(scene, GIVEN)


@pytest.fixture(scope="module")
def begun_source(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene, two of whose tiles are matched; tests must leave its files alone."""
    scene = copied(hamlet_source, tmp_path_factory.mktemp("begun") / "HAMLET")
    with pytest.MonkeyPatch.context() as change:
        cut_small(change)
        return interrupted(scene)


@pytest.fixture
def begun(begun_source: Scene, tmp_path: Path) -> Scene:
    """A copy of it."""
    return copied(begun_source, tmp_path / "BEGUN")


def test_an_interrupted_matching_goes_on_and_leaves_what_one_without_interruption_leaves(
    begun: Scene, whole: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    assert kept(begun) == {"r0c0", "r0c1"}
    interrupted(begun, "tile 4 of 4")  # once more
    assert kept(begun) == {"r0c0", "r0c1", "r1c0"}
    caplog.clear()
    assert matched_of(begun) == 1
    assert "goes on with 3 of 4 tiles that are matched" in caplog.text
    assert files(begun) == files(whole)
    assert not (begun.root / "prior/tiles").exists()
    found, expected = (Scene.from_file(one.root / "scene.json").history[-1] for one in (begun, whole))
    assert found["prior"] == expected["prior"]
    assert found["notes"] == expected["notes"]


def test_a_matching_that_is_interrupted_at_its_very_end_has_no_tile_to_do_again(begun: Scene, whole: Scene) -> None:
    interrupted(begun, "writing")
    assert not (begun.root / "prior/dsm.tif").exists()
    assert matched_of(begun) == 0
    assert files(begun) == files(whole)


def test_a_tile_where_nothing_was_matched_is_kept_as_such(make_hamlet: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ids = [item.id for item in make_hamlet().train_items()]
    seen = tiled._unseen
    monkeypatch.setattr(tiled, "_unseen", lambda *args: {**seen(*args), "r0c0": set(ids[1:])})  # one image shows it
    scene, at_once = interrupted(make_hamlet("CUT"), "tile 2 of 4"), make_hamlet("WHOLE")
    assert kept(scene) == {"r0c0"}
    assert matched_of(scene) == 3
    matched_of(at_once)
    assert files(scene) == files(at_once)


@pytest.mark.parametrize(
    ("options", "matched"),
    [
        (replace(GIVEN, small_jump=0.3), 4),
        (replace(GIVEN, pairs=5), 4),
        (replace(GIVEN, water="keep"), 2),  # water is laid level when all tiles are there
        (replace(GIVEN, per_image=True), 2),
    ],
)
def test_tiles_of_other_options_are_matched_anew(begun: Scene, options: PriorOptions, matched: int) -> None:
    assert matched_of(begun, options) == matched
    assert not (begun.root / "prior/tiles").exists()


def test_tiles_of_other_images_cameras_or_of_another_version_are_matched_anew(
    begun_source: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begun(name: str) -> Scene:
        return copied(begun_source, tmp_path / name)

    def asset(scene: Scene, name: str) -> Path:
        return scene.path(scene.train_items()[0].assets[name].href)

    image, camera, date, grid, version = map(begun, ("IMAGE", "CAMERA", "DATE", "GRID", "VERSION"))
    for path in (asset(image, "image"), asset(camera, "rpc")):
        path.write_bytes(path.read_bytes() + b"\n")  # which its readers do not mind
    date.train_items()[0].properties["datetime"] = "2020-02-02T10:30:00Z"
    date.write()
    grid.grid = grid.require_grid().part(slice(0, 62), slice(0, 64))
    grid.write()
    assert [matched_of(one) for one in (image, camera, date, grid)] == [4, 4, 4, 4]
    monkeypatch.setattr(resume, "__version__", "99.0")
    assert matched_of(version) == 4


def test_overwriting_begins_anew(begun: Scene) -> None:
    interrupted(begun, "tile 1 of 4", overwrite=True)
    assert kept(begun) == set()
    assert matched_of(begun) == 4


def test_what_was_begun_to_replace_a_finished_surface_goes_on_without_a_further_word(
    whole: Scene, tmp_path: Path
) -> None:
    scene, other = copied(whole, tmp_path / "SCENE"), replace(GIVEN, small_jump=0.3)
    before = files(scene)
    with pytest.raises(OutputExistsError):
        api.match(scene, other)
    interrupted(scene, options=other, overwrite=True)
    assert {name: data for name, data in files(scene).items() if not name.startswith("tiles/")} == before
    with pytest.raises(OutputExistsError):  # these options were not begun
        api.match(scene, GIVEN)
    assert matched_of(scene, other) == 2
    assert files(scene).keys() == before.keys()
    with pytest.raises(OutputExistsError):  # it is finished
        api.match(scene, other)


def test_what_was_made_of_the_surface_that_is_replaced_is_not_in_the_way_of_going_on(
    whole: Scene, tmp_path: Path
) -> None:
    scene, other = copied(whole, tmp_path / "SCENE"), replace(GIVEN, small_jump=0.3)
    for item in scene.train_items():
        item.assets["shadow"] = item.assets["depth"] = item.assets["image"]
        item.properties[FIT_ROLE] = "train"
    scene.write()
    interrupted(scene, options=other, overwrite=True)
    assert kept(scene) == {"r0c0", "r0c1"}
    assert matched_of(scene, other) == 2


@pytest.mark.parametrize("data", [b"", b"somebody's", None])
def test_a_damaged_tile_is_matched_anew(begun: Scene, whole: Scene, data: bytes | None) -> None:
    path = begun.root / "prior/tiles/r0c0.npz"
    whole_tile = path.read_bytes()
    middle = len(whole_tile) // 2
    flipped = whole_tile[:middle] + bytes([whole_tile[middle] ^ 1]) + whole_tile[middle + 1 :]
    path.write_bytes(flipped if data is None else data)
    assert matched_of(begun) == 3
    assert files(begun) == files(whole)


def test_tiles_go_on_as_they_were_begun_where_there_is_memory_for_more_by_now(
    begun: Scene, whole: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiled, "AT_ONCE", 1 << 20)
    assert matched_of(begun) == 2
    assert files(begun) == files(whole)


def test_tiles_of_a_size_that_does_not_fit_any_more_are_matched_anew(
    begun: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiled, "SMALLER_CELLS", (40,))
    monkeypatch.setattr(foresight, "available", lambda: 1.0)
    monkeypatch.setattr(foresight, "to_spend", lambda: 1.0)
    monkeypatch.setattr("sattools.prior.stage.check_fits", lambda *_: None)
    assert matched_of(begun) == 6
    assert not (begun.root / "prior/tiles").exists()


def test_a_dry_run_says_how_many_tiles_are_matched_and_what_is_left(begun: Scene, hamlet_source: Scene) -> None:
    check_start(Scene.from_file(begun.root / "scene.json"), GIVEN, overwrite=False)
    assert "in 4 tiles (2 of them matched before)" in of_prior(GIVEN, overwrite=False)(begun)
    assert "in 4 tiles:" in of_prior(GIVEN, overwrite=True)(begun)
    left, all_of_it = (foresee_matching(begun, GIVEN, overwrite).cpu_s for overwrite in (False, True))
    assert left - START_S == pytest.approx((all_of_it - START_S) / 2)


def test_tiles_stay_until_the_document_names_the_surface(
    begun: Scene, whole: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(scene: Scene) -> Path:
        raise SattoolsError("scene.json: cannot be written (No space left on device)")

    with monkeypatch.context() as change:
        change.setattr(Scene, "write", fails)
        with pytest.raises(SattoolsError, match="No space left"):
            api.match(begun, GIVEN)
    assert len(kept(begun)) == 4
    assert matched_of(begun) == 0
    assert files(begun) == files(whole)


def test_files_of_other_origin_beside_tiles_stay(begun: Scene) -> None:
    own = begun.root / "prior/tiles/mine.npz"
    own.write_text("somebody's")
    matched_of(begun)
    assert [path.name for path in (begun.root / "prior/tiles").iterdir()] == ["mine.npz"]


def test_no_tile_is_read_or_removed_behind_a_link_that_leads_out_of_the_scene(make_hamlet: Any, tmp_path: Path) -> None:
    scene = make_hamlet()
    (scene.root / "prior").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/r0c0.npz").write_text("somebody's")
    (scene.root / "prior/tiles").symlink_to(tmp_path / "other")
    for flag in (True, False):
        with pytest.raises(SceneError, match="leads outside the scene's root"):
            api.match(scene, GIVEN, overwrite=flag)
    assert (tmp_path / "other/r0c0.npz").read_text() == "somebody's"


def test_an_interrupted_fit_goes_on_with_the_tiles_of_the_surface_that_it_makes_itself(
    make_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a fit matches all at once what memory there is for
    for name, value in {"available": lambda: 1.0, "to_spend": lambda: 1e12, "COMMON_BYTES": 0.0}.items():
        monkeypatch.setattr(foresight, name, value)
    options = FitOptions(resolution=2.0, epochs=[1])
    for name, flags, left in (("PLAIN", {}, 2), ("RESUMED", {"resume": True}, 2), ("ANEW", {"overwrite": True}, 4)):
        scene = make_hamlet(name)
        overwrite = flags.pop("overwrite", False)
        with pytest.raises(Interrupted):
            api.fit(scene, options, progress=until("tile 3 of 4")[1])
        assert len(kept(scene)) == 2
        said, progress = until()
        api.fit(scene, replace(options, **flags), progress=progress, overwrite=overwrite)
        assert said.count("rough pass 1 of 5") == left
        assert kept(scene) == set()


def test_tiles_of_a_part_of_a_fit_are_removed_with_it(make_hamlet: Any, tmp_path: Path) -> None:
    scene = make_hamlet()
    for name in ("r0c1/prior/tiles/r0c0.npz", "r0c1/prior/tiles/mine.txt"):
        (scene.root / "fit/tiles" / name).parent.mkdir(parents=True, exist_ok=True)
        (scene.root / "fit/tiles" / name).write_text("")
    remove_parts(scene.root)
    left = [path.name for path in (scene.root / "fit/tiles").rglob("*") if path.is_file()]
    assert left == ["mine.txt"]


def test_an_interrupted_command_says_how_to_go_on(begun: Scene, make_hamlet: Any) -> None:
    assert resume.how_to_go_on(make_hamlet("NONE")) is None
    assert resume.how_to_go_on(begun) == (
        "interrupted; kept 2 tiles: `sattools prior` with the same options goes on with them, with --overwrite it "
        "begins anew"
    )

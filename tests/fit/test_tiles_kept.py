"""What a fit in tiles has made, and what lies beside it, is removed only where that is asked for."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from in_tiles import TILED, Interrupted, until
from towns import copied

from sattools import api
from sattools.errors import OutputExistsError, SattoolsError, SceneError
from sattools.fit.stage import check_start, fit
from sattools.scene import Scene


def test_finished_tiles_are_removed_only_where_that_is_asked_for(begun_tiles: Scene, tmp_path: Path) -> None:
    """A call from the history of a shell, without --resume, would cost hours of an area that was nearly done."""
    scene = copied(begun_tiles, tmp_path / "NEARLY")
    for begin in (check_start, fit):
        with pytest.raises(
            OutputExistsError, match=r"r0c0: found a finished tile .* give --resume to go on, or --over"
        ):
            begin(scene, TILED, overwrite=False)
    assert (scene.root / "fit/tiles/r0c0/fit/model.safetensors").exists()
    check_start(scene, TILED, overwrite=True)
    check_start(scene, replace(TILED, resume=True), overwrite=False)


def test_what_was_begun_all_at_once_does_not_go_on_in_tiles(make_matched_hamlet: Any) -> None:
    """At its end the checkpoint would go."""
    scene = make_matched_hamlet()
    with pytest.raises(Interrupted):
        fit(scene, replace(TILED, tile=None), until("epoch 6")[1])
    for begin in (check_start, fit):
        with pytest.raises(SceneError, match="found a checkpoint of a fit all at once, expected one in tiles; give"):
            begin(Scene.from_file(scene.root / "scene.json"), replace(TILED, resume=True))
    assert (scene.root / "fit/checkpoint.safetensors").exists()


@pytest.mark.parametrize("flags", [{}, {"resume": True}])
@pytest.mark.parametrize(
    "name", ["scene.json", "tiles.json", "common.safetensors", "r0c1/scene.json", "coarse/fit/trace.csv"]
)
def test_files_of_other_origin_in_the_place_of_tiles_are_replaced_only_where_that_is_asked_for(
    make_hamlet: Any, name: str, flags: Any
) -> None:
    scene = make_hamlet()
    path = scene.root / "fit/tiles" / name
    path.parent.mkdir(parents=True)
    path.write_text("somebody's")
    for begin in (check_start, fit):
        with pytest.raises(
            SattoolsError, match=rf"fit/tiles/{name}: (exists already; give --overwrite|found text that)"
        ):
            begin(scene, replace(TILED, **flags), overwrite=False)
    assert path.read_text() == "somebody's"


def test_what_is_no_tile_stays_beside_tiles_and_in_them(make_matched_row: Any) -> None:
    scene = make_matched_row()
    own = {"notes.txt", "sketches/r0c0.svg", "r0c1/mine.txt", "r0c1/fit/mine.csv", "r9c9.bak/scene.json"}

    def put(share: float, message: str) -> None:
        if message.startswith("tile 2"):
            for name in own:
                (scene.root / "fit/tiles" / name).parent.mkdir(parents=True, exist_ok=True)
                (scene.root / "fit/tiles" / name).write_text("somebody's")

    def left() -> set[str]:
        folder = scene.root / "fit/tiles"
        return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}

    given = replace(TILED, epochs=[2], prior_weight=0.2)
    fit(scene, given, put)
    assert left() == own
    fit(scene, given)  # which begins by removing tiles
    assert left() == own
    assert {(scene.root / "fit/tiles" / name).read_text() for name in own} == {"somebody's"}


def test_nothing_is_removed_behind_a_link_that_leads_out_of_the_scene(make_hamlet: Any, tmp_path: Path) -> None:
    scene = make_hamlet()
    (scene.root / "fit").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/scene.json").write_text("somebody's")
    (scene.root / "fit/tiles").symlink_to(tmp_path / "other")
    with pytest.raises(SceneError, match="leads outside the scene's root"):
        fit(scene, replace(TILED, epochs=[2]))
    assert (tmp_path / "other/scene.json").read_text() == "somebody's"


def test_tiles_stay_until_the_document_names_what_they_were_joined_to(
    finished_tiles: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, write, given = copied(finished_tiles, tmp_path / "NEARLY"), Scene.write, replace(TILED, resume=True)

    def fails(scene: Scene) -> Path:
        if scene.id != "NEARLY":
            return write(scene)
        raise SattoolsError("scene.json: cannot be written (No space left on device)")

    monkeypatch.setattr(Scene, "write", fails)
    with pytest.raises(SattoolsError, match="No space left"):
        api.fit(scene, given)
    monkeypatch.setattr(Scene, "write", write)
    said, progress = until()
    api.fit(scene.root / "scene.json", given, progress=progress)
    assert [text for _, text in said if "epoch" in text] == []
    assert not (scene.root / "fit/tiles").exists()


@pytest.mark.parametrize("last", [{"tile": 0.0}, {"part": "mosaic"}])
def test_tiles_that_are_left_are_no_reason_to_replace_a_finished_fit(
    finished_tiles: Scene, tmp_path: Path, last: Any
) -> None:
    scene = copied(finished_tiles, tmp_path / "LEFT")
    fit(scene, replace(TILED, **last))
    before = (scene.root / "fit/model.safetensors").read_bytes()
    for size in (None, 16.0, 0.0):
        with pytest.raises(OutputExistsError, match="found a finished fit, expected an interrupted one for --resume"):
            fit(scene, replace(TILED, tile=size, resume=True), overwrite=False)
    assert (scene.root / "fit/model.safetensors").read_bytes() == before

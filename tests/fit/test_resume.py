"""A fit that was interrupted at any moment ends as one that was not, bit for bit."""

import json
import random
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import torch
from click.testing import CliRunner
from towns import copied

from sattools import api
from sattools.camera import RPC
from sattools.cli import main
from sattools.errors import InputError, OutputExistsError, SattoolsError, SceneError
from sattools.fit import whole as whole_fit
from sattools.fit.checkpoint import load, save
from sattools.fit.options import FitOptions
from sattools.fit.resume import Interrupted as Checkpoint
from sattools.fit.resume import how_to_go_on
from sattools.fit.stage import check_start, fit
from sattools.scene import Scene
from sattools.scene.dependencies import check_current
from sattools.scene.raster import write_cog

SHORT = FitOptions(resolution=2.0, coarsest=4.0, epochs=[10, 9], prior_weight=0.0)
FLAGS = ["--resolution", "2", "--coarsest", "4", "--epochs", "10", "--epochs", "9", "--prior-weight", "0"]
# so long that it is killed before its end
LONGER = ["--resolution", "2", "--coarsest", "4", "--epochs", "30", "--epochs", "30", "--prior-weight", "0"]


class Interrupted(Exception):
    """Stands for whatever ends a process."""


def model(scene: Scene) -> dict[str, torch.Tensor]:
    return load(scene.root / "fit/model.safetensors")[0]


def interrupt_after(calls: int) -> Any:
    def progress(fraction: float, message: str) -> None:
        nonlocal calls
        calls -= 1
        if calls < 0:
            raise Interrupted

    return progress


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


@pytest.fixture(scope="module")
def fitted(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene fitted without interruption; tests must leave its files alone."""
    scene = copied(hamlet_source, tmp_path_factory.mktemp("fitted") / "HAMLET")
    fit(scene, SHORT)
    return scene


@pytest.fixture(scope="module")
def whole(fitted: Scene) -> dict[str, torch.Tensor]:
    return model(fitted)


@pytest.fixture(scope="module")
def begun_source(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene whose fit was interrupted; tests must leave its files alone."""
    scene = copied(hamlet_source, tmp_path_factory.mktemp("begun") / "HAMLET")
    with pytest.raises(Interrupted):
        fit(scene, SHORT, interrupt_after(6))
    return scene


@pytest.fixture
def begun(begun_source: Scene, tmp_path: Path) -> Scene:
    """A copy of the interrupted fit."""
    return copied(begun_source, tmp_path / "BEGUN")


def test_the_same_seed_gives_the_same_model_and_another_seed_does_not(whole: Any, make_hamlet: Any) -> None:
    again, other = make_hamlet("AGAIN"), make_hamlet("OTHER")
    fit(again, SHORT)
    fit(other, replace(SHORT, seed=1))
    assert_same(model(again), whole)
    assert not torch.equal(model(other)["height"], whole["height"])


def test_interrupted_anywhere_and_resumed(whole: Any, make_hamlet: Any) -> None:
    """In the first stage before and after a checkpoint, between the stages, in the second, and twice in a row."""
    for number, calls in enumerate([(2,), (5,), (10,), (16,), (6, 3, 8)]):
        scene = make_hamlet(f"CUT{number}")
        for count in calls:
            with pytest.raises(Interrupted):
                fit(scene, replace(SHORT, resume=True), interrupt_after(count))
        fit(scene, replace(SHORT, resume=True))
        assert_same(model(scene), whole)
        assert not (scene.root / "fit/checkpoint.safetensors").exists()
        rows = (scene.root / "fit/trace.csv").read_text().splitlines()
        assert len(rows) == 1 + 10 + 9


def test_a_resumed_fit_tells_why_its_light_was_chosen(make_hamlet: Any) -> None:
    options = replace(SHORT, shadow="auto", transient="auto")
    notes = fit(make_hamlet("TOLD"), options)["notes"]
    scene = make_hamlet("CUT_TOLD")
    with pytest.raises(Interrupted):
        fit(scene, options, interrupt_after(6))
    assert any(note.startswith("shadow ") for note in notes)
    assert fit(scene, replace(options, resume=True))["notes"] == notes


def test_killed_at_a_random_moment_and_resumed(make_hamlet: Any) -> None:
    reference, scene = make_hamlet("WHOLE"), make_hamlet("KILLED")
    command = ["--threads", "1", "--progress", "json", "fit", *LONGER]
    done = CliRunner().invoke(main, [*command, str(reference.root / "scene.json")])
    records = len(done.stderr.splitlines())
    process = subprocess.Popen(
        [sys.executable, "-m", "sattools", *command, str(scene.root / "scene.json")],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    assert process.stderr is not None
    for _ in range(random.Random(0).randrange(3, records // 2)):
        process.stderr.readline()
    process.kill()
    process.stderr.close()
    assert process.wait() in (-9, 0)  # 0: a machine so busy that the fit was done before it was killed
    if "model" not in Scene.from_file(scene.root / "scene.json").products:
        assert CliRunner().invoke(main, [*command, "--resume", str(scene.root / "scene.json")]).exit_code == 0
    assert_same(model(scene), model(reference))
    assert json.loads((scene.root / "scene.json").read_text())["sattools"]["history"][-1]["command"] == "fit"


def test_resuming_with_other_options_is_refused(begun: Scene) -> None:
    why = r"fit/checkpoint\.safetensors: found a checkpoint of other options \(--seed 0\), expected --seed 3; give"
    with pytest.raises(SceneError, match=why):
        fit(begun, replace(SHORT, resume=True, seed=3))


def test_an_interrupted_fit_is_given_up_only_where_that_is_asked_for(whole: Any, begun: Scene) -> None:
    """A call from the history of a shell, without --resume, would cost hours of a fit that was nearly done."""
    path = begun.root / "fit/checkpoint.safetensors"
    before = path.read_bytes()
    said = r"found an interrupted fit after \d+ s \(4 m, epoch 4\); give --resume to go on, or --overwrite to fit anew"
    for options in (SHORT, replace(SHORT, seed=1), replace(SHORT, tile=32.0, overlap=4.0)):
        for begin in (check_start, fit):
            with pytest.raises(OutputExistsError, match=rf"fit/checkpoint\.safetensors: {said}"):
                begin(begun, options, overwrite=False)
    assert path.read_bytes() == before
    check_start(begun, SHORT, overwrite=True)
    check_start(begun, replace(SHORT, resume=True), overwrite=False)
    api.fit(begun, replace(SHORT, resume=True))
    assert_same(model(begun), whole)


@pytest.mark.parametrize("dry", [["--dry-run"], []])
def test_what_is_refused_for_its_checkpoint_is_told_before_images_are_read(
    begun: Scene, make_hamlet: Any, dry: list[str]
) -> None:
    """Of scenes on a pipe it costs the others nothing."""
    other = make_hamlet("OTHER")
    shutil.rmtree(begun.root / "images")
    before = (begun.root / "fit/checkpoint.safetensors").read_bytes()
    text = "".join((scene.root / "scene.json").read_text() for scene in (begun, other))
    text = text.replace('"root":"."', f'"root":"{begun.root}"', 1).replace('"root":"."', f'"root":"{other.root}"')
    result = CliRunner().invoke(main, ["--threads", "1", "fit", *FLAGS, *dry], input=text)
    assert result.exit_code == 3
    (line,) = [line for line in result.stderr.splitlines() if "error:" in line]
    assert "BEGUN/fit/checkpoint.safetensors: found an interrupted fit" in line
    assert (begun.root / "fit/checkpoint.safetensors").read_bytes() == before
    assert "OTHER" in result.stdout


def test_a_file_in_the_place_of_a_checkpoint_is_replaced_only_where_that_is_asked_for(make_hamlet: Any) -> None:
    scene = make_hamlet()
    path = scene.root / "fit/checkpoint.safetensors"
    path.parent.mkdir()
    path.write_text("somebody's")
    with pytest.raises(OutputExistsError, match="found a file that is no checkpoint, or a damaged one; give --over"):
        fit(scene, SHORT, overwrite=False)
    assert path.read_text() == "somebody's"


def test_a_fit_that_is_interrupted_after_its_prior_leaves_the_one_before_as_it_was(make_row: Any) -> None:
    """The prior of other images had taken the place of that of which the old model was made."""
    scene, said = make_row(), []
    document, given = scene.root / "scene.json", replace(SHORT, prior_weight=0.2)
    api.fit(document, given)
    before = {path: path.read_bytes() for path in scene.root.rglob("*") if path.is_file() and path.suffix != ".log"}

    def progress(fraction: float, message: str) -> None:
        said.append(message)
        if "epoch 6" in message:
            raise Interrupted

    held = replace(given, holdout=[scene.items[1].id])
    with pytest.raises(Interrupted):
        api.fit(document, held, overwrite=True, progress=progress)
    assert "matched" in said
    assert {path: path.read_bytes() for path in before} == before
    assert not list(scene.root.rglob(".*tmp-sattools*"))
    again = api.fit(document, replace(held, resume=True))
    assert [list(entry["made"]) for entry in again.history] == [["prior", "fit"], ["prior", "fit"]]
    check_current(again, "fit")  # as `export` does
    whole = make_row("WHOLE")
    api.fit(whole, held)
    assert_same(model(scene), model(whole))


def shift_camera(scene: Scene) -> None:
    path = scene.path(scene.items[0].assets["rpc"].href)
    RPC.from_file(path).shifted(0.5, 0.0).write(path)


def darken(scene: Scene) -> None:
    with rasterio.open(scene.path(scene.items[0].assets["image"].href), "r+") as data:
        data.write((data.read() * 0.9).astype(data.dtypes[0]))


def test_resuming_with_another_image_is_refused(begun: Scene) -> None:
    """Its pixels are no more the same: known when they have been read."""
    darken(begun)
    with pytest.raises(SceneError, match="found a checkpoint of other options, images or cameras"):
        fit(begun, replace(SHORT, resume=True))


def another_height_range(scene: Scene) -> None:
    scene.height_range_m = (-40.0, 60.0)


def without_an_image(scene: Scene) -> None:
    del scene.items[0]


def another_sun(scene: Scene) -> None:
    scene.items[0].properties["view:sun_azimuth"] = 99.0


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (shift_camera, "other cameras"),
        (another_sun, "other suns"),
        (another_height_range, "other height ranges"),
        (without_an_image, "other images"),
    ],
)
def test_a_checkpoint_of_another_scene_is_refused_before_an_image_is_read(
    begun: Scene, monkeypatch: pytest.MonkeyPatch, change: Any, why: str
) -> None:
    change(begun)
    monkeypatch.setattr(whole_fit, "load_sources", lambda *_: pytest.fail("an image was read"))
    for begin in (check_start, fit):
        with pytest.raises(
            SceneError, match=f"found a checkpoint of {why}, expected the same; give --overwrite in place of --resume"
        ):
            begin(begun, replace(SHORT, resume=True))


def test_a_checkpoint_of_an_earlier_version_is_told_by_the_option_that_it_lacks(begun: Scene) -> None:
    tensors, description = load(begun.root / "fit/checkpoint.safetensors")
    del description["basis"]["--precision"]
    save(begun.root / "fit/checkpoint.safetensors", tensors, description)
    with pytest.raises(SceneError, match="found a checkpoint of an earlier version, without --precision, expected"):
        check_start(begun, replace(SHORT, resume=True))


def test_resuming_on_another_prior_is_refused(make_hamlet: Any) -> None:
    scene = make_hamlet()
    with_prior = replace(SHORT, prior_weight=1.0)
    shutil.copy(scene.path(scene.products["truth_dsm"]), scene.root / "prior.tif")
    write_cog(scene.root / "sure.tif", np.ones(scene.require_grid().shape), scene.require_grid())
    scene.products |= {"prior_dsm": "prior.tif", "prior_confidence": "sure.tif"}
    with pytest.raises(Interrupted):
        fit(scene, with_prior, interrupt_after(6))
    write_cog(scene.root / "sure.tif", np.full(scene.require_grid().shape, 0.5), scene.require_grid())
    with pytest.raises(SceneError, match="found a checkpoint of other options, images or cameras"):
        fit(scene, replace(with_prior, resume=True))


def test_a_finished_fit_is_not_resumed_but_fitted_anew_when_asked(fitted: Scene, tmp_path: Path) -> None:
    scene = copied(fitted, tmp_path / "AGAIN")
    with pytest.raises(OutputExistsError, match=r"found a finished fit, expected an interrupted one for --resume"):
        fit(scene, replace(SHORT, resume=True), overwrite=False)
    fit(scene, replace(SHORT, resume=True), overwrite=True)
    assert_same(model(scene), model(fitted))


def test_a_fit_that_ended_before_it_was_noted_is_resumed(fitted: Scene, make_hamlet: Any) -> None:
    """Killed between the model and the scene's document, which then names no model."""
    scene = make_hamlet("AGAIN")
    shutil.copytree(fitted.root / "fit", scene.root / "fit")
    with pytest.raises(OutputExistsError):
        fit(scene, SHORT, overwrite=False)
    fit(scene, replace(SHORT, resume=True), overwrite=False)
    assert_same(model(scene), model(fitted))


def test_a_finished_fit_that_is_out_of_date_is_replaced_only_where_that_is_asked_for(make_hamlet: Any) -> None:
    """`normalise` has put it out of date, so that the document names its model no more; there is nothing to resume."""
    scene = api.normalise(api.fit(make_hamlet(), SHORT))
    before = (scene.root / "fit/model.safetensors").read_bytes()
    with pytest.raises(OutputExistsError, match=r"fit/model.safetensors: exists already; give overwrite=True"):
        api.fit(scene, replace(SHORT, resume=True))
    assert (scene.root / "fit/model.safetensors").read_bytes() == before
    api.fit(scene, replace(SHORT, resume=True, seed=1), overwrite=True)
    assert (scene.root / "fit/model.safetensors").read_bytes() != before


def test_a_fit_whose_end_cannot_be_noted_is_not_lost(
    whole: Any, make_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its checkpoint is there until the document names the model, and the little that is left is done again."""
    scene, write = make_hamlet("AGAIN"), Scene.write

    def fails(scene: Scene) -> Path:
        raise SattoolsError("scene.json: cannot be written (No space left on device)")

    monkeypatch.setattr(Scene, "write", fails)
    with pytest.raises(SattoolsError, match="No space left"):
        api.fit(scene, SHORT)
    monkeypatch.setattr(Scene, "write", write)
    assert (scene.root / "fit/checkpoint.safetensors").exists()
    said: list[str] = []
    again = api.fit(scene.root / "scene.json", replace(SHORT, resume=True), progress=lambda _, text: said.append(text))
    assert not any("epoch 1 of" in text for text in said)
    assert again.products["model"] == "fit/model.safetensors"
    assert not (scene.root / "fit/checkpoint.safetensors").exists()
    assert_same(model(again), whole)


@pytest.mark.parametrize("place", [0.3, 0.6, 0.9])
def test_a_flipped_byte_in_a_checkpoint_is_noticed(begun: Scene, place: Any) -> None:
    path = begun.root / "fit/checkpoint.safetensors"
    data = bytearray(path.read_bytes())
    tensors = 8 + int.from_bytes(data[:8], "little")  # behind the header, whose length stands in eight bytes
    data[tensors + int(place * (len(data) - tensors))] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"checkpoint\.safetensors: found other content than was written"):
        fit(begun, replace(SHORT, resume=True))


def test_tensors_of_another_type_in_a_checkpoint_are_noticed(begun: Scene) -> None:
    from safetensors import safe_open
    from safetensors.torch import save_file

    path = begun.root / "fit/checkpoint.safetensors"
    with safe_open(path, framework="pt") as file:
        about, tensors = file.metadata(), {k: file.get_tensor(k).double() for k in file.keys()}  # noqa: SIM118
    save_file(tensors, path, metadata=about)
    with pytest.raises(InputError, match="found other content than was written"):
        fit(begun, replace(SHORT, resume=True))


def test_a_damaged_checkpoint_is_named(begun: Scene) -> None:
    path = begun.root / "fit/checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match=r"checkpoint\.safetensors: found no sattools model"):
        fit(begun, replace(SHORT, resume=True))


def test_a_model_file_survives_a_round_trip_and_others_are_refused(tmp_path: Path) -> None:
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "step": torch.tensor(3)}
    save(tmp_path / "m", tensors, {"grid": {"left": 0.1}})
    found, meta = load(tmp_path / "m")
    assert_same(found, tensors)
    assert meta == {"grid": {"left": 0.1}}
    with pytest.raises(InputError, match="no such file"):
        load(tmp_path / "none")
    (tmp_path / "text").write_text("text")
    with pytest.raises(InputError, match="found no sattools model"):
        load(tmp_path / "text")


def test_an_interruption_is_told_how_far_it_came_where_it_leaves_a_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    assert how_to_go_on(path, 0.0, 2000) is None
    rows: list[Any] = [{"seconds": 12.0, "step": 400, "loss": 0.1}]
    Checkpoint({"a": torch.zeros(1)}, "key", rows, step=400).save(path)
    assert how_to_go_on(path, path.stat().st_mtime + 1, 2000) is None  # of an earlier fit
    words = how_to_go_on(path, path.stat().st_mtime - 1, 2000)
    assert words is not None
    assert words.startswith("interrupted; kept after 12 s (step 400 of 2000): `sattools fit --resume` ")
    path.write_bytes(b"half")
    assert how_to_go_on(path, 0.0, 2000) is None

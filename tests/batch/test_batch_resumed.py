"""A task of a batch that was ended in its midst goes on with what it has done, and ends as one that was not."""

import json
from pathlib import Path
from typing import Any

import pytest
from done_here import Here
from towns import copied

from sattools.batch.configuration import Configuration
from sattools.batch.options import BatchOptions
from sattools.batch.queue import make_plan
from sattools.batch.task import perform
from sattools.batch.work import Task
from sattools.cli import pipe
from sattools.prior import tiled
from sattools.progress import Progress, make_progress
from sattools.scene import Scene

TABLES = {"prior": {"rough_passes": 1, "pairs": 6}, "fit": {"resolution": 2.0, "coarsest": 4.0, "epochs": [10, 9]}}
MEASURED = {"seconds", "prior_s", "fit_s", "export_s", "peak_memory_mb"}  # differ from run to run


def task_of(scene: Scene, out: Path, tables: Any = None) -> Task:
    configuration = Configuration("quick", TABLES if tables is None else tables, TABLES if tables is None else tables)
    (job,) = make_plan(BatchOptions(out=str(out)), [scene], [configuration]).jobs
    return job.task


def ended_at(task: Task, word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Do a task, and end its command as soon as that tells this word."""

    def made(*args: Any) -> Progress:
        progress = make_progress(*args)

        def told(fraction: float, message: str) -> None:
            progress(fraction, message)
            if word in message:
                raise SystemExit(143)

        return told

    with monkeypatch.context() as change:
        change.setattr(pipe, "make_progress", made)
        assert performed(task)["status"] == "failed"


def performed(task: Task) -> Any:
    return perform(task, 1, None, lambda *_: None, launcher=Here())


def commands(task: Task) -> list[list[str]]:
    """Those that were begun: the name, and what says how they begin."""
    lines = (Path(task.folder) / "log.txt").read_text().splitlines()
    calls = [line.split()[6:] for line in lines if line.startswith("$ ")]
    return [[part for part in call if part in (call[0], "--overwrite", "--resume")] for call in calls]


@pytest.fixture(scope="module")
def in_peace(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The row of the small scene."""
    root = tmp_path_factory.mktemp("peace")
    result = performed(task_of(copied(hamlet_source, root / "HAMLET"), root / "out"))
    assert result["status"] == "done"
    return result["row"]


def test_a_fit_that_was_ended_goes_on_and_the_prior_before_it_is_not_made_again(
    make_hamlet: Any, in_peace: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(make_hamlet(), tmp_path / "out")
    ended_at(task, "epoch 7", monkeypatch)
    assert (Path(task.folder) / "fit/checkpoint.safetensors").exists()
    row = performed(task)["row"]
    assert commands(task) == [
        ["prior", "--overwrite"],
        ["fit", "--overwrite"],
        ["fit", "--overwrite", "--resume"],
        ["export", "--overwrite"],
        ["compare", "--overwrite"],
    ]
    assert {k: v for k, v in row.items() if k not in MEASURED} == {
        k: v for k, v in in_peace.items() if k not in MEASURED
    }
    entry = next(e for e in Scene.from_file(task.document).history if e["command"] == "fit")
    assert entry["earlier_seconds"] > 0
    assert row["fit_s"] == pytest.approx(entry["seconds"] + entry["earlier_seconds"], abs=2e-3)
    assert not task.begun.exists()


def test_a_prior_that_was_ended_goes_on_with_the_tiles_that_are_matched(
    make_hamlet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"AT_ONCE": 1000, "TILE_CELLS": 56, "OVERLAP_M": 6.0, "OVERLAP_CELLS": 8}.items():
        monkeypatch.setattr(tiled, name, value)
    task = task_of(make_hamlet(), tmp_path / "out")
    folder = Path(task.folder)
    ended_at(task, "tile 3 of 4", monkeypatch)
    assert len(list((folder / "prior/tiles").iterdir())) == 2
    row = performed(task)["row"]
    assert commands(task)[:3] == [["prior", "--overwrite"], ["prior"], ["fit", "--overwrite"]]
    entry = next(e for e in Scene.from_file(task.document).history if e["command"] == "prior")
    assert row["prior_s"] == pytest.approx(entry["seconds"] + entry["earlier_seconds"], abs=2e-3)
    assert entry["earlier_seconds"] > 0
    assert not (folder / "prior/tiles").exists()
    assert "goes on with 2 of 4 tiles that are matched" in (folder / "log.txt").read_text()


def test_what_was_begun_with_other_options_is_begun_anew(
    make_hamlet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_hamlet()
    ended_at(task_of(scene, tmp_path / "out"), "epoch 7", monkeypatch)
    other = task_of(scene, tmp_path / "out", {**TABLES, "fit": {**TABLES["fit"], "epochs": [9, 9]}})
    assert performed(other)["status"] == "done"
    assert commands(other)[2:4] == [["prior", "--overwrite"], ["fit", "--overwrite"]]


def test_a_batch_that_is_to_do_all_again_does_not_go_on(
    make_hamlet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_hamlet()
    task = task_of(scene, tmp_path / "out")
    ended_at(task, "epoch 7", monkeypatch)
    assert task.go_on() == 1
    configuration = Configuration("quick", TABLES, TABLES)
    make_plan(BatchOptions(out=str(tmp_path / "out")), [scene], [configuration], overwrite=True).forget()
    assert task.go_on() is None


@pytest.mark.parametrize("name", ["scene.json", "begun.json"])
def test_what_is_damaged_is_begun_anew(
    make_hamlet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    task = task_of(make_hamlet(), tmp_path / "out")
    ended_at(task, "epoch 7", monkeypatch)
    (Path(task.folder) / name).write_text("{}")
    assert task.go_on() is None


def test_what_fails_as_it_goes_on_is_begun_anew_by_the_next_run(
    make_hamlet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(make_hamlet(), tmp_path / "out")
    ended_at(task, "epoch 7", monkeypatch)
    (Path(task.folder) / "fit/checkpoint.safetensors").write_bytes(b"damaged")
    assert "checkpoint.safetensors" in performed(task)["error"]
    assert performed(task)["status"] == "done"
    assert commands(task)[3:5] == [["prior", "--overwrite"], ["fit", "--overwrite"]]


def test_a_history_of_other_commands_is_not_gone_on_with(
    make_hamlet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(make_hamlet(), tmp_path / "out")
    ended_at(task, "epoch 7", monkeypatch)
    content = json.loads(task.document.read_text())
    content["sattools"]["history"].append({"command": "align"})
    task.document.write_text(json.dumps(content))
    assert task.go_on() is None


def test_what_was_begun_alone_is_not_gone_on_with_once_its_prior_is_shared(
    make_hamlet: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It went on with the fit, on a document without that prior, and the fit made one with other options."""
    scene = make_hamlet()
    ended_at(task_of(scene, tmp_path / "out"), "reading images", monkeypatch)
    other = {**TABLES, "fit": {**TABLES["fit"], "epochs": [9, 9]}}
    both = [Configuration(name, tables, tables) for name, tables in (("quick", TABLES), ("other", other))]
    shared, quick, _ = (job.task for job in make_plan(BatchOptions(out=str(tmp_path / "out")), [scene], both).jobs)
    assert [performed(task)["status"] for task in (shared, quick)] == ["done", "done"]
    history = Scene.from_file(quick.document).history
    assert [entry["command"] for entry in history if entry["command"] in ("prior", "fit")] == ["prior", "fit"]

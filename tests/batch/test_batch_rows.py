"""What a row of a batch's table says of a scene."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from sattools.batch import queue, stage
from sattools.batch.configuration import Configuration, options_of
from sattools.batch.earlier import comparable_rows
from sattools.batch.options import BatchOptions
from sattools.batch.plan import Task
from sattools.batch.table import earlier_rows, make_row, to_csv, write_tables
from sattools.errors import SceneError
from sattools.progress import silent
from sattools.scene import Scene


def test_a_row_adds_up_what_the_steps_of_this_run_took(tmp_path: Path) -> None:
    scene = Scene("A", tmp_path)

    def done(command: str, seconds: float, memory_mb: float, **more: Any) -> None:
        about = {"seconds": seconds, "peak_memory_mb": memory_mb, "versions": {"sattools": "1", "torch": command}}
        scene.history.append({"command": command} | about | more)

    done("export", 500.0, 9000.0)  # of a fit that came before
    done("prep", 1.5, 100.0)
    done("fit", 10.0, 300.0, parts={"seconds": 30.25, "peak_memory_mb": 450.0})
    done("export", 2.0, 200.0)
    figures = {"mae": 1.25, "completeness": 0.5, "cells": 40, "classes": {"trees": {"mae": 2.5}}, "protocol": "p"}
    done("compare", 70.0, 8000.0, errors=figures)  # is not part of the work
    scene.write()
    row = make_row("A", "fast", tmp_path / "scene.json")
    took = {name: row.get(name) for name in ("prep_s", "normalise_s", "fit_s", "export_s", "seconds", "peak_memory_mb")}
    assert took == {
        "prep_s": 1.5, "normalise_s": None, "fit_s": 40.25, "export_s": 2.0, "seconds": 43.75, "peak_memory_mb": 450.0,
    }  # fmt: skip
    assert (row["status"], row["mae_m"], row["completeness"], row["cells"]) == ("done", 1.25, 0.5, 40)
    assert (row["trees_mae_m"], row["buildings_mae_m"], row["protocol"]) == (2.5, None, "p")
    assert (row["sattools"], row["torch"]) == ("1", "export")
    assert row["fit_prior_s"] is None
    # a fit that has come after them is all that counts of the surface, and there is no score of it
    done("fit", 4.0, 50.0)
    scene.write()
    again = make_row("A", "fast", tmp_path / "scene.json")
    assert (again["seconds"], again["peak_memory_mb"], again["mae_m"]) == (5.5, 100.0, None)


@pytest.mark.parametrize(
    "entry",
    [
        {"seconds": 10.0, "prior_seconds": 6.5},
        {"seconds": 2.0, "parts": {"seconds": 8.0, "prior_seconds": 6.5, "peak_memory_mb": 1.0}},
    ],
)
def test_a_row_says_how_much_of_a_fit_went_into_its_prior(tmp_path: Path, entry: dict[str, Any]) -> None:
    """Beside a configuration whose `prior` went before, `fit_s` of one that makes its own is no measure of the fit."""
    scene = Scene("A", tmp_path)
    about = {"peak_memory_mb": 1.0, "versions": {}}
    scene.history = [{"command": "prep", "seconds": 1.0, **about}, {"command": "fit", **about, **entry}]
    scene.write()
    row = make_row("A", "fast", tmp_path / "scene.json")
    assert (row.get("prior_s"), row["fit_s"], row["fit_prior_s"]) == (None, 10.0, 6.5)
    assert row["seconds"] == 11.0
    assert "prior_s,fit_s,export_s,fit_prior_s,peak_memory_mb" in to_csv([row])


def written(out: Path, *rows: dict[str, Any]) -> None:
    for row in rows:
        (out / "runs" / row["configuration"] / row["scene"]).mkdir(parents=True, exist_ok=True)
    write_tables(rows, out)


def test_rows_of_earlier_calls_stay_in_the_table_as_long_as_their_runs_are_there(tmp_path: Path) -> None:
    one = {"scene": "A", "configuration": "fast", "status": "done", "mae_m": 1.25, "cells": 40, "torch": "2"}
    two = {"scene": "B", "configuration": "fast", "status": "failed", "error": "no, thanks"}
    gone = {"scene": "C", "configuration": "fast", "status": "done", "mae_m": 2.0}
    written(tmp_path, one, two, gone)
    (tmp_path / "runs/fast/C").rmdir()
    kept = earlier_rows(tmp_path, [("A", "slow")])
    assert [{name: value for name, value in row.items() if value is not None} for row in kept] == [one, two]
    # what this call does itself is not known from before
    assert [row["scene"] for row in earlier_rows(tmp_path, [("A", "fast")])] == ["B"]
    assert to_csv(kept) == to_csv([one, two])


def test_rows_of_other_options_under_the_same_name_are_told_and_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """They had stood beside the new ones as if they were of one configuration, in figures and reports, too."""
    rows = [{"scene": name, "configuration": "fast", "status": "done", "mae_m": 1.0} for name in ("A", "B", "C")]
    other = {"scene": "A", "configuration": "slow", "status": "done", "mae_m": 1.0}
    written(tmp_path, *rows, other)
    (tmp_path / "runs/fast/A/config.toml").write_text("[fit]\nseed = 3\nepochs = [ 4 ]\n")
    (tmp_path / "runs/fast/B/config.toml").write_text("[fit]\nepochs = [4]\nseed = 2\n")
    (tmp_path / "runs/slow/A/config.toml").write_text("[fit]\nseed = 7\n")
    now = Configuration("fast", {"fit": {"epochs": [4], "seed": 3}})
    kept = comparable_rows(tmp_path, [("D", "fast")], [now])
    # C does not say
    assert [(row["scene"], row["configuration"]) for row in kept] == [("A", "fast"), ("C", "fast"), ("A", "slow")]
    assert "fast: has other options than in an earlier call" in caplog.text
    assert "give B again, too" in caplog.text


def test_rows_stay_where_the_options_are_the_same_in_other_words(tmp_path: Path) -> None:
    """A default that a file begins to name, and `[prep]` of scenes that a batch was given, make no other result."""
    rows = [{"scene": name, "configuration": "fast", "status": "done", "mae_m": 1.0} for name in ("A", "B", "C", "D")]
    written(tmp_path, *rows)
    had = {"prep": {"copy": True}, "fit": {"epochs": [4], "seed": 0}}
    short = Configuration("fast", {"fit": {"epochs": [4]}}, had)
    other = Configuration("fast", {"fit": {"epochs": [4]}}, {**had, "prep": {"copy": False}})
    for name, configuration, prepared in (("A", short, False), ("B", short, True), ("C", other, True)):
        (tmp_path / f"runs/fast/{name}/config.toml").write_text("[fit]\nepochs = [4]\n")
        record = {"options": options_of(configuration, prepared)}
        (tmp_path / f"runs/fast/{name}/task.json").write_text(json.dumps(record))
    # of a version that noted neither
    (tmp_path / "runs/fast/D/config.toml").write_text("[fit]\nepochs = [4]\n")

    def kept(tables: Any, resolved: Any) -> list[str]:
        rows = comparable_rows(tmp_path, [("E", "fast")], [Configuration("fast", tables, resolved)])
        return [row["scene"] for row in rows]

    assert kept({"fit": {"epochs": [4], "seed": 0}}, had) == ["A", "B"]
    assert kept({"fit": {"epochs": [4]}}, {**had, "prep": {"copy": False}}) == ["A", "C", "D"]
    assert kept({"prep": {"copy": True}, "fit": {"epochs": [4]}}, had) == ["A", "B", "D"]
    assert kept({"fit": {"epochs": [4]}}, {**had, "fit": {"epochs": [4], "seed": 1}}) == ["D"]


@pytest.mark.parametrize("text", ["a,b\n1,2\n", "", "scene,configuration,status,mae_m\nA,fast,done,much\n", "\0"])
def test_a_table_of_other_origin_has_no_rows_to_keep(tmp_path: Path, text: str) -> None:
    (tmp_path / "runs/fast/A").mkdir(parents=True)
    (tmp_path / "table.csv").write_text(text)
    assert earlier_rows(tmp_path, []) == []


def test_a_second_batch_adds_its_rows_to_those_of_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its scenes fail here, as they have no images; what counts is the table."""
    for name in ("A", "B"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(stage, "run", lambda jobs, *rest: None)

    def fail(scene: Scene, digests: Any) -> None:
        raise SceneError(f"{scene.id} fails")

    options = BatchOptions(out=str(tmp_path / "out"))
    monkeypatch.setattr(queue, "scene_content", fail)
    written(tmp_path / "out", {"scene": "A", "configuration": "fast", "status": "done", "seconds": 2.5})
    (tmp_path / "out/digests.json").write_text("{}")
    for name in ("B", "B"):
        stage.batch(options, [Scene(name, tmp_path / name)], [Configuration("fast")], 1)
        with open(tmp_path / "out/table.csv", newline="", encoding="utf-8") as file:
            rows = [(row["scene"], row["status"], row["seconds"]) for row in csv.DictReader(file)]
        assert rows == [("B", "failed", ""), ("A", "done", "2.5")]


def test_the_table_has_a_finished_scene_whatever_becomes_of_stdout(tmp_path: Path, town_source: Scene) -> None:
    """`sattools batch | head -1` ends it there."""

    def emit(line: str) -> None:
        raise BrokenPipeError

    plan = queue.Batch(rows=[("TOWN", "fast"), ("B", "fast")])
    task = Task("TOWN/fast", str(tmp_path), "key", "TOWN", "fast", str(tmp_path), [], "")
    row = {"scene": "TOWN", "configuration": "fast", "status": "done"}
    result = {"status": "done", "scene_json": str(town_source.root / "scene.json"), "row": row}
    with pytest.raises(BrokenPipeError):
        stage._Running(plan, tmp_path, silent, emit).finished(task, result)
    assert (tmp_path / "table.csv").read_text().splitlines()[1].startswith("TOWN,fast,done")

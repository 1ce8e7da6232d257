"""Tiles fitted by several processes at a time are the same tiles; a process that is lost costs no more than its own."""

import io
import json
import logging
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from in_tiles import TILED
from patience import HANGING_S
from towns import copied

from sattools.cli.safety import explain
from sattools.errors import SattoolsError, SceneError
from sattools.fit.checkpoint import load
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.fit.tiles import crew, helper
from sattools.fit.tiles import plan as tile_plan
from sattools.scene import Scene

Towns = Callable[[str], Scene]


class Interrupted(Exception):
    """Stands for Ctrl-C."""


def model(scene: Scene) -> dict[str, torch.Tensor]:
    return load(scene.root / "fit/model.safetensors")[0]


def equal(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def noted(monkeypatch: pytest.MonkeyPatch, python_m: list[str]) -> list[subprocess.Popen]:
    """Two processes for four small tiles, which would not be worth it by themselves; those that were started."""
    found: list[subprocess.Popen] = []

    class Noted(subprocess.Popen):
        def __init__(self, command: list[str], **options: Any) -> None:
            assert command[:2] == [sys.executable, "-m"]
            super().__init__([*python_m, *command[2:]], **options)
            found.append(self)

    monkeypatch.setattr(crew.subprocess, "Popen", Noted)
    monkeypatch.setattr(tile_plan, "side_by_side", lambda scene, options, tiles: min(2, tiles))
    return found


@pytest.fixture
def really_started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen]:
    """As the command starts them."""
    return noted(monkeypatch, [sys.executable, "-m"])


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch, python_m: list[str]) -> list[subprocess.Popen]:
    """Without importing all anew."""
    return noted(monkeypatch, python_m)


@pytest.fixture(scope="module")
def expected(matched_hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    """The model of tiles that were fitted one after the other in this process."""
    scene = copied(matched_hamlet_source, tmp_path_factory.mktemp("one") / "HAMLET")
    fit(scene, TILED)
    return model(scene)


def test_the_surface_is_the_same_to_the_bit(make_row: Towns, really_started: list[subprocess.Popen]) -> None:
    """Every tile is matched first, and each process has one; `expected` is of processes that have two."""
    scene, said = make_row("TWO"), []
    fit(scene, TILED, lambda share, message: said.append((share, message)))
    assert len(really_started) == 2
    assert [process.wait(HANGING_S) for process in really_started] == [0, 0]
    alone = make_row("ONE")
    with pytest.MonkeyPatch.context() as context:
        context.setattr(tile_plan, "side_by_side", lambda scene, options, tiles: 1)
        fit(alone, TILED)
    assert len(really_started) == 2
    assert equal(model(scene), model(alone))
    shares = [share for share, _ in said]
    assert shares == sorted(shares)
    assert {"tile 1 of 2", "tile 2 of 2"} <= {message.split(":")[0] for _, message in said}


def test_a_lost_process_costs_its_tile_only(
    make_matched_hamlet: Towns, started: list[subprocess.Popen], expected: dict[str, torch.Tensor], caplog: Any
) -> None:
    scene, lost = make_matched_hamlet("LOST"), []

    def kill(fraction: float, message: str) -> None:
        if message.startswith("tile 1 of 4") and "epoch" in message and not lost:
            lost.append(message)
            started[0].send_signal(signal.SIGKILL)

    fit(scene, TILED, kill)
    assert [process.wait(HANGING_S) for process in started] == [-9, 0]
    assert "tile 1 of 4: its process was ended by signal 9; it goes on with one process less" in caplog.text
    assert equal(model(scene), expected)


def test_a_tile_whose_processes_are_always_lost_ends_the_fit(
    make_matched_row: Towns, started: list[subprocess.Popen], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tile_plan, "side_by_side", lambda scene, options, tiles: 2)
    scene = make_matched_row("ALWAYS")

    def kill(fraction: float, message: str) -> None:
        if message.startswith("tile 1 of 2"):
            for process in started:
                process.send_signal(signal.SIGKILL)

    with pytest.raises(SattoolsError, match=r"its process ended with status -9, expected its fit \(for want of memory"):
        fit(scene, TILED, kill)
    assert all(process.wait(HANGING_S) is not None for process in started)


def test_an_interrupt_ends_all_processes_and_resume_goes_on(
    make_matched_hamlet: Towns, started: list[subprocess.Popen], expected: dict[str, torch.Tensor]
) -> None:
    scene, said = make_matched_hamlet("CUT"), []

    def stop(fraction: float, message: str) -> None:
        if message.startswith("tile 2 of 4") and "epoch 4" in message:
            raise Interrupted

    with pytest.raises(Interrupted):
        fit(scene, TILED, stop)
    assert [process.poll() is not None for process in started] == [True, True]
    assert not list(scene.root.rglob("*.tmp-sattools*"))
    fit(scene, replace(TILED, resume=True), lambda share, message: said.append(message))
    assert "whole area, coarsely" not in {message.split(":")[0] for message in said}
    assert equal(model(scene), expected)


def test_an_error_in_a_process_is_that_of_the_command(make_matched_row: Towns, started: list[subprocess.Popen]) -> None:
    scene = make_matched_row("BROKEN")
    fit(scene, replace(TILED, part="split"))
    path = scene.root / "fit/tiles/r0c1/scene.json"
    part = json.loads(path.read_text())
    part["sattools"]["height_range_m"] = None
    path.write_text(json.dumps(part))
    plan = tile_plan.Plan.make(scene, TILED)
    with pytest.raises(SattoolsError, match=r"height range"):
        plan.fit(lambda share, message: None)
    assert [process.poll() is not None for process in started] == [True, True]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError("all of it"), "too little memory (all of it)"),
        (RuntimeError("can't allocate memory: 9 bytes"), "too little memory (can't allocate memory: 9 bytes)"),
        (OSError(28, "No space left on device", "a.tif"), "a.tif: found No space left on device"),
        (KeyError("x"), "internal error (RuntimeError: KeyError: 'x')"),
        (SceneError("found x"), "found x"),
    ],
)
def test_what_nobody_has_foreseen_in_a_process_is_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any, error: Exception, words: str
) -> None:
    """The command says of it what it says of its own."""

    def fail(*_: Any) -> None:
        raise error

    monkeypatch.setattr(Scene, "from_file", fail)
    told = io.StringIO()
    helper.serve([json.dumps({"root": str(tmp_path), "options": {}})], helper.Answers(told))
    parts = [crew.Part("tile", tmp_path, TILED)]
    with pytest.raises(Exception, match=re.escape(str(error))) as found:
        crew._Crew(parts, 1, lambda share, message: None)._heard(crew._Helper(None, 0), told.getvalue())
    assert words in explain(found.value)
    assert capfd.readouterr().err == ""


def test_messages_of_the_processes_are_told_once(
    make_hamlet: Towns, started: list[subprocess.Popen], caplog: Any
) -> None:
    scene = make_hamlet("TOLD")
    for item in scene.items[2:]:
        item.properties["sattools:role"] = "test"  # two views leave ground that one of them does not show
    with caplog.at_level(logging.INFO, "sattools"):
        result = fit(scene, replace(TILED, epochs=[2]))
    told = [record.getMessage() for record in caplog.records if ".r0c" in record.getMessage()]
    assert told != []
    assert len(told) == len(set(told))
    assert all(
        note in caplog.text for note in [note.partition(": ")[2] for note in result["notes"]] if "tile r" in note
    )


def test_a_process_ends_with_the_one_that_started_it(tmp_path: Path) -> None:
    """Its input ends, which is told to all systems."""
    process = subprocess.Popen([sys.executable, "-m", "sattools.fit.tiles.helper", "30"], stdin=subprocess.PIPE)
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(HANGING_S) == 0


def test_ctrl_c_is_left_to_the_process_that_gives_the_orders() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "sattools.fit.tiles.helper", "10"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    print(json.dumps({"root": os.devnull, "options": asdict(TILED)}), file=process.stdin, flush=True)
    ((kind, what),) = json.loads(process.stdout.readline()).items()
    assert (kind, what[0]) == ("error", "SceneError")
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=HANGING_S)
    assert (process.returncode, out, error) == (0, "", "")


def test_options_come_through_whole() -> None:
    options = replace(TILED, epochs=[3, 2], holdout=["a"], sky_share=[0.1], budget=3.0, reference="x.tif")
    assert FitOptions(**json.loads(json.dumps(asdict(options)))) == options

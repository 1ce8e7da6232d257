"""Interruption and progress of a real command in its own process."""

import ctypes
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from click.testing import CliRunner
from patience import HANGING_S

from sattools.cli import main
from sattools.cli.interrupts import checked, listening
from sattools.errors import SceneError
from sattools.fit.tiles.state import STATE
from sattools.progress import silent


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    """A signal counts for one test."""
    yield
    with listening():
        pass


@pytest.fixture
def fitting(make_hamlet: Any) -> Iterator[Any]:
    """A fit that has begun to train, and its scene."""
    scene = make_hamlet()
    command = [sys.executable, "-m", "sattools", "--threads", "1", "--progress", "json", "fit"]
    process = subprocess.Popen(
        [*command, "--epochs", "500", str(scene.root / "scene.json")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    yield process, scene
    process.kill()
    process.wait()
    process.stdout.close()
    process.stderr.close()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_the_fit_with_its_code_and_no_half_written_file(fitting: Any, number: Any, code: Any) -> None:
    process, scene = fitting
    records = []
    while len(records) < 12 or not (scene.root / "fit/checkpoint.safetensors").exists():
        text = process.stderr.readline()
        assert text, "the fit ended before it was interrupted"
        if text.startswith("{"):  # a first run says that it compiles
            records.append(json.loads(text))
    process.send_signal(number)
    output, rest = process.communicate(timeout=HANGING_S)
    assert process.returncode == code
    assert output == ""
    assert "Traceback" not in rest
    told = [line for line in rest.splitlines() if "interrupted" in line]
    assert len(told) == 1
    assert "`sattools fit --resume` with the same options goes on, and with --budget 1 beside it ends there" in told[0]
    assert [str(p) for p in scene.root.rglob("*.tmp*")] == []
    assert not (scene.root / "fit/model.safetensors").exists()
    # progress for programs: every line is a record, and it only grows
    assert all(set(r) == {"progress", "message"} and 0 <= r["progress"] <= 1 for r in records)
    assert [r["progress"] for r in records] == sorted(r["progress"] for r in records)
    assert records[-1]["message"].startswith("fit HAMLET: ")


def test_a_signal_while_the_interpreter_shuts_down_does_not_undo_what_is_done() -> None:
    """The work is done and told: its status stays 0."""
    code = (
        "import atexit, os, signal, sys; sys.argv = ['sattools', '--version'];"
        "atexit.register(lambda: [os.kill(os.getpid(), n) for n in (signal.SIGTERM, signal.SIGINT)]);"
        "from sattools.cli import entry; entry()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupt_during_a_callback_of_c_code_is_not_lost(number: Any, capfd: pytest.CaptureFixture[str]) -> None:
    """Python reports what is raised there as ignored and goes on."""
    callback = ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), number))
    wait = threading.Event().wait
    with pytest.raises(SystemExit) as stop, listening():
        wait(HANGING_S if callback() is None else 0)
    assert stop.value.code == 128 + number
    assert capfd.readouterr().err == ""


def test_an_interrupt_that_somebody_swallowed_counts_with_the_next_sign_of_progress() -> None:
    with listening():
        with pytest.raises(SystemExit):
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(SystemExit) as stop:
            checked(silent)(0.5, "")
    assert stop.value.code == 143
    with listening():
        checked(silent)(0.5, "")  # of another run


def test_other_ignored_exceptions_are_told_in_one_line(caplog: pytest.LogCaptureFixture) -> None:
    with listening():
        ctypes.CFUNCTYPE(None)(lambda: 1 / 0)()
    (record,) = caplog.records
    assert "ZeroDivisionError: division by zero" in record.getMessage()
    assert record.levelname == "WARNING"
    assert not record.exc_info


def test_with_vv_their_tracebacks_are_shown(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    told: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    with caplog.at_level("DEBUG", "sattools"), listening():
        ctypes.CFUNCTYPE(None)(lambda: 1 / 0)()
    assert [told.exc_type for told in told] == [ZeroDivisionError]


@pytest.mark.parametrize(
    "error", ["ImportError('initialization failed')", "sattools.errors.SceneError('grid: no GDAL environment exists')"]
)
def test_an_interrupt_that_became_an_error_ends_with_its_own_status(error: str) -> None:
    code = (
        "import os, signal, sys; sys.argv = ['sattools', 'fit', 'scene.json']; import sattools.scene as scene\n"
        "def broken(*_):\n"
        "  try:\n    os.kill(os.getpid(), signal.SIGTERM)\n"
        f"  except SystemExit: raise {error} from None\n"
        "scene.Scene.from_file = broken\n"
        "from sattools.cli import entry; entry()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "")


def test_an_interrupt_that_became_an_error_leaves_the_word_how_to_go_on(
    make_town: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    town = make_town()

    def interrupted(*_: Any) -> None:
        town.path(STATE).parent.mkdir(parents=True)
        town.path(STATE).write_text("{}")
        with suppress(SystemExit):
            os.kill(os.getpid(), signal.SIGINT)
        raise SceneError("grid: no GDAL environment exists")

    monkeypatch.setattr("sattools.fit.stage.fit", interrupted)
    result = CliRunner().invoke(main, ["fit", "--resume", str(town.root / "scene.json")])
    assert result.exit_code == 130
    assert caplog.messages[-1].startswith("interrupted: `sattools fit --resume` with the same options goes on")

"""The log in a scene's folder: times, settings before work, steps and what they took, what was told, what failed."""

import logging
import os
import re
from pathlib import Path
from typing import Any

import pytest

from sattools.errors import InputError
from sattools.progress import silent
from sattools.runlog import LARGEST, NAME, RunLog

LINE = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (INFO|WARNING|ERROR) [a-z.]+: (.*)")
ENTRY = {"seconds": 1.25, "cpu_seconds": 2.5, "peak_memory_mb": 100.4, "notes": ["two images"]}


def texts(folder: Path) -> list[str]:
    """Messages without their times, which every line has."""
    found = [LINE.fullmatch(line) for line in (folder / NAME).read_text().splitlines()]
    assert all(found)
    return [f"{match[1]} {match[2]}" for match in found if match]


def failing(folder: Path, error: BaseException) -> None:
    with RunLog("fit", {}) as log:
        log.place(folder)
        raise error


def test_settings_come_before_the_work_and_what_it_took_after_it(tmp_path: Path) -> None:
    with RunLog("fit", {"resolution": 1.0, "field": "surface"}) as log:
        log.place(tmp_path)
        assert texts(tmp_path)[1] == 'INFO fit: settings {"resolution": 1.0, "field": "surface"}'
        logging.getLogger("sattools.fit").warning("few images")
        log.done(ENTRY)
    first, _, *rest = texts(tmp_path)
    assert first.startswith("INFO sattools 0.")
    assert rest == [
        "WARNING few images",
        "INFO fit: done in 1.2 s, CPU 2.5 s, peak memory 100 MB; two images",
    ]
    logging.getLogger("sattools.fit").warning("after it")
    assert len(texts(tmp_path)) == 4, "what comes later is of another run"


def test_what_is_told_before_there_is_a_folder_is_kept(tmp_path: Path) -> None:
    with RunLog("prep", {}) as log:
        logging.getLogger("sattools.prep").warning("dark image")
        log.place(tmp_path)
    assert texts(tmp_path)[2:] == ["WARNING dark image"]


def test_every_step_is_told_once_with_what_was_taken_until_then(tmp_path: Path) -> None:
    with RunLog("fit", {}) as log:
        log.place(tmp_path)
        told: list[str] = []
        progress = log.told(lambda fraction, message: told.append(message))
        for epoch in range(4):
            progress(epoch / 4, f"epoch {epoch} of 4")
        progress(1.0, "writing")
    steps = [re.sub(r"\d+\.\d s|\d+ MB", "#", text) for text in texts(tmp_path)[2:]]
    assert steps == [
        "INFO fit:   0 % epoch 0 of 4 (CPU #, peak memory #)",
        "INFO fit: 100 % writing (CPU #, peak memory #)",
    ]
    assert len(told) == 5, "the screen is told everything"


@pytest.mark.parametrize(
    ("error", "last"),
    [
        (InputError("a.tif: found\nnothing"), "ERROR fit: error: a.tif: found nothing"),
        (KeyboardInterrupt(), "ERROR fit: interrupted"),
    ],
)
def test_why_a_run_failed_is_in_the_log(tmp_path: Path, error: BaseException, last: str) -> None:
    with pytest.raises(type(error)):
        failing(tmp_path, error)
    assert texts(tmp_path)[-1] == last


def test_an_unforeseen_error_leaves_its_traceback(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        failing(tmp_path, ZeroDivisionError("division by zero"))
    text = (tmp_path / NAME).read_text()
    assert "ERROR sattools.run: fit: error\nTraceback (most recent call last):" in text
    assert text.endswith("ZeroDivisionError: division by zero\n")


def test_runs_are_added_and_a_large_log_begins_anew(tmp_path: Path) -> None:
    for _ in range(2):
        with RunLog("fit", {}) as log:
            log.place(tmp_path)
    assert len(texts(tmp_path)) == 4
    (tmp_path / NAME).write_text("x" * (LARGEST + 1))
    with RunLog("fit", {}) as log:
        log.place(tmp_path)
    assert len(texts(tmp_path)) == 2
    assert (tmp_path / f"{NAME}.1").stat().st_size == LARGEST + 1


def a_folder(path: Path) -> None:
    path.mkdir()


def a_pipe(path: Path) -> None:
    os.mkfifo(path)


def a_link(path: Path) -> None:
    path.symlink_to(path.with_name("images.tif"))


@pytest.mark.parametrize("make", [a_folder, a_pipe, a_link])
def test_a_run_goes_on_where_there_can_be_no_log(tmp_path: Path, capfd: Any, make: Any) -> None:
    make(tmp_path / NAME)
    with RunLog("fit", {}) as log:
        log.place(tmp_path)
        log.told(silent)(0.5, "half")
        log.done(ENTRY)
    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "images.tif").exists(), "a link is not followed"


def test_a_full_disk_ends_the_log_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any) -> None:
    def full(*_: Any) -> int:
        raise OSError(28, "No space left on device")

    with RunLog("fit", {}) as log:
        log.place(tmp_path)
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", full)
            log.done(ENTRY)
        log.done(ENTRY)
    assert capfd.readouterr() == ("", "")
    assert len(texts(tmp_path)) == 2

"""What a person sees: help in groups, a summary at the end, and what stays in a log file."""

import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from click.testing import CliRunner
from patience import HANGING_S

from sattools.cli import main
from sattools.cli.fit import FitCommand
from sattools.fit.options import FitOptions
from sattools.scene import Scene
from sattools.settings import specs


def run(*arguments: Any) -> Any:
    return CliRunner().invoke(main, [*map(str, arguments)])


def on_terminal(*arguments: Any) -> str:
    """What a command writes where stdout is a terminal."""
    ours, theirs = pty.openpty()
    text: list[bytes] = []

    def read() -> None:
        """While the command runs: a terminal holds a few thousand characters, then who writes has to wait."""
        with suppress(OSError):  # the other end is closed
            while piece := os.read(ours, 65536):
                text.append(piece)

    reader = Thread(target=read)
    reader.start()
    command = [sys.executable, "-m", "sattools", *map(str, arguments)]
    try:
        done = subprocess.run(command, stdout=theirs, stderr=subprocess.PIPE, timeout=HANGING_S, check=False)
    finally:
        os.close(theirs)
        reader.join()
        os.close(ours)
    assert done.returncode == 0, done.stderr
    return b"".join(text).decode().replace("\r\n", "\n")


def test_help_of_fit_is_in_groups_and_leaves_out_what_experts_need() -> None:
    text = run("fit", "--help").stdout
    titles = re.findall(r"(?m)^([A-Z][a-z ]+):$", text)
    assert titles == ["Surface", "Images", "Light", "Reflectance", "Network", "Resources", "Files and configuration",
                      "How it runs"]  # fmt: skip
    assert "--resolution" in text
    assert "--depth-weight" not in text
    assert "26 more options for experts: main fit --help-all" in text
    assert len(text.splitlines()) < 130


def test_help_all_shows_every_option() -> None:
    text = run("fit", "--help-all").stdout
    for spec in specs(FitOptions):
        assert f"--{spec.name.replace('_', '-')}" in text, spec.name
    assert "more options for experts" not in text


def test_every_option_of_fit_is_in_one_group() -> None:
    grouped = [name for names in FitCommand.groups.values() for name in names]
    assert len(grouped) == len(set(grouped))
    assert {spec.name for spec in specs(FitOptions)} == set(grouped)
    assert FitCommand.expert <= set(grouped)


@pytest.fixture
def document(tmp_path: Path, town_source: Scene) -> Path:
    scene = Scene.from_json(town_source.to_json())
    scene.root = tmp_path / "TOWN"
    scene.root.mkdir()
    scene.items = []
    path: Path = scene.write()
    return path


def test_a_terminal_gets_a_summary_and_a_pipe_the_document(make_town: Callable[[], Scene]) -> None:
    document = make_town().root / "scene.json"
    text = on_terminal("normalise", "--dry-run", document)
    assert text == f"scene TOWN: 6 images, {document}\n"
    whole = on_terminal("normalise", "--dry-run", "--json", document)
    assert json.loads(whole)["id"] == "TOWN"
    assert json.loads(run("normalise", "--dry-run", document).stdout)["id"] == "TOWN"


def test_the_summary_names_what_the_command_has_made(document: Path) -> None:
    from sattools.scene.summary import brief

    scene = Scene.from_file(document)
    scene.products = {"model": "fit/model", "dsm": "export/dsm.tif", "points": "export/points.laz"}
    lines = brief(scene, {"command": "export", "seconds": 12.34, "peak_memory_mb": 512.3}).splitlines()
    assert lines[0] == f"scene TOWN: 0 images, {document} (export 12.3 s, 512 MB)"
    assert [line.split() for line in lines[1:]] == [
        ["dsm", str(scene.root / "export/dsm.tif")],
        ["points", str(scene.root / "export/points.laz")],
    ]


@pytest.mark.parametrize("place", ["before", "after"])
def test_a_log_file_keeps_what_was_called_and_what_went_wrong(tmp_path: Path, place: str) -> None:
    log = tmp_path / "run.log"
    option = ["--log-file", str(log)]
    command = ["info", str(tmp_path / "nowhere.json")]
    result = run(*option, "-q", *command) if place == "before" else run(*command, "-q", *option)
    assert result.exit_code == 1
    lines = log.read_text().splitlines()
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} INFO sattools\.run: sattools \d", lines[0])
    assert "ERROR sattools.run: sattools info: error:" in lines[-1]
    assert "nowhere.json" in lines[-1]
    run(*option, *command)
    assert len(log.read_text().splitlines()) == 2 * len(lines)


def test_a_log_file_does_not_make_the_screen_talkative(tmp_path: Path) -> None:
    import logging

    result = run("--log-file", tmp_path / "run.log", "doctor")
    assert result.stderr == ""
    run("doctor")  # without a log: the level is the usual one again
    assert logging.getLogger("sattools").level == logging.WARNING


@pytest.mark.parametrize("more", [[], ["-q"]])
def test_the_first_line_of_a_log_file_is_not_for_the_screen(tmp_path: Path, more: list[str]) -> None:
    options = ["--log-file", str(tmp_path / "run.log"), *more]
    command = [sys.executable, "-m", "sattools", *options, "fit", "--print-config"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANGING_S)
    assert (done.returncode, done.stderr) == (0, "")
    assert "INFO sattools.run: sattools " in (tmp_path / "run.log").read_text()


def test_a_log_file_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    result = run("--log-file", tmp_path / "no" / "run.log", "doctor")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "run.log: cannot be written (No such file or directory), expected a log file" in result.stderr


def test_a_misspelt_command_is_answered_with_the_right_one() -> None:
    result = run("fitt")
    assert result.exit_code == 2
    assert "No such command 'fitt' (did you mean 'fit'?)." in result.stderr


@pytest.mark.parametrize(("more", "lines"), [([], 6), (["-q"], 0)])
def test_a_table_for_people_is_not_for_who_asks_for_errors_only(tmp_path: Path, more: list[str], lines: int) -> None:
    import numpy as np

    from sattools.scene import Grid
    from sattools.scene.raster import write_cog

    path = tmp_path / "dsm.tif"
    write_cog(path, np.arange(400, dtype=np.float32).reshape(1, 20, 20), Grid("EPSG:32617", 0, 0, 1.0, 20, 20))
    result = run(*more, "compare", "--predicted", path, "--dsm", path, "--register", "none")
    assert json.loads(result.stdout)["mae"] == 0.0
    assert len(result.stderr.splitlines()) == lines

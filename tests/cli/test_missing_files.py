"""A file that an option names and that is not there is told before a command waits for its scene, hours maybe."""

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from patience import HANGING_S
from unread import Unread

from sattools.cli import main

# what options of commands on a pipe name, and what is said of it
NAMED = [
    (["compare", "--map", "theta={}"], "no such file, expected one for --map theta"),
    (["compare", "--points", "{}"], "no such file, expected one for --points"),
    (["compare", "--dsm", "{}"], "no such file, expected one for --dsm"),
    (["compare", "--dsm", "here", "--classes", "{}"], "no such file, expected one for --classes"),
    (["compare", "--views", "--lpips-weights", "{}"], "no such file, expected one for --lpips-weights"),
    (["compare", "--truth", "{}"], "no such folder, expected one for --truth"),
    (["fit", "--reference", "{}"], "no such file, expected one for --reference"),
    (["align", "--to", "{}"], "no such file, expected one for --to"),
    (["normalise", "--metadata", "{}"], "no such folder, expected one for --metadata"),
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with one file in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").touch()
    return tmp_path


@pytest.mark.parametrize("dry", [[], ["--dry-run"]], ids=str)
@pytest.mark.parametrize("name", ["nowhere", "./nowhere", "here/nowhere"])
@pytest.mark.parametrize(("arguments", "why"), NAMED, ids=lambda value: " ".join(value))
def test_a_missing_file_is_told_before_the_scene_comes(
    folder: Path, arguments: list[str], why: str, name: str, dry: list[str]
) -> None:
    command, *options = (part.format(name) for part in arguments)
    if name == "here/nowhere":  # its folder is none, but there is something
        (folder / "here").unlink()
        (folder / "here").mkdir()
    result = CliRunner().invoke(main, [command, *options, *dry], input=Unread())
    assert (result.exit_code, result.stdout) == (1, ""), result.output
    assert result.stderr == f"sattools {command}: error: {name}: {why}\n"


def test_the_last_program_of_a_pipe_ends_while_those_before_it_work(folder: Path) -> None:
    command = [sys.executable, "-m", "sattools", "compare", "--map", "theta=nowhere.tif"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None  # stdin stays open, and nothing comes
        assert process.wait(HANGING_S) == 1
        error = "sattools compare: error: nowhere.tif: no such file, expected one for --map theta\n"
        assert process.stderr.read() == error


def test_a_file_in_a_folder_that_a_program_before_may_make_is_waited_for(folder: Path, make_town: Any) -> None:
    scene = make_town()
    name = folder / "later" / "heights.tif"

    class Late(io.BytesIO):
        """A scene that comes once the file is there."""

        def readline(self, size: int | None = -1) -> bytes:
            name.parent.mkdir(exist_ok=True)
            name.touch()
            return super().readline(size)

    text = (scene.to_json() + "\n").encode()
    result = CliRunner().invoke(main, ["fit", "--dry-run", "--reference", str(name)], input=Late(text))
    assert f"{name}: no such file, expected one for --reference by the time that the scene arrives" in result.stderr
    assert "no readable image" in result.stderr  # it is empty
    result = CliRunner().invoke(main, ["fit", "--dry-run", "--reference", "gone/x.tif"], input=io.BytesIO(text))
    assert "gone/x.tif: no such file, expected one for --reference\n" in result.stderr
    assert result.exit_code == 1


def test_of_scenes_in_files_it_is_told_once(folder: Path, make_town: Any) -> None:
    paths = [str(make_town(name).root / "scene.json") for name in ("ONE", "OTHER")]
    result = CliRunner().invoke(main, ["fit", "--reference", "gone/x.tif", *paths])
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr == "sattools fit: error: gone/x.tif: no such file, expected one for --reference\n"

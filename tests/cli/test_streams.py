"""Commands started without stdout or stderr, or with one that does not know all letters, do their work all the same."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SATTOOLS = f'"{sys.executable}" -m sattools'
ASCII = {"PYTHONIOENCODING": "ascii"}
C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
LATIN = {"PYTHONIOENCODING": "latin-1"}


def shell(line: str, **variables: str) -> Any:
    environment = {**os.environ, **variables}
    return subprocess.run(["sh", "-c", line], capture_output=True, env=environment)


@pytest.fixture
def document(make_town: Any) -> Path:
    """Of a scene with a place that ASCII has no letters for."""
    scene = make_town("TOWN")
    scene.items[0].properties["place"] = "Zürich 𝄞"
    scene.history.append({"command": "prep", "options": {}, "seconds": 1.0, "notes": ["errors of 0.1 px²"]})
    path: Path = scene.root / "scene.json"
    path.write_text(scene.to_json() + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("command", "product", "closed"),
    [
        ("--quiet normalise", "radiance/TOWN_001.tif", ">&-"),
        ("normalise", "radiance/TOWN_001.tif", "2>&-"),
        ("normalise", "radiance/TOWN_001.tif", ">&- 2>&-"),
        ("prior", "prior/dsm.tif", "<&- >&- 2>&-"),  # which imports all there is
    ],
)
def test_work_is_done_with_closed_streams(document: Path, command: str, product: str, closed: str) -> None:
    done = shell(f'{SATTOOLS} {command} "{document}" {closed}')
    assert (done.returncode, done.stderr) == (0, b"")
    assert (document.parent / product).is_file()
    if closed == "2>&-":
        assert json.loads(done.stdout)["id"] == "TOWN"


@pytest.mark.parametrize("command", ["info", "--help", "--version"])
def test_what_is_only_read_needs_no_stdout(document: Path, command: str) -> None:
    done = shell(f'{SATTOOLS} {command} "{document}" >&-')
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_wrong_call_is_an_error_without_stderr_too(document: Path) -> None:
    assert shell(f'{SATTOOLS} info "{document}.not" 2>&-').returncode == 1
    assert shell(f"{SATTOOLS} info --nonsense 2>&- >&-").returncode == 2


@pytest.mark.parametrize("variables", [ASCII, C_LOCALE, LATIN])
def test_documents_are_json_whatever_the_encoding_of_stdout(document: Path, variables: dict[str, str]) -> None:
    done = shell(f'{SATTOOLS} normalise "{document}"', **variables)
    assert done.returncode == 0, done.stderr
    scene = json.loads(done.stdout.decode("utf-8"))
    assert scene["features"][0]["properties"]["place"] == "Zürich 𝄞"


@pytest.mark.parametrize("variables", [ASCII, C_LOCALE])
def test_letters_that_stdout_lacks_are_shown_as_numbers(document: Path, variables: dict[str, str]) -> None:
    done = shell(f'{SATTOOLS} info "{document}"', **variables)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"px\\u00b2" in done.stdout

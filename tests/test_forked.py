"""What stands for `python -m` in tests is a process as that would be."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from patience import HANGING_S

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="it is `python -m` elsewhere")


def test_streams_folder_environment_and_status_are_those_of_the_caller(python_m: list[str], tmp_path: Path) -> None:
    scene = {"type": "FeatureCollection", "id": "none", "features": []}

    def call(*command: str) -> tuple[int, str, str]:
        done = subprocess.run(
            [*command, "sattools", "--threads", "1", "fit", "--config", "own.toml", "-"], input=json.dumps(scene),
            cwd=tmp_path, env=os.environ | {"COLUMNS": "60"}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        return done.returncode, done.stdout, done.stderr

    (tmp_path / "own.toml").write_text("[fit]\nepochs = 1\n")
    assert call(*python_m) == call(sys.executable, "-m")
    (tmp_path / "own.toml").write_text("[fit]\nepochs = [1]\n")
    assert call(*python_m) == call(sys.executable, "-m")


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_it_ends_with_the_signal_that_the_caller_sends(python_m: list[str], number: int, status: int) -> None:
    """A process that fits tiles, as it says when it has begun."""
    command, pipe = [*python_m, "sattools.fit.tiles.helper", "10"], subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    print(json.dumps({"root": os.devnull, "options": {}}), file=process.stdin, flush=True)
    assert json.loads(process.stdout.readline())["error"][0] == "SceneError"
    process.send_signal(signal.SIGINT)  # which it leaves to others
    process.send_signal(number)
    assert process.wait(HANGING_S) == status
    assert process.communicate(timeout=HANGING_S) == ("", "")  # nobody holds the streams any more


def test_one_reads_what_another_writes(python_m: list[str]) -> None:
    writing = subprocess.Popen([*python_m, "sattools", "--json-usage"], stdout=subprocess.PIPE)
    done = subprocess.run(
        [*python_m, "sattools", "info", "-"], stdin=writing.stdout, capture_output=True, text=True, check=False
    )
    assert "stdin line 1: found JSON without a 'sattools' member" in done.stderr
    writing.communicate(timeout=HANGING_S)
    assert (writing.returncode, done.returncode) == (0, 1)

"""What Linux has and other systems have not is done without. (No test here has run on another system.)"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import pytest

from sattools import system
from sattools.scene.location import is_remote, needs_network
from sattools.scene.stored import StoredMap

# Libraries first: they have their own ways. Then everything of POSIX that Windows lacks goes, and folders cannot be
# opened; `shutil` has a way without that.
OF_COMMANDS = "cv2, filelock, matplotlib, numba, psutil, pyproj, rasterio, scipy.ndimage, torch"
OF_LOCKS = "filelock, numpy, psutil"
WITHOUT_POSIX = """
import asyncio, multiprocessing.resource_tracker, os, shutil, signal, subprocess, sys, tempfile
import LIBRARIES

from fcntl import F_GETFL, fcntl as ask
sync_file = os.fsync

def sync_written_file(file):
    if not ask(file, F_GETFL) & (os.O_WRONLY | os.O_RDWR):
        raise OSError(9, "Bad file descriptor")
    sync_file(file)

os.fsync = sync_written_file
for name in ("fcntl", "resource", "pwd", "grp"):
    sys.modules[name] = None
for name in ("fork", "getuid", "geteuid", "sched_getaffinity", "killpg", "setsid", "sysconf", "preadv", "pwrite"):
    delattr(os, name)
for name in ("O_CLOEXEC", "O_NOFOLLOW"):  # O_NONBLOCK, which Windows lacks as well, is wanted by filelock here
    delattr(os, name)
for name in ("SIGKILL", "SIGHUP", "pthread_sigmask", "pthread_kill"):
    delattr(signal, name)
shutil._use_fd_functions = False
open_file = os.open

def open_no_folder(path, *arguments, **options):
    if os.path.isdir(path):
        raise PermissionError(13, "Permission denied", str(path))
    return open_file(path, *arguments, **options)

os.open = open_no_folder
here, sys.platform = sys.platform, "win32"
import sattools.system
sys.platform = here
"""


def without_posix(code: str, *arguments: str, libraries: str) -> list[str]:
    """The command that runs code in a process that lacks what Windows lacks."""
    return [sys.executable, "-c", WITHOUT_POSIX.replace("LIBRARIES", libraries) + code, *arguments]


def done(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True)


EVERY_STEP = """
from pathlib import Path
from click.testing import CliRunner
from sattools.cli import main
sys.path.append(sys.argv[2])
from pictures import undrawn
undrawn().__enter__()  # for as long as the process lasts
folder = Path(sys.argv[1])
made, scene = folder / "SIM", folder / "TRY/scene.json"
for step in (
    ["simulate", "--size", 32, "--views", 4, "--dates", 3, "--id", "SIM", "--out", folder],
    ["prep", made / "images", "--metadata", made / "metadata", "--id", "TRY", "--out", folder],
    ["normalise", scene],
    ["prior", scene],
    ["fit", "--epochs", 2, scene],
    ["export", scene],
    ["compare", "--dsm", made / "truth/SIM_DSM.tif", scene],
    ["align", "--to", made / "truth/SIM_DSM.tif", scene],
    ["report", scene],
    ["fit", "--overwrite", "--tile", 20, "--overlap", 4, "--epochs", 1, scene],
):
    result = CliRunner().invoke(main, ["--quiet", "--threads", "1", *map(str, step)])
    assert result.exit_code == 0, (step, result.stderr, result.exception)
    print(step[0])
"""


def test_a_scene_goes_through_every_step_without_what_posix_systems_have(tmp_path: Path) -> None:
    """All in that process: what it starts would have all of it again."""
    pytest.importorskip("psutil")
    tried = done(without_posix(EVERY_STEP, str(tmp_path), str(Path(__file__).parent), libraries=OF_COMMANDS))
    assert tried.returncode == 0, tried.stderr
    assert tried.stdout.split() == [
        *("simulate", "prep", "normalise", "prior", "fit", "export", "compare", "align", "report", "fit")
    ]


def test_two_processes_without_locks_of_folders_still_write_one_after_the_other(tmp_path: Path) -> None:
    code = "from pathlib import Path; from sattools.system import alone\n"
    holding = code + "with alone(Path(sys.argv[1]), print):\n    print('has it', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        without_posix(holding, str(tmp_path), libraries=OF_LOCKS),
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as holds:  # fmt: skip
        assert holds.stdout is not None
        assert holds.stdout.readline() == "has it\n"
        waiting = done(
            without_posix(
                f"{code}import os\n"
                "def waits():\n    print('waits', flush=True)\n    os._exit(3)\n"
                "with alone(Path(sys.argv[1]), waits):\n    print('has it', flush=True)\n",
                str(tmp_path),
                libraries=OF_LOCKS,
            )
        )
        assert (waiting.returncode, waiting.stdout) == (3, "waits\n")
        holds.communicate("")
    after = done(
        without_posix(
            f"{code}with alone(Path(sys.argv[1]), lambda: print('waits')) as held:\n    print(held)\n",
            str(tmp_path),
            libraries=OF_LOCKS,
        )
    )
    assert after.stdout == "True\n"


def test_memory_and_processes_are_told_by_psutil_where_there_is_no_proc(monkeypatch: pytest.MonkeyPatch) -> None:
    psutil = pytest.importorskip("psutil")
    known = system.memory_free(), system.memory_taken()

    class Nothing:
        def __init__(self, path: str) -> None: ...

        def read_text(self, **how: Any) -> str:
            raise FileNotFoundError

    monkeypatch.setattr(system, "Path", Nothing)
    free, taken = system.memory_free(), system.memory_taken()
    # the same numbers by another way, some moments later, while other processes come and go
    assert known[0] is not None
    assert free == pytest.approx(known[0], rel=0.5)
    assert taken == pytest.approx(known[1], rel=0.5)
    monkeypatch.setattr(system, "fcntl", None)
    assert system.runs(os.getpid())
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    assert not system.runs(ended.pid)
    monkeypatch.setitem(sys.modules, "psutil", None)
    assert (system.memory_free(), system.memory_taken()) == (None, 0)
    assert system.runs(ended.pid)  # not known: what it may be writing is left alone
    assert psutil


def test_the_peak_of_memory_is_in_bytes_on_macos_and_in_kibibytes_on_linux(monkeypatch: pytest.MonkeyPatch) -> None:
    class Used:
        ru_maxrss = 3000

    monkeypatch.setattr(system.resource, "getrusage", lambda who: Used)
    assert system.memory_peak() == 3000 * 1024
    monkeypatch.setattr(sys, "platform", "darwin")
    assert system.memory_peak(children=True) == 3000


def test_a_drive_of_windows_is_no_address() -> None:
    assert not is_remote("C:/images/a.tif")
    assert not is_remote(str(PureWindowsPath("C:/images/a.tif")))
    assert not needs_network("C:/images/a.tif")
    assert is_remote("s3://bucket/a.tif")


def test_large_maps_are_kept_in_files_without_reading_at_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "preadv")
    monkeypatch.delattr(os, "pwrite")
    kept = StoredMap((3, 4), np.int16)
    kept[1:3] = np.arange(8).reshape(2, 4)
    kept[0:1, 1:3] = [[-1, -2]]
    np.testing.assert_array_equal(kept[:], [[0, -1, -2, 0], [0, 1, 2, 3], [4, 5, 6, 7]])

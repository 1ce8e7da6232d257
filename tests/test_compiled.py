"""Where compiled kernels are kept: also in containers without a home and with a read-only installation."""

import functools
import os
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import HANGING_S

import sattools
from sattools import compiled, helpers

PACKAGE = Path(sattools.__file__).parent


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Nothing but the temporary folder can be written."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(compiled, "writable", lambda folder: False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_folder_is_writable_when_files_can_be_made_below_it(tmp_path: Path) -> None:
    assert compiled.writable(tmp_path)
    assert compiled.writable(tmp_path / "not/yet/there")
    (tmp_path / "file").write_text("")
    assert not compiled.writable(tmp_path / "file/below")
    assert not compiled.writable(Path("/proc/none/below"))  # where root cannot write either


def test_numba_finds_a_place_by_itself_where_there_is_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    assert compiled.cache_folder(tmp_path) is None
    monkeypatch.setattr(compiled, "writable", lambda folder: False)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert compiled.cache_folder(tmp_path) is None


def test_otherwise_there_is_a_temporary_folder_of_this_user_alone(bare: Any) -> None:
    folder = compiled.cache_folder()
    assert folder == bare / f"sattools-cache-{os.getuid()}"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert compiled.cache_folder() == folder


@pytest.mark.parametrize("trap", ["link", "open to all", "file"])
def test_a_folder_that_somebody_else_may_have_prepared_is_not_used(bare: Any, trap: Any) -> None:
    name = bare / f"sattools-cache-{os.getuid()}"
    if trap == "link":
        (bare / "theirs").mkdir()
        name.symlink_to(bare / "theirs")
    elif trap == "file":
        name.write_text("")
    else:
        name.mkdir()
        name.chmod(0o777)
    folder = compiled.cache_folder()
    assert folder != name
    assert folder.parent == bare
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


# Root may write where it has no right to, so files stand where the folders of caches would be, and the home is in
# /proc, where nobody can make any.


@pytest.fixture
def container(tmp_path: Path) -> Any:
    """The package without compiled kernels, none of whose folders takes a file, and an environment without a home."""
    site = tmp_path / "site"
    shutil.copytree(PACKAGE, site / "sattools", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in [site / "sattools", *(p for p in (site / "sattools").rglob("*") if p.is_dir())]:
        (folder / "__pycache__").write_text("")  # a file: no folder of that name can be made
    (tmp_path / "tmp").mkdir()
    names = ("PATH", "LD_LIBRARY_PATH", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_WAIT_POLICY")
    kept = {name: os.environ[name] for name in names if name in os.environ}
    return {
        **kept,
        "PYTHONPATH": str(site),
        "PYTHONDONTWRITEBYTECODE": "1",
        "HOME": "/proc/none",
        "TMPDIR": str(tmp_path / "tmp"),
    }


def test_without_a_home_and_with_a_read_only_installation(container: Any) -> None:
    site = Path(container["PYTHONPATH"])
    (site / "sattools/tiny.py").write_text(
        "from sattools.compiled import njit\n\n\n@njit(cache=True)\ndef more(x):\n    return x + 1\n"
    )
    program = "from sattools.cli.safety import configure_handler as c; c(); from sattools.tiny import more; "
    said = []
    for _ in range(2):
        call = [sys.executable, "-c", program + "print(more(1), more(1.5))"]
        done = subprocess.run(call, env=container, cwd=site, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (0, "2 2.5\n"), done.stderr
        said.append(done.stderr)
    # once, though two kernels were compiled; and what was compiled is kept
    assert said == ["sattools: compiling, first run: this takes up to a minute, once\n", ""]
    assert [p.name for p in Path(container["TMPDIR"]).iterdir()] == [f"sattools-cache-{os.getuid()}"]


INNER = """
from sattools.compiled import njit

{constant}

@njit
def by(x):
    return {value}
"""
OUTER = """
from sattools.compiled import FASTMATH, njit
from inner import by, STEP

@njit(cache=True, fastmath=FASTMATH)
def more(x):
    return x + by(x) * STEP
"""


def test_a_kernel_is_compiled_anew_when_what_it_calls_has_changed(tmp_path: Path) -> None:
    (tmp_path / "outer.py").write_text(OUTER)
    call = [sys.executable, "-c", "from outer import more; print(more(1))"]
    environment = {**os.environ, "PYTHONPATH": f"{PACKAGE.parent}:{tmp_path}", "PYTHONDONTWRITEBYTECODE": "1"}
    environment["NUMBA_CACHE_DIR"] = str(tmp_path / "cache")
    said, written = [], ""
    for seed, inner in enumerate([("STEP = 1", 1), ("STEP = 1", 1), ("STEP = 1", 4), ("STEP = 3", 4)]):
        if (text := INNER.format(constant=inner[0], value=inner[1])) != written:
            (tmp_path / "inner.py").write_text(written := text)
            # what reproducible packages and images give all files; the size is the same, too
            os.utime(tmp_path / "inner.py", (10**9, 10**9))
        # sets (here of options) are in another order with every seed
        run = subprocess.run(
            call, env={**environment, "PYTHONHASHSEED": str(seed)}, capture_output=True, text=True, check=True
        )
        said.append((run.stdout, "compiling" in run.stderr))
    # numba alone goes on with 2: the file of `more` is the same
    assert said == [("2\n", True), ("2\n", False), ("5\n", True), ("13\n", True)]


def test_without_any_folder_kernels_are_compiled_for_this_run(container: Any) -> None:
    site = Path(container["PYTHONPATH"])
    (site / "sattools/tiny.py").write_text(
        "from sattools.compiled import njit\n\n\n@njit(cache=True)\ndef more(x):\n    return x + 1\n"
    )
    call = [
        sys.executable,
        "-c",
        "import tempfile; tempfile.tempdir = '/proc/none'; import sattools.tiny as t; t.more(1)",
    ]
    assert subprocess.run(call, env=container, cwd=site, capture_output=True).returncode == 0


@compiled.spread(lambda times: len(times))
@compiled.njit(nogil=True)
def count(times: Any, first: int, end: int) -> None:
    """Count how often each piece is done."""
    for piece in range(first, end):
        times[piece] += 1


@pytest.mark.parametrize("threads", [1, 2, 7])
@pytest.mark.parametrize("pieces", [0, 1, 3, 100])
def test_every_piece_is_done_once_by_any_number_of_threads(
    threads: int, pieces: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "MOST_THREADS", threads)
    times = np.zeros(pieces, np.int64)
    count(times)
    assert (times == 1).all()


@pytest.mark.parametrize("here", [True, False])
def test_an_error_in_a_piece_reaches_the_caller_when_no_other_is_running(
    here: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever thread meets it: this one, or one of the pool."""
    monkeypatch.setattr(compiled, "MOST_THREADS", 2)
    both, failed = threading.Barrier(2), threading.Event()
    running: set[int] = set()
    begun = []

    def call(k: int) -> None:
        running.add(k)
        begun.append(k)
        try:
            if k < 2:  # one in each thread
                both.wait()
                if (threading.current_thread() is threading.main_thread()) == here:
                    failed.set()
                    raise ValueError("the first")
                failed.wait()
            time.sleep(0.01)  # so that the other thread can say that nothing more is wanted
        finally:
            running.remove(k)

    with pytest.raises(ValueError, match="the first"):
        compiled.at_once(*(functools.partial(call, k) for k in range(200)))
    assert not running
    assert len(begun) < 200, "what had not begun was left alone"


def test_kernels_that_call_for_more_threads_from_a_thread_do_not_wait_for_each_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(compiled, "MOST_THREADS", 2)
    monkeypatch.setattr(helpers, "_begin", lambda threads: None)  # no more of them than there are
    times = np.zeros(100, np.int64)
    compiled.at_once(*[lambda: count(times[:50]), lambda: count(times[50:])])
    assert (times == 1).all()


def test_threads_that_wait_keep_nothing_of_what_they_worked_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "MOST_THREADS", 2)
    both, ended = threading.Barrier(2), []

    class Array:
        def __del__(self) -> None:
            ended.append(threading.current_thread().name)

    def call(array: Any) -> None:
        both.wait()  # one in each thread

    array = Array()
    compiled.at_once(functools.partial(call, array), functools.partial(call, array))
    del array
    limit = time.monotonic() + HANGING_S
    while not ended and time.monotonic() < limit:  # the helper says that it is ready before it lets go
        time.sleep(0.001)
    assert len(ended) == 1


def test_a_forked_child_has_threads_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "MOST_THREADS", 2)
    times = np.zeros(100, np.int64)
    count(times)
    child = os.fork()
    if child == 0:
        count(times)
        os._exit(0 if (times == 2).all() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0

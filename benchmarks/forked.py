"""Runs commands of the suite in forked children of one warm process: thousands of runs without thousands of starts.

The parent imports everything and starts no threads; a child has its own limits of memory and file size, its output
goes to files, and it can be sent signals at any moment.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

MODULES = (
    "sattools.batch.stage sattools.compare.points sattools.compare.stage sattools.export.material "
    "sattools.export.novel sattools.export.stage sattools.fit.rays.stage sattools.fit.stage sattools.fit.tiles.stage "
    "sattools.prep.dfc2019 "
    "sattools.prep.stage sattools.prior.stage sattools.radiometry.stage sattools.report.batch sattools.report.scene "
    "sattools.scene.files sattools.simulate.stage geopandas matplotlib.backends.backend_agg numba erfa torch"
)


@dataclass
class Result:
    """How a run ended: exit status (negative = the signal), what it said, seconds, largest resident memory."""

    status: int
    stdout: str
    stderr: str
    seconds: float
    timed_out: bool = False
    peak_mb: float = 0.0

    @property
    def traceback(self) -> bool:
        """Whether Python's own words reached the user."""
        return "Traceback (most recent call last)" in self.stderr


@dataclass
class Child:
    """A running command."""

    pid: int
    folder: Path
    started: float

    def alive(self) -> bool:
        """Whether it still runs."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    def wait(self, limit: float = 600.0) -> Result:
        """Wait for the end; killed after ``limit`` seconds."""
        deadline, late = time.monotonic() + limit, False
        while self.alive():
            if time.monotonic() > deadline and not late:
                late = True
                os.kill(self.pid, signal.SIGKILL)
            time.sleep(0.003)
        _, status, used = os.wait4(self.pid, 0)
        code = os.waitstatus_to_exitcode(status)
        out, err = [(self.folder / name).read_text(errors="replace") for name in ("out", "err")]
        return Result(code, out, err, time.monotonic() - self.started, late, used.ru_maxrss / 1024)


def preload() -> None:
    """Import what commands import, so that children need not."""
    import importlib

    # children may go on with kernels that the parent has run; the other layers do not survive a fork
    os.environ["NUMBA_THREADING_LAYER"] = "workqueue"
    from sattools.cli import COMMANDS, set_threads

    set_threads(1)
    for name in [*MODULES.split(), *(f"sattools.cli.{command}" for command in COMMANDS)]:
        importlib.import_module(name)


def warm(arguments: Sequence[str]) -> None:
    """Run a command in this process, so that children find its kernels and fonts loaded; it must succeed."""
    with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stdout(nowhere):
        status = _main(list(arguments))
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a program that has ended ignores signals
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if status:
        sys.exit(f"{arguments} failed: status {status}")


def start(
    arguments: Sequence[str],
    folder: Path,
    stdin: bytes | None = None,
    memory_mb: int | None = None,
    file_size: int | None = None,
    cwd: Path | None = None,
) -> Child:
    """Begin ``sattools ARGUMENTS``.

    Args:
        arguments: of the command line.
        folder: existing, gets the files `out` and `err`.
        stdin: what the command reads; None = nothing.
        memory_mb: address space beyond that of this process.
        file_size: largest file that can be written [bytes].
        cwd: working folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "in").write_bytes(stdin or b"")
    pid = os.fork()
    if pid:
        return Child(pid, folder, time.monotonic())
    code = 70
    try:
        for number, (name, flags) in enumerate((("in", os.O_RDONLY), ("out", _NEW), ("err", _NEW))):
            os.dup2(os.open(folder / name, flags, 0o600), number)
        # as Python opens them for a process of its own
        sys.stdin, sys.stdout = os.fdopen(0, "r", closefd=False), os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", errors="backslashreplace", closefd=False)
        sys.__stderr__ = sys.stderr
        if cwd is not None:
            os.chdir(cwd)
        if memory_mb is not None:
            resource.setrlimit(resource.RLIMIT_AS, ((memory_mb << 20) + _address_space(),) * 2)
        if file_size is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_size,) * 2)
        code = _main(list(arguments))
    except BaseException:  # what gets here is what a user would see
        import traceback

        traceback.print_exc()
        code = 1
    finally:
        threading._shutdown()  # type: ignore[attr-defined]  # as a process of its own ends: threads, then handlers
        atexit._run_exitfuncs()
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)
    raise AssertionError


_NEW = os.O_WRONLY | os.O_CREAT | os.O_TRUNC


def _main(arguments: list[str]) -> int:
    import logging

    from sattools.cli import entry

    logging.getLogger().handlers.clear()
    sys.argv = ["sattools", *arguments]
    try:
        entry()
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    return 0


def _address_space() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[0]) * resource.getpagesize()


def run(arguments: Sequence[str], folder: Path, limit: float = 600.0, **more: object) -> Result:
    """Start and wait."""
    return start(arguments, folder, **more).wait(limit)  # type: ignore[arg-type]

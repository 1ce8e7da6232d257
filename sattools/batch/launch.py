"""How the commands of a task are started: each in a process of its own, on Linux without importing all anew."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Generator
from contextlib import suppress

from sattools.processors import with_threads
from sattools.system import KILL, LINUX, end_with_parent

Began = Callable[[int], None]


class Launcher:
    """Starts commands, one at a time, and reads what they say.

    On Linux it keeps a process that has imported what commands need and forks for each (`sattools.cli.forking`);
    elsewhere it starts Python every time.
    """

    def __init__(self) -> None:
        self._forking: subprocess.Popen[str] | None = None
        self._gpu: str | None = None

    def run(
        self, arguments: list[str], threads: int, gpu: str | None, began: Began
    ) -> Generator[str | int, None, None]:
        """The lines that a command writes to stderr as they come, and at last its exit status.

        Closed before its end, it ends the command, too.

        Args:
            arguments: of the command.
            threads: that its libraries begin with; what `--threads` says counts.
            gpu: the CUDA device that it sees; None = all.
            began: told the number of its process.
        """
        environment = with_threads(threads)
        if gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = gpu
        if LINUX:
            yield from self._forked(arguments, environment, gpu, began)
        else:
            yield from _started(arguments, environment, began)

    def close(self) -> None:
        """End the process that is kept, with a command that still runs."""
        if self._forking is not None:
            self._forking.kill()
            _let_go(self._forking)
            self._forking = None

    def _forked(
        self,
        arguments: list[str],
        environment: dict[str, str],
        gpu: str | None,
        began: Began,
    ) -> Generator[str | int, None, None]:
        if self._forking is None or self._gpu != gpu or self._forking.poll() is not None:
            self.close()
            self._forking = _popen(["sattools.cli.forking"], environment, stdin=subprocess.PIPE)
            self._gpu = gpu
        process = self._forking
        assert process.stdin is not None
        assert process.stderr is not None
        ended = False
        try:
            with suppress(BrokenPipeError):  # told by the end of its lines
                print(json.dumps(arguments), file=process.stdin, flush=True)
            for line in process.stderr:
                if line.startswith('{"began"'):
                    began(json.loads(line)["began"])
                elif line.startswith('{"ended"'):
                    ended = True
                    yield int(json.loads(line)["ended"])
                    return
                elif line != "\n":
                    yield line
            yield process.wait()
        finally:
            if not ended:
                self.close()


def _started(arguments: list[str], environment: dict[str, str], began: Began) -> Generator[str | int, None, None]:
    process = _popen(["sattools", *arguments], environment, stdin=subprocess.DEVNULL)
    assert process.stderr is not None
    began(process.pid)
    try:
        yield from process.stderr
        yield process.wait()
    finally:
        if process.poll() is None:
            process.kill()
        _let_go(process)


def _popen(module: list[str], environment: dict[str, str], stdin: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", *module],
        stdin=stdin,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment,
        # it must not go on writing when its worker is lost and the task is started elsewhere
        preexec_fn=end_with_parent if LINUX else None,
    )


def _let_go(process: subprocess.Popen[str]) -> None:
    process.wait()
    for pipe in (process.stdin, process.stderr):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()


def end(process: int) -> None:
    """Kill a command.

    Args:
        process: its number.
    """
    with suppress(ProcessLookupError):
        os.kill(process, KILL)


__all__ = ["Launcher", "end"]

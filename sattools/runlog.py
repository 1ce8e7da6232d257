"""The log in a scene's folder: what was called, with which settings, what was told and what it took, with times.

It is kept of every run, whatever the screen shows, and never a reason to fail: where it cannot be written, the run goes
on without it.
"""

from __future__ import annotations

import json
import logging
import os
import re
import shlex
import stat
import sys
import time
from collections import deque
from pathlib import Path
from types import TracebackType
from typing import Any

from sattools import __version__, system
from sattools.errors import SattoolsError, printable
from sattools.progress import Progress

NAME = "sattools.log"
FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
LARGEST = 1_000_000  # bytes; a larger one is continued anew, with the last one beside it as `sattools.log.1`
_EARLY = 1000  # messages that are kept for a folder that is not there yet
_SILENCE_S = 30.0  # after which progress is told again

log = logging.getLogger("sattools.run")


class PlainFormatter(logging.Formatter):
    """Messages without control characters, in one line each."""

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`."""
        text = printable(super().format(record))
        return text if record.exc_info else text.replace("\n", " ")


class RunLog(logging.Handler):
    """The log of one run, as a context; what is told before `place` is kept until then, and lost without it."""

    def __init__(self, command: str, options: dict[str, Any]) -> None:
        super().__init__(logging.DEBUG)
        self.setFormatter(PlainFormatter(FORMAT))
        self._command, self._options = command, options
        self._file: int | None = None
        self._early: deque[str] = deque(maxlen=_EARLY)
        self._level = logging.NOTSET

    def __enter__(self) -> RunLog:
        root, own = logging.getLogger(), logging.getLogger("sattools")
        self._level = own.level
        # where the screen chooses for itself, more can be told here; handlers of a program that calls us get no more
        if any(hasattr(handler, "screen_level") for handler in root.handlers):
            own.setLevel(min(own.level, logging.INFO))
        root.addHandler(self)
        self._tell(logging.INFO, f"sattools {__version__}: {shlex.join(sys.argv)}")
        self._tell(logging.INFO, f"{self._command}: settings {json.dumps(self._options, ensure_ascii=False)}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        logging.getLogger().removeHandler(self)
        logging.getLogger("sattools").setLevel(self._level)
        if isinstance(error, SattoolsError):
            self._tell(logging.ERROR, f"{self._command}: error: {error}")
        elif isinstance(error, Exception):
            record = logging.LogRecord(log.name, logging.ERROR, "", 0, f"{self._command}: error", None, None)
            record.exc_info = (type(error), error, trace)
            self.handle(record)
        elif error is not None:
            self._tell(logging.ERROR, f"{self._command}: interrupted")
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def place(self, folder: Path) -> None:
        """Write from here on to the log of a folder; whoever calls is alone in it.

        Args:
            folder: of the scene.
        """
        path = folder / NAME
        # no link is followed and no pipe waited for: the name is the user's as well as ours
        flags = system.flags("O_WRONLY", "O_APPEND", "O_CREAT", "O_CLOEXEC", "O_NOFOLLOW", "O_NONBLOCK")
        try:
            if path.is_file() and not path.is_symlink() and path.stat().st_size > LARGEST:
                os.replace(path, path.with_name(f"{NAME}.1"))
            self._file = os.open(path, flags, 0o666)
            if not stat.S_ISREG(os.fstat(self._file).st_mode):
                os.close(self._file)
                self._file = None
        except OSError:
            return
        while self._early and self._file is not None:
            self._write(self._early.popleft())

    def done(self, entry: dict[str, Any]) -> None:
        """Tell what a command took.

        Args:
            entry: of the history.
        """
        notes = "".join(f"; {note}" for note in entry.get("notes", []))
        self._tell(
            logging.INFO,
            f"{self._command}: done in {entry['seconds']:.1f} s, CPU {entry['cpu_seconds']:.1f} s, peak memory "
            f"{entry['peak_memory_mb']:.0f} MB{notes}",
        )

    def told(self, progress: Progress) -> Progress:
        """Progress whose steps are in the log as well, each when it begins, with what was taken until then."""
        seen: set[str] = set()
        last = -_SILENCE_S

        def call(fraction: float, message: str) -> None:
            nonlocal last
            step, now = re.sub(r"[\d.]+", "#", message), time.monotonic()
            if step not in seen or now - last > _SILENCE_S:
                seen.add(step)
                last = now
                peak = system.memory_peak() / 2**20
                taken = f"CPU {time.process_time():.1f} s, peak memory {peak:.0f} MB"
                self._tell(logging.INFO, f"{self._command}: {100 * fraction:3.0f} % {message} ({taken})")
            progress(fraction, message)

        return call

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        line = self.format(record)
        if self._file is None:
            self._early.append(line)
        else:
            self._write(line)

    def handleError(self, record: logging.LogRecord) -> None:
        """A message that cannot be shown is no reason to say so on the screen."""

    def _tell(self, level: int, text: str) -> None:
        # straight to this file: the screen has its own lines
        self.handle(logging.LogRecord(log.name, level, "", 0, text, None, None))

    def _write(self, line: str) -> None:
        try:
            os.write(self._file or 0, f"{line}\n".encode(errors="backslashreplace"))
        except OSError:
            os.close(self._file or 0)
            self._file = None


__all__ = ["FORMAT", "LARGEST", "NAME", "PlainFormatter", "RunLog"]

"""`--log-file`: everything that happens in a run, with times, whatever the screen shows."""

from __future__ import annotations

import logging
import re
import shlex
import sys
from pathlib import Path

from sattools.errors import SattoolsError
from sattools.runlog import FORMAT, PlainFormatter

log = logging.getLogger("sattools.run")
_BEGINNING = re.compile(rb"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d")  # of `FORMAT`


class LogFile(logging.FileHandler):
    """A file that runs are added to."""


def open_log(path: str) -> None:
    """Write messages of all levels to the end of a file from here on; the first says what was called.

    Raises:
        SattoolsError: the file cannot be written.
    """
    from sattools import __version__

    root = logging.getLogger()
    target = str(Path(path).absolute())
    if any(isinstance(handler, LogFile) and handler.baseFilename == target for handler in root.handlers):
        return
    close_log()
    if not _may_be_log(Path(target)):
        raise SattoolsError(f"{path}: found a file that is no log, expected a new file, a log, or a name in .log")
    try:
        handler = LogFile(target, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise SattoolsError(f"{path}: cannot be written ({error.strerror}), expected a log file") from None
    handler.setFormatter(PlainFormatter(FORMAT))
    root.addHandler(handler)
    logging.getLogger("sattools").setLevel(logging.DEBUG)
    log.info("sattools %s: %s", __version__, shlex.join(sys.argv))


def _may_be_log(path: Path) -> bool:
    """Whether lines may be added to what is there: a scene document or an image would be good for nothing then."""
    try:
        if not path.is_file() or path.suffix.lower() == ".log":  # pipes and terminals hold nothing to be lost
            return True
        with open(path, "rb") as file:
            start = file.read(len("2026-01-31 12:00:00"))
    except OSError:  # told where it is opened
        return True
    return not start or _BEGINNING.fullmatch(start) is not None


def close_log() -> None:
    """End a log that is open."""
    root = logging.getLogger()
    for handler in [handler for handler in root.handlers if isinstance(handler, LogFile)]:
        root.removeHandler(handler)
        handler.close()


def log_is_open() -> bool:
    """Whether there is one."""
    return any(isinstance(handler, LogFile) for handler in logging.getLogger().handlers)


__all__ = ["LogFile", "PlainFormatter", "close_log", "log", "log_is_open", "open_log"]

"""The progress callback that every stage takes, and how it is shown: a bar for people, JSON lines for programs."""

from __future__ import annotations

import json
import sys
import time
from typing import Protocol


class Progress(Protocol):
    """Called with the share done in [0, 1] and a short message."""

    def __call__(self, fraction: float, message: str) -> None:
        """Tell how far the work is."""


def silent(fraction: float, message: str) -> None:
    """Report nothing."""


def subprogress(progress: Progress, start: float, end: float) -> Progress:
    """The callback of a step that makes up [start, end] of the whole.

    Args:
        progress: of the whole.
        start: share at its beginning.
        end: share at its end.
    """

    def call(fraction: float, message: str) -> None:
        progress(start + (end - start) * fraction, message)

    return call


def duration(seconds: float) -> str:
    """Seconds in a unit that people use."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def make_progress(mode: str, label: str) -> Progress:
    """The callback for ``mode`` (auto, bar, json, none); ``label`` names the command and the scene."""
    if mode == "auto":
        mode = "bar" if sys.stderr.isatty() else "none"
    if mode == "json":
        return _json_lines(label)
    if mode == "bar":
        return _bar(label)
    return silent


def _json_lines(label: str) -> Progress:
    def call(fraction: float, message: str) -> None:
        record = {"progress": round(min(1.0, max(0.0, fraction)), 4), "message": f"{label}: {message}"}
        print(json.dumps(record), file=sys.stderr, flush=True)

    return call


def _bar(label: str) -> Progress:
    width, interval = 24, 0.1  # letters, seconds
    start = time.monotonic()
    last = -interval

    def call(fraction: float, message: str) -> None:
        nonlocal last
        now = time.monotonic() - start
        if fraction < 1 and now - last < interval:
            return
        last = now
        fraction = min(1.0, max(0.0, fraction))
        left = f"{now / fraction - now:4.0f} s left" if fraction > 0.02 else ""
        done = round(width * fraction)
        line = f"\r{label} [{'#' * done}{'.' * (width - done)}] {100 * fraction:3.0f}% {left} {message}"
        # \x1b[K clears what a longer line left behind
        print(line[:140] + "\x1b[K", end="\n" if fraction >= 1 else "", file=sys.stderr, flush=True)

    return call


__all__ = ["Progress", "duration", "make_progress", "silent", "subprogress"]

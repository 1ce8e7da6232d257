"""The progress callback that every stage takes."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called with the share done in [0, 1] and a short message."""

    def __call__(self, fraction: float, message: str) -> None: ...


def silent(fraction: float, message: str) -> None:
    """Report nothing."""


def part(progress: Progress, start: float, end: float) -> Progress:
    """The callback of a step that makes up [start, end] of the whole."""

    def call(fraction: float, message: str) -> None:
        progress(start + (end - start) * fraction, message)

    return call


__all__ = ["Progress", "part", "silent"]

"""Folders for files to come, which go where no file comes."""

from __future__ import annotations

import atexit
import contextvars
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

_folders: list[tuple[int, Path]] = []  # made by the process of this number, parents first
_inside: contextvars.ContextVar[list[Path] | None] = contextvars.ContextVar("inside", default=None)


class _Blocks:
    """Those of `without_empty_folders` that run now, and folders of those that have ended before them."""

    def __init__(self) -> None:
        self.lock, self.running, self.made = threading.Lock(), 0, list[Path]()

    def renew_lock(self) -> None:
        """In a forked child: a thread of the parent may have held it, which is not there to let it go.

        The parent's blocks count on: its other children may be about to write.
        """
        self.lock = threading.Lock()


_blocks = _Blocks()
if hasattr(os, "register_at_fork"):  # Windows forks nothing
    os.register_at_fork(after_in_child=_blocks.renew_lock)


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, for files to come.

    If none comes, it goes at the end of `without_empty_folders`; outside of that, when the process ends.

    Raises:
        OSError: it cannot be made.
    """
    missing = [one for one in (folder, *folder.parents) if not one.exists()][::-1]
    folder.mkdir(parents=True, exist_ok=True)
    _folders.extend((os.getpid(), one) for one in missing)
    inside = _inside.get()
    if inside is not None:
        inside.extend(missing)


@contextmanager
def without_empty_folders() -> Iterator[None]:
    """Folders that are made inside, and into which nothing has come at the end, are removed.

    Those of blocks side by side go when the last one ends, as a thread may be about to write into another's folder.
    Threads take part where they run in a copy of the context.
    """
    made: list[Path] = []
    token = _inside.set(made)
    with _blocks.lock:
        _blocks.running += 1
    try:
        yield
    finally:
        _inside.reset(token)
        with _blocks.lock:
            _blocks.running -= 1
            _blocks.made += made
            if not _blocks.running:
                _remove_empty(_blocks.made)
                _blocks.made.clear()


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in reversed(folders):
        with suppress(OSError):
            folder.rmdir()  # refused unless nothing has come into it


@atexit.register
def _at_exit() -> None:
    """Those of calls outside of such blocks: of a program that may be about to write into them until it ends."""
    _remove_empty([folder for maker, folder in _folders if maker == os.getpid()])


__all__ = ["make_folder", "without_empty_folders"]

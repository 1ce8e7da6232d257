"""Which files a command may write."""

from __future__ import annotations

import os
import stat
import unicodedata
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from sattools.errors import OutputExistsError, OutputIsInputError, SattoolsError


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path] = (), overwrite: bool = False) -> None:
    """Refuse outputs that must not be written, before the first of them is.

    Args:
        outputs: files that a command is about to write; none needs to exist.
        inputs: files that it reads, or that must survive it. They are compared by device and inode, so links of
            either kind are seen through.
        overwrite: whether outputs may replace what is there. An input is never replaced.

    Raises:
        OutputIsInputError: an output is an input, or two outputs are one file.
        OutputExistsError: an output exists and ``overwrite`` is False.
        SattoolsError: an output is a folder, or lies in one that cannot be written to.
    """
    taken: dict[tuple[int, int], Path] = {}
    for path in inputs:
        with suppress(OSError, ValueError):
            status = os.stat(path)
            taken[status.st_dev, status.st_ino] = Path(path)
    outputs = [Path(path) for path in outputs]
    named: dict[str, Path] = {}
    exists = None
    for path in outputs:
        other = named.setdefault(unicodedata.normalize("NFC", str(path)).casefold(), path)
        if other is not path and (str(other) == str(path) or _takes_any_case(path.parent)):
            twice = "would be written twice" if str(other) == str(path) else f"would be one file with {other} here"
            raise OutputIsInputError(f"{path}: {twice}, expected different names")
        try:
            status = os.stat(path)
        except OSError:
            if path.is_symlink() and exists is None:  # it leads nowhere, but it is somebody's
                exists = path
            _check_folder(path)
            continue
        source = taken.get((status.st_dev, status.st_ino))
        if source is not None:
            same = "is an input too" if os.path.abspath(source) == os.path.abspath(path) else f"is the input {source}"
            raise OutputIsInputError(f"{path}: {same}, expected outputs in another place; nothing was written")
        if stat.S_ISDIR(status.st_mode):
            raise SattoolsError(f"{path}: found a folder, expected a file name to write to")
        exists = exists or path
        _check_folder(path)
    if exists is not None and not overwrite:
        raise OutputExistsError(f"{exists}: exists already; give --overwrite to replace it")


def _takes_any_case(folder: Path) -> bool:
    """Whether names below a folder, which need not exist, that differ in case only mean one file, as on many a Mac."""
    for path in (folder, *folder.parents):
        other = path.with_name(path.name.swapcase()) if path.name else path
        if other != path and path.exists():
            return other.exists() and other.samefile(path)
    return False


def _check_folder(path: Path) -> None:
    folder = next(p for p in path.absolute().parents if p.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise SattoolsError(f"{folder}: cannot be written to, expected a writable folder for {path.name}")


__all__ = ["check_outputs"]

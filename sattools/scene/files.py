"""Writing files: the one way of the suite, for every format.

A file is made in memory, written under a temporary name in the target's folder, synced, read back and compared, and
only then renamed, so that under its own name it is either what it was before or complete: on a full disk GDAL and
other libraries close a truncated file without an error. What a command writes can be held back until all of it is
there (`all_or_nothing`).
"""

from __future__ import annotations

import atexit
import contextvars
import functools
import glob
import hashlib
import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from sattools import system
from sattools.errors import SattoolsError
from sattools.scene.folders import make_folder, without_empty_folders
from sattools.scene.outputs import check_outputs

log = logging.getLogger(__name__)
_MARK = ".tmp-sattools"
_PIECE = 1 << 20
_WHOLE = 256 << 20  # bytes up to which a digest is that of the whole file
_SAMPLES = 128
_temporary: set[Path] = set()  # of this process, for the case that an interrupt keeps a cleaning from its work
# temporary file and its name to be; no temporary one: what has this name goes
_Waiting = list[tuple[Path | None, Path]]
_held_back: contextvars.ContextVar[_Waiting | None] = contextvars.ContextVar("held_back", default=None)


def write_bytes(path: Path, data: bytes | bytearray | memoryview) -> None:
    """Write a file: complete, verified and on the disk before it gets its name; else the old one stands.

    Raises:
        SattoolsError: the folder is not writable, the disk is full, or what was read back is not what was written.
    """
    content = memoryview(data).cast("B")
    write_with(path, lambda temporary: _write(temporary, content), lambda temporary: _check(temporary, content))


def write_with(path: Path, write: Callable[[Path], None], check: Callable[[Path], None]) -> None:
    """Write a file that is too large for memory: what `write_bytes` promises, for a writer of its own.

    Args:
        path: target file.
        write: makes the file of the name that it is given.
        check: raises OSError where what can be read of that file is not what was written.

    Raises:
        SattoolsError: the folder is not writable, the disk is full, or what was read back is not what was written.
    """
    path = Path(path)
    temporary = _beside(path)
    try:
        if path.is_dir():
            raise IsADirectoryError(21, "is a folder")
        _remove_orphans(path)
        _temporary.add(temporary)
        try:
            _made(temporary, path, write, check)
            waiting = _held_back.get()
            if waiting is None:
                _rename([(temporary, path)])
            else:
                waiting.append((temporary, path))
        except BaseException:
            _discard(temporary)
            raise
    except OSError as error:
        raise SattoolsError(f"{path}: cannot be written ({error.strerror or error})") from error


def remove(path: Path) -> None:
    """Remove a file, if it is there: within `all_or_nothing` when the new ones get their names, else at once.

    Raises:
        SattoolsError: it cannot be removed.
    """
    waiting = _held_back.get()
    if waiting is not None:
        waiting.append((None, Path(path)))
        return
    try:
        Path(path).unlink(missing_ok=True)
    except OSError as error:
        raise SattoolsError(f"{path}: cannot be removed ({error.strerror})") from error


@contextmanager
def scratch(path: Path) -> Iterator[Path]:
    """Name for a file beside a target, for what is too large for memory on the way to it; removed at the end.

    Raises:
        SattoolsError: the folder cannot be made.
    """
    temporary = _beside(Path(path))
    _temporary.add(temporary)
    try:
        yield temporary
    finally:
        _discard(temporary)


def _beside(path: Path) -> Path:
    """A name in a target's folder that no other process takes, and by which what a killed one left is known."""
    try:
        make_folder(path.parent)
    except OSError as error:
        raise SattoolsError(f"{path}: cannot be written ({error.strerror}), expected a writable folder") from error
    return path.with_name(f".{path.name}.{_host()}-{os.getpid()}-{os.urandom(3).hex()}{_MARK}")


def _made(temporary: Path, path: Path, write: Callable[[Path], None], check: Callable[[Path], None]) -> None:
    """A new file, synced and checked; what libraries say of a full disk is an OSError."""
    from sattools.scene.gdal import ERRORS, quiet_libtiff, why_not_written

    quiet_libtiff()
    try:
        write(temporary)
        with open(temporary, "r+b") as file:  # Windows syncs nothing that is open for reading only
            os.fsync(file.fileno())
        check(temporary)
    except ERRORS as error:
        found = why_not_written(temporary, error)
        raise OSError(found.errno, (found.strerror or "").replace(temporary.name, path.name)) from error


def write_text(path: Path, text: str) -> None:
    """`write_bytes` of UTF-8 text."""
    write_bytes(path, text.encode("utf-8"))


def write_figure(path: Path, figure: Any, **options: Any) -> None:
    """`write_bytes` of a matplotlib figure as PNG; ``options`` go to `savefig`."""
    import io

    stream = io.BytesIO()
    figure.savefig(stream, format="png", **options)
    write_bytes(path, stream.getbuffer())


@contextmanager
def all_or_nothing(inputs: Iterable[Path] | None = None, overwrite: bool = False) -> Iterator[None]:
    """Files that are written inside get their names together at the end, or none of them does.

    Folders that were made for them and stay empty are removed. Inside the files cannot be read yet. Blocks within
    blocks stand for themselves. Threads take part where they run in a copy of the context
    (`contextvars.copy_context`).

    Args:
        inputs: where given, all files are checked at the end by `check_outputs` with these.
        overwrite: for that check.
    """
    with without_empty_folders(), _held_back_until_the_end(inputs, overwrite):
        yield


@contextmanager
def _held_back_until_the_end(inputs: Iterable[Path] | None, overwrite: bool) -> Iterator[None]:
    waiting: _Waiting = []
    token = _held_back.set(waiting)
    try:
        yield
        if inputs is not None:
            check_outputs([path for _, path in waiting], inputs, overwrite)
        try:
            _rename(waiting)
        except OSError as error:
            what = "written" if error.filename2 else "removed"
            raise SattoolsError(f"{error.filename2 or error.filename}: cannot be {what} ({error.strerror})") from error
    finally:
        _held_back.reset(token)
        for temporary, _ in waiting:
            if temporary is not None:
                _discard(temporary)


@contextmanager
def together() -> Iterator[None]:
    """`all_or_nothing`, or within such a block a part of it."""
    with all_or_nothing() if _held_back.get() is None else nullcontext():
        yield


@contextmanager
def immediately() -> Iterator[None]:
    """Within `all_or_nothing`: files that are written inside get their names at once, such as a checkpoint."""
    token = _held_back.set(None)
    try:
        yield
    finally:
        _held_back.reset(token)


def written(path: Path) -> Path:
    """Where the content of a file is now: under its temporary name while it is held back, else under its own."""
    path = Path(path)
    return {target: temporary for temporary, target in _held_back.get() or () if temporary}.get(path, path)


def digest(path: Path) -> str | None:
    """SHA-256 of a file's content, None where there is no readable file.

    A file that is held back counts already. Above 256 MiB: of its size and 128 evenly spaced pieces of 1 MiB, so that
    whole satellite scenes need no minutes.
    """
    path = written(path)
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size <= _WHOLE:
                return hashlib.file_digest(file, "sha256").hexdigest()
            known = hashlib.sha256(str(size).encode())
            for k in range(_SAMPLES):
                file.seek((size - _PIECE) * k // (_SAMPLES - 1))
                known.update(file.read(_PIECE))
            return known.hexdigest()
    except OSError:
        return None


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Let one process at a time write below a folder; says so once where it has to wait.

    File systems that know no locks go without.
    """
    with system.alone(
        folder, lambda: log.warning("%s: another sattools process works here, waiting for it", folder)
    ) as held:
        if not held:
            log.debug("%s: cannot be locked", folder)
        yield


def _write(path: Path, data: memoryview) -> None:
    """Write a new file with the permissions that any new file has."""
    with open(path, "xb") as file:
        for start in range(0, len(data), _PIECE):
            file.write(data[start : start + _PIECE])


def _check(path: Path, data: memoryview) -> None:
    """Read a file back."""
    with open(path, "rb") as file:
        if os.fstat(file.fileno()).st_size != len(data):
            raise OSError(5, "found a truncated file after writing")
        for start in range(0, len(data), _PIECE):
            if file.read(_PIECE) != data[start : start + _PIECE]:
                raise OSError(5, "found other bytes than were written")


def _rename(pairs: _Waiting) -> None:
    try:
        _rename_all(pairs)
    except OSError:
        raise
    except BaseException:  # an interrupt among the names: what is half old and half new would be neither
        _rename_all([(temporary, path) for temporary, path in pairs if temporary is None or temporary.exists()])
        raise
    for folder in {path.parent for _, path in pairs}:
        with suppress(OSError):  # not every file system can sync a folder
            system.sync(folder)


def _rename_all(pairs: _Waiting) -> None:
    for temporary, path in pairs:
        if temporary is None:
            path.unlink(missing_ok=True)
        else:
            os.replace(temporary, path)
            _temporary.discard(temporary)
            _forget_statistics(path)


def _forget_statistics(path: Path) -> None:
    """Remove what GDAL has kept beside a raster that is another one now: its histogram would colour the new one."""
    kept = path.with_name(f"{path.name}.aux.xml")
    with suppress(OSError):
        if not kept.is_symlink():
            kept.unlink(missing_ok=True)


def _discard(temporary: Path) -> None:
    temporary.unlink(missing_ok=True)
    _temporary.discard(temporary)


@atexit.register
def _discard_all() -> None:
    for temporary in list(_temporary):
        if f"-{os.getpid()}-" in temporary.name:  # not what a forked child knows of its parent's
            with suppress(OSError):
                _discard(temporary)


def _remove_orphans(path: Path) -> bool:
    """Remove what a killed process of this machine left of the same file; whether one is left that still runs."""
    running = False
    for orphan in path.parent.glob(f".{glob.escape(path.name)}.*{_MARK}"):
        host, number, *_ = [*orphan.name.removesuffix(_MARK).rpartition(".")[2].split("-"), ""]
        if host == _host() and number.isdigit():
            if system.runs(int(number)):
                running |= int(number) != os.getpid()
            else:
                orphan.unlink(missing_ok=True)
    return running


def remove_orphans(folder: Path, patience_s: float = 0.0) -> None:
    """Remove temporary files that killed processes of this machine left anywhere below a folder.

    Args:
        folder: where to look.
        patience_s: how long to wait for processes that are about to end.
    """
    deadline = time.monotonic() + patience_s
    while True:
        found = list(Path(folder).rglob(f".*{_MARK}"))
        names = {orphan.with_name(orphan.name[1:].removesuffix(_MARK).rpartition(".")[0]) for orphan in found}
        if not sum(_remove_orphans(name) for name in names) or time.monotonic() > deadline:
            return
        time.sleep(0.1)


@functools.cache
def _host() -> str:
    """A few letters for this machine: process numbers of another one that shares the disk say nothing here."""
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:6]


__all__ = [
    "all_or_nothing",
    "check_outputs",
    "digest",
    "immediately",
    "locked",
    "remove",
    "remove_orphans",
    "scratch",
    "together",
    "write_bytes",
    "write_figure",
    "write_text",
    "write_with",
    "written",
]

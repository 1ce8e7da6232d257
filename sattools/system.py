"""The operating system: locks, memory and processes, where one system has other calls for them than the next.

What a system lacks is done without: a folder that cannot be locked is not, memory that nobody tells is not known.
`psutil` tells what Linux has files for and is not needed there.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
    import resource
except ModuleNotFoundError:  # Windows
    fcntl = resource = None  # type: ignore[assignment]

LINUX = sys.platform == "linux"
KILL = getattr(signal, "SIGKILL", signal.SIGTERM)  # Windows ends a process with either
_SET_PARENT_DEATH_SIGNAL = 1  # prctl(2)
_LOCK = ".sattools.lock"  # where a folder itself cannot be locked
_seeking = threading.Lock()


@contextmanager
def alone(folder: Path, waits: Callable[[], None]) -> Iterator[bool]:
    """Hold the lock of a folder, whether there is one.

    It goes with the process and leaves nothing behind. On POSIX systems it is on the folder itself, elsewhere on a file
    in it that is removed at the end.

    Args:
        folder: whose lock.
        waits: called once where another process has it.
    """
    if fcntl is None:
        with _alone_by_file(folder, waits) as held:
            yield held
        return
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        yield False
        return
    try:
        held = True
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            waits()
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError:  # a file system that knows no locks
            held = False
        yield held
    finally:
        os.close(handle)


@contextmanager
def _alone_by_file(folder: Path, waits: Callable[[], None]) -> Iterator[bool]:
    from filelock import FileLock, Timeout

    lock = FileLock(folder / _LOCK)
    held = True
    try:
        try:
            lock.acquire(timeout=0)
        except Timeout:
            waits()
            lock.acquire()
    except (OSError, NotImplementedError):
        held = False
    try:
        yield held
    finally:
        if held:
            lock.release()


def sync(folder: Path) -> None:
    """Let the names in a folder reach the disk.

    Raises: OSError where the file system, or the system, cannot.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def deaf() -> Iterator[None]:
    """What is started inside does not hear Ctrl-C, which a terminal sends to all processes; on POSIX systems only."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # else started by the first thread that needs it, which would then hear again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def send(number: int) -> None:
    """Let the main thread have a signal, whatever it waits for.

    Args:
        number: of the signal.
    """
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)


def read_at(file: int, into: memoryview, at: int) -> int:
    """Read from a place of a file; the number of bytes. Threads do not get into each other's way.

    Args:
        file: number of the open file.
        into: what is read.
        at: place in the file [bytes].
    """
    if hasattr(os, "preadv"):
        return os.preadv(file, [into], at)
    with _seeking:
        os.lseek(file, at, os.SEEK_SET)
        found = os.read(file, len(into))
    into[: len(found)] = found
    return len(found)


def write_at(file: int, data: memoryview, at: int) -> int:
    """Write at a place of a file; the number of bytes. Arguments as of `read_at`."""
    if hasattr(os, "pwrite"):
        return os.pwrite(file, data, at)
    with _seeking:
        os.lseek(file, at, os.SEEK_SET)
        return os.write(file, data)


def flags(*names: str) -> int:
    """Flags of `os.open` by their names, without those that the system does not have."""
    together = 0
    for name in names:
        together |= getattr(os, name, 0)
    return together


def user() -> int | None:
    """Number of the user; None where users have none, and temporary folders are each one's own."""
    return os.getuid() if hasattr(os, "getuid") else None


def memory_free() -> int | None:
    """Bytes that the system can still give without swapping; None where nothing tells."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    psutil = _psutil()
    return int(psutil.virtual_memory().available) if psutil else None


def memory_limit() -> int | None:
    """Bytes of addresses that this process may have (`ulimit -v`); None = any number."""
    soft = resource.getrlimit(resource.RLIMIT_AS)[0] if resource else -1
    return soft if resource and soft != resource.RLIM_INFINITY else None


def memory_taken() -> int:
    """Bytes in memory of this process; 0 where nothing tells."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        psutil = _psutil()
        return int(psutil.Process().memory_info().rss) if psutil else 0


def memory_peak(children: bool = False) -> int:
    """The most bytes in memory that this process has had; 0 where nothing tells.

    Args:
        children: or the largest one that it has started and waited for, if that is more.
    """
    if resource is None:
        psutil = _psutil()
        return int(getattr(psutil.Process().memory_info(), "peak_wset", 0)) if psutil else 0
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)[: 1 + children]
    unit = 1 if sys.platform == "darwin" else 1024
    return max(resource.getrusage(one).ru_maxrss for one in who) * unit


def children_seconds() -> float:
    """CPU seconds of the processes that this one has started and waited for; 0 where nothing tells."""
    if resource is None:
        return 0.0
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def runs(process: int) -> bool:
    """A process has not ended, as far as can be told.

    Args:
        process: its number, on this machine.
    """
    if fcntl is None:  # where signal 0 would end it
        psutil = _psutil()
        return bool(psutil.pid_exists(process)) if psutil else True
    try:
        os.kill(process, 0)
        # after the name in brackets, which may be anything, stands the state: Z has ended and was not waited for
        return Path(f"/proc/{process}/stat").read_text(errors="replace").rpartition(") ")[2][:1] != "Z"
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True


def end_with_parent(number: int = KILL) -> None:
    """Let the system send this process a signal when its parent ends, however that happens; on Linux only.

    Args:
        number: of the signal.
    """
    if LINUX:
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, number)


def _psutil():  # type: ignore[no-untyped-def]
    try:
        import psutil
    except ModuleNotFoundError:
        return None
    return psutil


__all__ = [
    "KILL", "LINUX", "alone", "children_seconds", "deaf", "end_with_parent", "flags", "memory_free", "memory_limit",
    "memory_peak", "memory_taken", "read_at", "runs", "send", "sync", "user", "write_at",
]  # fmt: skip

"""Processors: how many threads a command may have, what its processes are told, and that they end with it."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# what PyTorch, MKL, the compiled kernels and OpenCV read when they are imported
POOLS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
_SET_PARENT_DEATH_SIGNAL = 1  # prctl(2), Linux


def threads() -> int:
    """Threads that the user allows (`--threads`), else the processors that this process may use."""
    asked = os.environ.get("NUMBA_NUM_THREADS", "")
    return int(asked) if asked.isdigit() and int(asked) > 0 else cores()


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def with_threads(count: int) -> dict[str, str]:
    """This process's environment for one whose pools have a number of threads.

    Args:
        count: of threads.
    """
    return {**os.environ, **dict.fromkeys(POOLS, str(count))}


@contextmanager
def in_environment(name: str, value: str) -> Iterator[None]:
    """A variable of the environment for a while: what all threads see, and all processes that are started.

    Args:
        name: of the variable.
        value: of it.
    """
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = before


def end_with_parent(number: int = signal.SIGKILL) -> None:
    """Let the system send this process a signal when its parent ends, however that happens; on Linux only.

    Args:
        number: of the signal.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, number)


__all__ = ["POOLS", "cores", "end_with_parent", "in_environment", "threads", "with_threads"]

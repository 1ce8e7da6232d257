"""Processors: how many threads a command may have, and what its processes are told."""

from __future__ import annotations

import contextvars
import importlib
import math
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

# what PyTorch, MKL, the compiled kernels and OpenCV read when they are imported
POOLS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
_OWN_GROUPS, _GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
T = TypeVar("T")
R = TypeVar("R")


def threads() -> int:
    """Threads that the user allows (`--threads`), else the processors that this process may use."""
    asked = os.environ.get("NUMBA_NUM_THREADS", "")
    return int(asked) if asked.isdigit() and int(asked) > 0 else cores()


def side_by_side(function: Callable[[T], R], items: Iterable[T], most: int | None = None) -> Iterator[R]:
    """What a function makes of items, in their order; of several at a time, where this process has threads for it.

    It pays where the function is busy in OpenCV, GDAL or with large arrays of NumPy, which let other threads run
    meanwhile. It sees the context variables that its caller sees, and OpenCV has the threads that are over. What raises
    first by the items' order is raised, and what has not begun then, or at Ctrl-C, is left alone.

    Args:
        function: of one item; it changes nothing that the others use.
        items: in any number.
        most: of them at a time, where they need memory.
    """
    items = list(items)
    count = min(threads(), len(items), most or len(items))
    if count < 2:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(count, "sattools")
    cv2 = imported("cv2")
    before = cv2.getNumThreads() if cv2 else 0
    try:
        if cv2:
            cv2.setNumThreads(max(1, threads() // count))
        here = contextvars.copy_context()
        waiting = deque(pool.submit(here.copy().run, function, item) for item in items)
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        if cv2:
            cv2.setNumThreads(before)


def imported(name: str) -> Any:
    """A module that somebody has imported, once that is done if another thread is just about it; None if nobody has.

    Args:
        name: of the module.
    """
    return importlib.import_module(name) if name in sys.modules else None


def cores() -> int:
    """Processors that this process may use: those that it may run on, or less by the quota of its control groups.

    A container with two processors of a machine with 64 may run on all of them, for a thirty-second of the time.
    """
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for file in group_files("cpu", "cpu.max", "cpu.cfs_quota_us"):
        try:
            quota, *period = file.read_text(encoding="ascii").split()
            per = period[0] if period else file.with_name("cpu.cfs_period_us").read_text(encoding="ascii")
            if quota not in ("max", "-1"):
                there = min(there, max(1, math.ceil(int(quota) / int(per))))
        except (OSError, ValueError, ZeroDivisionError):
            continue
    return there


def group_files(controller: str, name: str, former: str) -> Iterator[Path]:
    """Files of the control groups (cgroups(7), Linux) that this process is in, its own first; they may not be there.

    Args:
        controller: such as ``memory``.
        name: of the file.
        former: its name in version 1 of control groups.
    """
    try:
        lines = _OWN_GROUPS.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return
    for _, controllers, path in (line.split(":", 2) for line in lines if line.count(":") >= 2):
        if controllers and controller not in controllers.split(","):
            continue
        root, file = (_GROUPS / controller, former) if controllers else (_GROUPS, name)
        own = root / path.lstrip("/")
        # without a name space of its own a container sees paths of the machine, and its own group at the root
        for folder in (own, *own.parents):
            yield folder / file
            if folder == root:
                break


def takes(memory: float, cpu_s: float) -> str:
    """What some work will take, in words.

    Args:
        memory: bytes.
        cpu_s: CPU seconds.
    """
    minutes = cpu_s / 60
    took = f"{cpu_s:.0f} CPU seconds" if minutes < 1 else f"{minutes:.{1 if minutes < 10 else 0}f} CPU minutes"
    return f"about {memory / 2**30:.1f} GiB of memory and {took} (this machine has {cores()} cores)"


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


__all__ = [
    "POOLS", "cores", "group_files", "imported", "in_environment", "side_by_side", "takes", "threads",
    "with_threads",
]  # fmt: skip

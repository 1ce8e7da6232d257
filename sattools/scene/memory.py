"""Whether something fits into memory, asked before it is tried: the system would end the process without a word."""

from __future__ import annotations

import ctypes
import math
import os
from contextlib import AbstractContextManager

from sattools import system
from sattools.errors import SattoolsError
from sattools.processors import group_files, in_environment

LIMIT = "SATTOOLS_MAX_MEMORY_MB"  # a variable of the environment, so that processes of this one see it too

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # numbers of GNU's malloc.h


def available() -> int | None:
    """Bytes that this process may still take, by what user (`--max-memory`) and system tell; None where they do not."""
    limits = _groups_allow()
    if LIMIT in os.environ:
        limits.append(max(0, int(float(os.environ[LIMIT]) * 2**20) - system.memory_taken()))
    limits += [known for known in (system.memory_free(), system.memory_limit()) if known is not None]
    return min(limits, default=None)


def granted(installed: int) -> float:
    """Bytes that processes of this one may take together: the machine's, or less by what user and system say.

    Args:
        installed: bytes of the machine.
    """
    limits = [float(installed), *_groups_allow()]
    if LIMIT in os.environ:
        limits.append(float(os.environ[LIMIT]) * 2**20)
    return min(limits)


def _groups_allow() -> list[int]:
    """Limits of this process's control groups [bytes]."""
    limits = []
    for path in group_files("memory", "memory.max", "memory.limit_in_bytes"):
        try:
            limits.append(int(path.read_text(encoding="ascii")))
        except (OSError, ValueError):
            continue
    return limits


def to_spend() -> float | None:
    """Bytes for work that can be cut to size; None = unknown.

    Half of what is free, as other programs want some; of what the user grants four fifths, as estimates are estimates.
    """
    there = available()
    return None if there is None else there * (0.8 if LIMIT in os.environ else 0.5)


def limited(megabytes: float) -> AbstractContextManager[None]:
    """Get by with an amount of memory for a while, see `available`.

    Args:
        megabytes: of memory.
    """
    return in_environment(LIMIT, str(megabytes))


def share_of_limit(processes: int) -> dict[str, str]:
    """What to add to the environment of one of several processes that go by this one's limit together.

    Args:
        processes: their number.
    """
    return {LIMIT: str(float(os.environ[LIMIT]) / processes)} if LIMIT in os.environ else {}


def keep_freed() -> None:
    """Keep what is freed for what is asked for next, up to a quarter of a GiB, instead of giving it back at once.

    Arrays of some megabytes that come and go are otherwise fetched from the system page by page each time, which took a
    sixth of the CPU seconds of `prep`. Does nothing where the C library has no such setting.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    mallopt(_M_MMAP_THRESHOLD, 32 << 20)  # the most that it takes
    mallopt(_M_TRIM_THRESHOLD, 256 << 20)


def give_back() -> None:
    """Give freed memory back to the system, that of gaps between what is still held, too.

    Steps that one after the other hold much for a while otherwise add up, as each finds the gaps too small. Does
    nothing where the C library has no such call.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):
        return


def check_memory(needed: float, what: str, remedy: str) -> None:
    """Raise SattoolsError where `needed` bytes are more than there are.

    Args:
        needed: memory [bytes].
        what: needs it, for the message.
        remedy: what the user can do.
    """
    there = available()
    if there is not None and needed > there:
        granted_mb = os.environ.get(LIMIT)
        whose = f"that --max-memory {float(granted_mb):g} MB leaves" if granted_mb else "that are free"
        unit, size = ("GiB", 2**30) if there >= 0.1 * 2**30 else ("MiB", 2**20)
        # rounded away from each other: a need is never the same as what there is
        more, less = math.ceil(10 * needed / size) / 10, math.floor(10 * there / size) / 10
        raise SattoolsError(
            f"{what}: found a need of {more:.6g} {unit} of memory, expected at most the {less:g} {unit} {whose} "
            f"({remedy})"
        )


__all__ = [
    "LIMIT", "available", "check_memory", "give_back", "granted", "keep_freed", "limited", "share_of_limit", "to_spend",
]  # fmt: skip

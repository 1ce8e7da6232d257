"""Whether something fits into memory, asked before it is tried: the system would end the process without a word."""

from __future__ import annotations

import resource
from pathlib import Path

from sattools.errors import SattoolsError

_CGROUP = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def available() -> int | None:
    """Bytes that this process may still take, as far as the system tells; None where it does not."""
    limits = []
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                limits.append(int(line.split()[1]) * 1024)
    except (OSError, ValueError, IndexError):
        pass
    for path in _CGROUP:
        try:
            limits.append(int(path.read_text(encoding="ascii")))
        except (OSError, ValueError):
            continue
    soft = resource.getrlimit(resource.RLIMIT_AS)[0]
    if soft != resource.RLIM_INFINITY:
        limits.append(soft)
    return min(limits, default=None)


def check_memory(needed: float, what: str, remedy: str) -> None:
    """Raise SattoolsError where `needed` bytes are more than there are.

    Args:
        needed: memory [bytes].
        what: needs it, for the message.
        remedy: what the user can do.
    """
    there = available()
    if there is not None and needed > there:
        raise SattoolsError(
            f"{what}: found a need of {needed / 2**30:.1f} GiB of memory, expected at most the {there / 2**30:.1f} GiB "
            f"that are free ({remedy})"
        )


__all__ = ["available", "check_memory"]

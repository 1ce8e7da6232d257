"""A command of the suite in a process of its own: what it took."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass


@dataclass
class Outcome:
    """How a command ended."""

    status: int
    output: bytes
    seconds: float
    cpu_s: float
    peak_gb: float


# Linux counts the peak of who starts a process as the process's own, and this benchmark holds a city: something small
# starts it
LAUNCHER = """
import os, resource, sys
pid = os.fork()
if not pid:
    os.execv(sys.argv[2], sys.argv[2:])
_, status, usage = os.wait4(pid, 0)
with open(sys.argv[1], "w") as file:
    print(usage.ru_utime + usage.ru_stime, usage.ru_maxrss, file=file)
sys.exit(max(os.waitstatus_to_exitcode(status), 0) or int(status != 0))
"""


def command(*arguments: str, given: bytes = b"") -> Outcome:
    """Run a command of the suite in a process of its own and say what it took."""
    begun = time.perf_counter()
    with (
        tempfile.TemporaryFile() as source,
        tempfile.TemporaryFile() as target,
        tempfile.TemporaryFile() as said,
        tempfile.NamedTemporaryFile() as took,
    ):
        source.write(given)
        source.seek(0)
        launched = [sys.executable, "-I", "-c", LAUNCHER, took.name, sys.executable, "-m", "sattools", *arguments]
        status = subprocess.run(launched, stdin=source, stdout=target, stderr=said, check=False).returncode
        target.seek(0)
        output = target.read()
        said.seek(0)
        if status:
            sys.stderr.write(said.read().decode())
        used, peak_kib = (float(value) for value in took.read().split())
    done = Outcome(status, output, time.perf_counter() - begun, used, peak_kib / 2**20)
    cost = f"{done.seconds:.0f} s, {used:.0f} CPU s, {done.peak_gb:.3f} GiB peak"
    print(f"{arguments[0]}: exit status {done.status}, {cost}", flush=True)
    return done

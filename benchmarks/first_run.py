"""CPU seconds of a first run beside later ones: `python benchmarks/first_run.py [--tried] [--runs 3]`.

Simulate, prior, fit, export and compare on a city of 64 m with six images, each command a process of its own, on one
thread. The first run finds no compiled kernels; with `--tried`, those that `sattools doctor --try` leaves when the
suite is installed.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path


def cpu_of(arguments: list[str], document: bytes, env: dict[str, str]) -> tuple[float, bytes]:
    """CPU seconds of a command, and what it wrote to its standard output."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    call = [sys.executable, "-m", "sattools", "--quiet", "--threads", "1", *arguments]
    done = subprocess.run(call, input=document, stdout=subprocess.PIPE, env=env, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def one_run(folder: Path, env: dict[str, str]) -> dict[str, float]:
    """CPU seconds of every command on a new scene."""
    truth = folder / "CITY/truth/CITY_DSM.tif"
    made = ["simulate", "--id", "CITY", "--out", str(folder), "--size", "64", "--views", "6"]
    steps = [made, ["prior"], ["fit"], ["export"], ["compare", "--dsm", str(truth)]]
    seconds, document = {}, b""
    for step in steps:
        seconds[step[0]], document = cpu_of(step, document, env)
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tried", action="store_true")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        env = {**os.environ, "NUMBA_CACHE_DIR": str(Path(place) / "kernels")}
        if options.tried:
            print(f"doctor --try: {cpu_of(['doctor', '--try'], b'', env)[0]:.1f} CPU s")
        for number in range(1, options.runs + 1):
            seconds = one_run(Path(place) / f"run{number}", env)
            parts = ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
            print(f"run {number}: {sum(seconds.values()):.1f} CPU s ({parts})", flush=True)


if __name__ == "__main__":
    main()

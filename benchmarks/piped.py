"""Seconds of `prep | prior | fit | export` on a pipe, as a shell runs it, beside other checkouts in turns.

    git worktree add ../before COMMIT
    python benchmarks/piped.py IMAGES_FOLDER [--metadata FOLDER] --out FOLDER [--beside ../before ...] [--runs 5]

All four start at once and each waits for the scene of the one before it, so that the pipe takes less than its commands
one after the other (`threads.py`). All with this Python and its libraries; the first round, which compiles kernels, is
not counted.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

STEPS = ("prep", "prior", "fit", "export")
HERE = Path(__file__).resolve().parents[1]


def seconds(checkout: Path, arguments: list[str], target: Path) -> float:
    """Of one pipe of a checkout that makes a scene below a folder."""
    shutil.rmtree(target, ignore_errors=True)
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    first = [*arguments, "--id", "SCENE", "--out", str(target)]
    begun, given = time.perf_counter(), None
    with ExitStack() as stack:
        running = []
        for step in STEPS:
            call = [sys.executable, "-m", "sattools", "--quiet", step, *(first if step == "prep" else [])]
            process = subprocess.Popen(call, stdin=given, stdout=subprocess.PIPE, env=environment, cwd=checkout)
            if given:
                given.close()  # it is the command's own; here it would keep the one before from hearing of its end
            running.append(stack.enter_context(process))
            given = process.stdout
        running[-1].communicate()
    if any(process.returncode for process in running):
        raise SystemExit(f"{checkout}: exit statuses {[process.returncode for process in running]}")
    return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path)
    parser.add_argument("--metadata", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--beside", type=Path, nargs="*", default=[])
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    arguments = [str(options.images.resolve())]
    if options.metadata:
        arguments += ["--metadata", str(options.metadata.resolve())]
    ways = [HERE, *(path.resolve() for path in options.beside)]
    runs = [{way: seconds(way, arguments, options.out / "piped") for way in ways} for _ in range(options.runs + 1)][1:]
    for way in ways:
        ratio = statistics.median(run[HERE] / run[way] for run in runs)
        print(f"{statistics.median(run[way] for run in runs):7.2f} s  this / it {ratio:.3f}  {way}")


if __name__ == "__main__":
    main()

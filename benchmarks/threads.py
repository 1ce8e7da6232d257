"""What more threads bring: seconds and CPU seconds of every command with 1, 2 and 4 of them.

    python benchmarks/threads.py FOLDER_OF_IMAGES [--metadata FOLDER] --out FOLDER [--threads 1 2 4] [--runs 3]

Runs `prep | prior | fit | export` on the images as often as asked, with the numbers of threads one after the other so
that what else the machine does falls on all of them alike; prints medians, CPU seconds as a multiple of those with the
first number of threads, and the serial share of the seconds after Amdahl: T(n) = T(1) (s + (1 - s) / n), by which more
cores than this machine has may be judged. With more threads than cores the CPU seconds show what waiting costs.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
from pathlib import Path

from launched import Outcome, command

STEPS = ("prep", "prior", "fit", "export")


def once(options: argparse.Namespace, threads: int) -> dict[str, Outcome]:
    """The pipe with so many threads, each command in a process of its own."""
    target = options.out / f"threads_{threads}"
    shutil.rmtree(target, ignore_errors=True)
    metadata = ["--metadata", str(options.metadata)] if options.metadata else []
    first = [str(options.images), *metadata, "--id", "SCENE", "--out", str(target)]
    found: dict[str, Outcome] = {}
    given = b""
    for step in STEPS:
        arguments = first if step == "prep" else []
        found[step] = command(step, *arguments, "--threads", str(threads), "--quiet", given=given)
        if found[step].status:
            raise SystemExit(f"{step}: exit status {found[step].status}")
        given = found[step].output
    return found


def serial_share(one: float, many: float, threads: int) -> float:
    """Amdahl's s of the seconds with one thread and with many."""
    return (many / one - 1 / threads) / (1 - 1 / threads)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path)
    parser.add_argument("--metadata", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    runs = [{n: once(options, n) for n in options.threads} for _ in range(options.runs)]
    base = options.threads[0]
    print(f"{'command':8s} threads  seconds  CPU s  CPU s / CPU s with {base}  serial share", flush=True)
    for step in (*STEPS, "all"):
        names = STEPS if step == "all" else (step,)
        seconds = {n: statistics.median(sum(r[n][k].seconds for k in names) for r in runs) for n in options.threads}
        spent = {n: statistics.median(sum(r[n][k].cpu_s for k in names) for r in runs) for n in options.threads}
        for n in options.threads:
            share = "" if base != 1 or n == 1 else f"{serial_share(seconds[1], seconds[n], n):.2f}"
            print(f"{step:8s} {n:7d}  {seconds[n]:7.1f}  {spent[n]:5.1f}  {spent[n] / spent[base]:19.2f}  {share:>12s}")


if __name__ == "__main__":
    main()

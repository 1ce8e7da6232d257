"""CPU seconds and error of the four commands beside those of other checkouts, in turns on one machine.

    git worktree add ../before COMMIT
    python benchmarks/versions.py IMAGE... --metadata FOLDER --id ID --truth FOLDER --beside ../before --out FOLDER
        [--runs 3] [--variant 'prior --detail 1']

Runs `prep | prior | fit | export` on one thread with this checkout, with every `--variant` of it (options given to one
command besides) and with each `--beside` one, once after the other as often as asked, so that what else the machine
does falls on all of them alike; all with this Python and its libraries. Prints medians of user and system seconds by
command, and this checkout's `compare` by the DFC2019 protocol for each DSM. The first round, which compiles kernels,
is not counted. Bytecode is kept whatever the environment says: compiling it again with every command is nobody's work.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

STEPS = ("prep", "prior", "fit", "export")
HERE = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Way:
    """A checkout, and options that one of its commands gets besides."""

    name: str
    checkout: Path
    step: str = ""
    extra: tuple[str, ...] = ()


def run(way: Way, arguments: list[str], given: bytes) -> tuple[bytes, float]:
    """What a command of a checkout writes to its standard output, and its CPU seconds."""
    env = {**os.environ, "PYTHONPATH": str(way.checkout), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    env.pop("PYTHONDONTWRITEBYTECODE", None)
    call = [sys.executable, "-m", "sattools", "--quiet", "--threads", "1", *arguments]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(call, input=given, capture_output=True, env=env, cwd=way.checkout, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(f"{way.name}, {arguments[0]}: exit status {done.returncode}: {done.stderr.decode()[-500:]}")
    return done.stdout, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def once(way: Way, options: argparse.Namespace) -> dict[str, float]:
    """CPU seconds of each command of one way, and the error of its surface [m]."""
    target = options.out / way.name.replace(" ", "_").replace("/", "_")
    shutil.rmtree(target, ignore_errors=True)
    files = [str(path.resolve()) for path in options.images]
    first = [*files, "--metadata", str(options.metadata.resolve()), "--id", options.id, "--out", str(target.resolve())]
    found, given = {}, b""
    for step in STEPS:
        arguments = [step, *(first if step == "prep" else []), *(way.extra if step == way.step else [])]
        given, found[step] = run(way, arguments, given)
    scored, _ = run(Way("", HERE), ["compare", "--protocol", "dfc2019", "--truth", str(options.truth.resolve())], given)
    return {**found, "all": sum(found.values()), "mae_m": json.loads(scored.splitlines()[-1])["mae"]}


def main() -> None:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path, nargs="+")
    parser.add_argument("--metadata", type=Path, required=True)
    parser.add_argument("--id", required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--beside", type=Path, nargs="*", default=[])
    parser.add_argument("--variant", nargs="*", default=[])
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    variants = [Way(text, HERE, text.split()[0], tuple(text.split()[1:])) for text in options.variant]
    ways = [Way("this", HERE), *variants, *(Way(path.name, path.resolve()) for path in options.beside)]
    results = [{way.name: once(way, options) for way in ways} for _ in range(options.runs + 1)][1:]
    columns = (*STEPS, "all")
    print(f"{'':24s} " + " ".join(f"{name:>7s}" for name in columns) + "  this / it    MAE [m]")
    for way in ways:
        middle = {name: statistics.median(r[way.name][name] for r in results) for name in (*columns, "mae_m")}
        share = statistics.median(r["this"]["all"] / r[way.name]["all"] for r in results)
        costs = " ".join(f"{middle[name]:7.2f}" for name in columns)
        print(f"{way.name:24s} {costs}  {share:9.3f}  {middle['mae_m']:9.3f}")


if __name__ == "__main__":
    main()

"""Seconds of a scene's tiles on 1, 2 and 4 workers of a Dask cluster, each of them held to a share of a core.

    sudo python benchmarks/workers.py SCENE.json --out FOLDER [--tile 448] [--workers 1 2 4] [--share 0.2]

The kernel's CPU controller (cgroups, Linux; needs root) gives every worker and all that it starts that share of a core,
so that four workers get four times the computing of one on a machine with fewer than four cores. What they share is the
scheduler, the disk and the memory's bandwidth. Efficiency is the seconds with one worker over n times those with n; the
coarse pass, the joining and the export are done by one worker alone and belong to it.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from dask_cluster import Cluster

PERIOD_US = 100_000
CPU = Path("/sys/fs/cgroup/cpu")  # of version 1 of control groups; version 2 has one tree for all controllers


@contextmanager
def held_to(share: float, process: int, name: str) -> Iterator[None]:
    """Hold a process, and those that it will start, to a share of a core."""
    group = (CPU if CPU.exists() else CPU.parent) / name
    group.mkdir()
    try:
        quota = round(share * PERIOD_US)
        if CPU.exists():
            (group / "cpu.cfs_period_us").write_text(str(PERIOD_US))
            (group / "cpu.cfs_quota_us").write_text(str(quota))
        else:
            (group / "cpu.max").write_text(f"{quota} {PERIOD_US}")
        for task in Path(f"/proc/{process}/task").iterdir():  # threads, too: version 1 moves them one by one
            (group / ("tasks" if CPU.exists() else "cgroup.procs")).write_text(task.name)
        yield
    finally:
        while (group / "cgroup.procs").read_text():  # what the worker started ends with it
            time.sleep(0.2)
        group.rmdir()


def seconds(scene: Path, workers: int, options: argparse.Namespace) -> float:
    """Seconds of a batch with so many workers."""
    work = options.out / f"workers_{workers}"
    shutil.rmtree(work, ignore_errors=True)
    config = options.out / "tiles.toml"
    config.write_text(f"[fit]\ntile = {options.tile}\n", encoding="utf-8")
    with ExitStack() as limits, Cluster(workers) as dask:
        for k, worker in enumerate(dask.workers):
            limits.enter_context(held_to(options.share, worker.pid, f"sattools_{os.getpid()}_{k}"))
        begun = time.perf_counter()
        call = [sys.executable, "-m", "sattools", "--quiet", "batch", str(scene), "--config", str(config)]
        where = ["--scheduler", dask.address, "--task-threads", "1", "--out", str(work)]
        subprocess.run([*call, *where], check=True, stdout=subprocess.DEVNULL)
        taken = time.perf_counter() - begun
    shutil.rmtree(work)
    return taken


def main() -> None:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tile", type=float, default=448.0)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--share", type=float, default=0.2, help="of a core that every worker gets")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    found = {n: seconds(options.scene, n, options) for n in options.workers}
    one = options.workers[0] * found[options.workers[0]]
    for n, taken in found.items():
        print(json.dumps({"workers": n, "seconds": round(taken, 1), "efficiency": round(one / (n * taken), 3)}))


if __name__ == "__main__":
    main()

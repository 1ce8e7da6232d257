"""Seconds of a scene's tiles on 1, 2 and 4 workers of a Dask cluster, each of them held to a share of a core.

    sudo python benchmarks/workers.py SCENE.json --out FOLDER [--tile 448] [--workers 1 2 4] [--share 0.2] [--kills 3]

The kernel's CPU controller (cgroups, Linux; needs root) gives every worker and all that it starts that share of a core,
so that four workers get four times the computing of one on a machine with fewer than four cores. What they share is the
scheduler, the disk and the memory's bandwidth. Efficiency is the seconds with one worker over n times those with n,
once of the tiles alone, from the first to the last, and once of the whole batch, with the coarse pass, the joining and
the export that one worker does alone. With --kills that many workers are killed while tiles are fitted, each of them
replaced by a new one; the surface's digest at the end of each line must be the same with and without.
"""

from __future__ import annotations

import argparse
import hashlib
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


def tiles_done(work: Path) -> tuple[int, int]:
    """Number of tiles that are fitted, and of all; 0 and 0 before they are known."""
    folder = next(work.glob("runs/*/*/fit/tiles"), None)
    if folder is None or not (folder / "tiles.json").exists():
        return 0, 0
    try:
        names = json.loads((folder / "tiles.json").read_text())["tiles"] or []
    except (OSError, ValueError):  # it is being written, or gone
        return 0, 0
    return sum((folder / name / "fit/model.safetensors").exists() for name in names), len(names)


def seconds(scene: Path, workers: int, options: argparse.Namespace) -> tuple[float, float, str]:
    """Seconds of the tiles and of a whole batch with so many workers, and the digest of its surface."""
    work = options.out / f"workers_{workers}"
    shutil.rmtree(work, ignore_errors=True)
    config = options.out / "tiles.toml"
    config.write_text(f"[fit]\ntile = {options.tile}\n", encoding="utf-8")
    with ExitStack() as limits, Cluster(workers) as dask:

        def hold(k: int) -> None:
            limits.enter_context(held_to(options.share, dask.workers[k].pid, f"sattools_{os.getpid()}_{k}"))

        for k in range(workers):
            hold(k)
        begun = time.perf_counter()
        call = [sys.executable, "-m", "sattools", "--quiet", "batch", str(scene), "--config", str(config)]
        where = ["--scheduler", dask.address, "--task-threads", "1", "--out", str(work)]
        begin = end = None
        killed = 0
        with subprocess.Popen([*call, *where], stdout=subprocess.DEVNULL) as process:
            while process.poll() is None:
                time.sleep(0.1)
                done, every = tiles_done(work)
                begin = time.perf_counter() if begin is None and every else begin
                end = time.perf_counter() if end is None and 0 < every == done else end
                if killed < options.kills and done * (options.kills + 1) > (killed + 1) * every:
                    dask.workers[killed].kill()
                    killed += 1
                    dask.start_worker()
                    hold(len(dask.workers) - 1)
        taken = time.perf_counter() - begun
    if process.returncode or begin is None or end is None:
        raise SystemExit(f"{' '.join(call)}: exit status {process.returncode}")
    digest = hashlib.sha256(next(work.glob("runs/*/*/export/dsm.tif")).read_bytes()).hexdigest()[:12]
    shutil.rmtree(work)
    return end - begin, taken, digest


def main() -> None:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tile", type=float, default=448.0)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--share", type=float, default=0.2, help="of a core that every worker gets")
    parser.add_argument("--kills", type=int, default=0, help="workers that are killed on the way")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    found = {n: seconds(options.scene, n, options) for n in options.workers}
    first = options.workers[0]
    for n, taken in found.items():
        tiles, whole = (first * one / (n * now) for one, now in zip(found[first][:2], taken[:2], strict=True))
        times = f"tiles {taken[0]:.0f} s, efficiency {tiles:.2f}; all {taken[1]:.0f} s, {whole:.2f}"
        print(f"{n} workers: {times}; DSM {taken[2]}", flush=True)


if __name__ == "__main__":
    main()

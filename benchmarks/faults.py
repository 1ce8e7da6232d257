"""Kills commands at random moments, fills the disk at every write, lets a Dask cluster die: what is left behind?

    python benchmarks/faults.py --kills 200 --out faults

Every command is run once undisturbed; then again and again on a copy of the same scene, interrupted up to three times
by SIGINT, SIGTERM or SIGKILL at random moments, and finished (`fit --resume`, the others again). What must hold:

- after every interruption each file is what it was before or what the undisturbed run writes: none is damaged;
- an interrupt leaves no temporary file of its own, and after the end there is none at all, whatever was killed before;
- the end is that of the undisturbed run, byte for byte (but for seconds and memory in histories and traces).

Under a limit of file sizes just below each output in turn (a full disk), the command fails with one line and every
file is as before. Prints a table and writes faults.json; the exit status is 1 where anything was found.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dask_cluster import Cluster
from forked import Result, preload, run, start

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
EXPECTED = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}
FIT = ["--resolution", "2", "--coarsest", "4", "--epochs", "12", "--epochs", "12"]
NETWORK = [
    "--preset",
    "eonerf",
    "--width",
    "16",
    "--rays",
    "64",
    "--samples",
    "12",
    "--steps",
    "60",
    "--resolution",
    "4",
]
VOXEL = ["--field", "voxel", "--rays", "64", "--samples", "12", "--steps", "60", "--resolution", "4"]
LIVE = {"seconds", "peak_memory_mb", "time", "pid", "updated"}


@dataclass
class Job:
    """A command on a prepared scene.

    Attributes:
        name: of the job.
        source: scene that it begins with.
        arguments: `{scene}` stands for its document, `{root}` for its folder.
        again: what is added to finish after an interruption.
    """

    name: str
    source: str
    arguments: list[str]
    again: list[str] = field(default_factory=lambda: ["--overwrite"])


JOBS = [
    Job("simulate", "nothing", ["simulate", "--size", "48", "--views", "3", "--dates", "2", "--gsd", "1", "--id", "S",
                                "--out", "{root}"]),
    Job("prep", "images", ["prep", "{images}", "--metadata", "{root}/metadata", "--out", "{root}/out", "--id", "S"]),
    Job("normalise", "town", ["normalise", "{scene}"]),
    Job("prior", "town", ["prior", "--per-image", "--resolution", "1", "{scene}"]),
    Job("fit", "town", ["fit", *FIT, "--prior-weight", "0", "{scene}"], ["--resume"]),
    Job("fit with its prior", "town", ["fit", *FIT, "{scene}"], ["--resume"]),
    Job("fit in tiles", "town", ["fit", "--resolution", "2", "--coarsest", "2", "--epochs", "12", "--tile", "32",
                                 "--overlap", "8", "--prior-weight", "0", "{scene}"], ["--resume"]),
    Job("fit mlp", "prior", ["fit", *NETWORK, "{scene}"], ["--resume"]),
    Job("fit voxel", "prior", ["fit", *VOXEL, "{scene}"], ["--resume"]),
    Job("fit rpv", "hill", ["fit", "--brdf", "rpv", "--resolution", "8", "--epochs", "8", "{scene}"], ["--resume"]),
    Job("fit hapke", "hill", ["fit", "--brdf", "hapke", "--resolution", "8", "--epochs", "8", "{scene}"], ["--resume"]),
    Job("export", "fitted", ["export", "--view", "TOWN_002", "{scene}"]),
    Job("compare", "exported", ["compare", "--views", "{scene}"]),
    Job("report", "exported", ["report", "{scene}"]),
    Job("batch", "town",
        ["batch", "--workers", "1", "--out", "{root}/batch", "--config", "{root}/quick.toml", "{scene}"],
        []),
]  # fmt: skip


class Bench:
    """Prepared scenes, undisturbed ends, and what was found."""

    def __init__(self, out: Path, seed: int) -> None:
        self.out, self.random = out, random.Random(seed)
        self.found: list[str] = []
        shutil.rmtree(out, ignore_errors=True)
        (out / "scenes/nothing").mkdir(parents=True)

    def prepare(self) -> None:
        """Make the scenes that jobs begin with."""
        town = ["simulate", "--size", "48", "--views", "4", "--dates", "3", "--gsd", "1", "--id", "TOWN"]
        hill = ["simulate", "--terrain", "natural", "--size", "128", "--views", "7", "--units", "3", "--id", "HILL"]
        for name, command in (("town", town), ("hill", hill)):
            self.must([*command, "--out", str(self.out / "made")])
            shutil.move(self.out / "made" / command[-1], self.scene(name))
            relative(self.scene(name))
        (self.scene("town") / "quick.toml").write_text("[fit]\nepochs = [2]\nresolution = 2\nprior-weight = 0\n")
        steps = (("prior", "town", ["prior", "--resolution", "1"]), ("fitted", "prior", ["fit", *FIT]),
                 ("exported", "fitted", ["export", "--view", "TOWN_002"]))  # fmt: skip
        for name, before, command in steps:
            shutil.copytree(self.scene(before), self.scene(name))
            self.must([*command, str(self.scene(name) / "scene.json")])
            relative(self.scene(name))
        images = self.scene("images")
        for part in ("images", "metadata"):
            shutil.copytree(self.scene("town") / part, images / part)

    def scene(self, name: str) -> Path:
        return self.out / "scenes" / name

    def must(self, arguments: list[str]) -> Result:
        done = run(["--threads", "1", "-q", *arguments], self.out / "run")
        if done.status:
            sys.exit(f"{arguments[0]} failed undisturbed: {done.stderr}")
        return done

    def fresh(self, job: Job, name: str) -> tuple[Path, list[str]]:
        """A copy of the job's scene, and the command on it."""
        root = self.out / name
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(self.scene(job.source), root)
        images = sorted(str(path) for path in (root / "images").glob("*.tif"))
        command = ["--threads", "1", "-q"]
        for part in job.arguments:
            filled = part.replace("{scene}", f"{root}/scene.json").replace("{root}", str(root))
            command += images if part == "{images}" else [filled]
        return root, command

    def blame(self, job: Job, what: str) -> None:
        self.found.append(f"{job.name}: {what}")
        print("FOUND", self.found[-1], flush=True)

    # ---- kills ------------------------------------------------------------------------------------------

    def kill(self, job: Job, whole: dict[str, str], seconds: float) -> int:
        """One run with up to three interruptions; how many there were."""
        root, command = self.fresh(job, "work")
        known = [contents(root), whole]
        count, wanted = 0, self.random.choice((1, 1, 2, 3))
        while count < wanted:
            again = job.again if count else []
            killed = temporary(root)  # which this run may not come to
            child = start([*command[:3], command[3], *again, *command[4:]], self.out / "run", cwd=root)
            time.sleep(self.random.uniform(0, 1.05 * seconds))
            number = self.random.choice(SIGNALS)
            if not child.alive():
                child.wait()
                break
            os.kill(child.pid, number)
            done = child.wait()
            count += 1
            wait_for_orphans(root)
            if done.timed_out:
                self.blame(job, f"hung after signal {number.name}")
            elif done.status not in (EXPECTED[number], 0):
                self.blame(job, f"{number.name} gave status {done.status}: {done.stderr[-300:]}")
            if done.traceback:
                self.blame(job, f"{number.name} gave a traceback: {done.stderr[-300:]}")
            left = [name for name in temporary(root) if name not in killed]
            if number != signal.SIGKILL and done.status != 0 and left:
                self.blame(job, f"{number.name} left {left[0]}")
            self.check_files(job, root, known, number.name)
        again = [] if finished(job, root) else job.again
        done = run([*command[:3], command[3], *(again or ["--overwrite"]), *command[4:]], self.out / "run", cwd=root)
        if done.status:
            self.blame(job, f"could not be finished: {done.stderr[-300:]}")
        else:
            self.check_end(job, root, whole)
        return count

    def check_files(self, job: Job, root: Path, known: list[dict[str, str]], what: str) -> None:
        """Every file of the folder is as before, as at the end, or belongs to an unfinished fit."""
        for name, hash_ in contents(root).items():
            partial = (
                "checkpoint" in name or "/tiles/" in name or name.startswith("batch/") or name.endswith("trace.csv")
            )
            if not partial and all(files.get(name) != hash_ for files in known):
                self.blame(job, f"{what} left {name} neither old nor whole")
            if name.endswith(".safetensors"):
                from sattools.errors import InputError
                from sattools.fit.checkpoint import load

                try:
                    load(root / name)
                except InputError as error:
                    self.blame(job, f"{what} damaged {error}")

    def check_end(self, job: Job, root: Path, whole: dict[str, str]) -> None:
        end = contents(root)
        for name in sorted(whole.keys() | end.keys()):
            if name not in end:
                self.blame(job, f"after the end {name} is missing")
            elif name not in whole:
                self.blame(job, f"after the end {name} is left over")
            elif end[name] != whole[name]:
                self.blame(job, f"after the end {name} differs")
        if left := temporary(root):
            self.blame(job, f"after the end {left[0]} is left over")

    # ---- full disk --------------------------------------------------------------------------------------

    def fill_disk(self, job: Job, sizes: list[int]) -> int:
        """Run the job again over its own results with ever less room; how many runs failed as they must."""
        failed = 0
        root, command = self.fresh(job, "work")
        first = run(command, self.out / "run", cwd=root)
        assert first.status == 0, first.stderr
        before = contents(root)
        for size in sizes:
            again = [*command[:4], "--overwrite", *command[4:]]
            done = run(again, self.out / "run", cwd=root, file_size=size - 1)
            failed += done.status != 0
            if done.traceback:
                self.blame(job, f"full disk ({size} bytes) gave a traceback: {done.stderr[-300:]}")
            if done.status not in (0, 1):
                self.blame(job, f"full disk ({size} bytes) gave status {done.status}")
            if done.status and (changed := [n for n, h in before.items() if contents(root).get(n) != h]):
                self.blame(job, f"full disk ({size} bytes) changed {changed[0]}")
            if done.status and (left := temporary(root)):
                self.blame(job, f"full disk ({size} bytes) left {left[0]}")
        return failed


def relative(root: Path) -> None:
    """A scene that may be copied."""
    document = json.loads((root / "scene.json").read_text())
    document["sattools"]["root"] = "."
    (root / "scene.json").write_text(json.dumps(document))


def finished(job: Job, root: Path) -> bool:
    """Whether a fit was done before it could be interrupted."""
    if job.again != ["--resume"]:
        return False
    document = json.loads((root / "scene.json").read_text())
    return "model" in document["sattools"]["products"]


def temporary(root: Path) -> list[str]:
    return [str(path.relative_to(root)) for path in root.rglob(".*tmp-sattools*")]


def wait_for_orphans(root: Path) -> None:
    """Wait for processes that work below a folder: those of a killed batch end by themselves."""
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        busy = subprocess.run(["pgrep", "-f", str(root)], capture_output=True, text=True, check=False).stdout.split()
        if not [number for number in busy if int(number) != os.getpid()]:
            return
        time.sleep(0.05)


def contents(root: Path) -> dict[str, str]:
    """Digest of every file below a folder, without what differs from run to run."""
    found = {}
    for path in sorted(root.rglob("*")):
        name = str(path.relative_to(root))
        skip = (
            path.name in ("quick.toml", "sattools.log")
            or "tmp-sattools" in name
            or path.suffix in (".jsonl", ".png", ".html", ".parquet")
        )
        if path.is_file() and not skip and not name.endswith(("log.txt", "digests.json", "table.csv", "table.md")):
            found[name] = hashlib.sha256(stable(path, root)).hexdigest()
    return found


def stable(path: Path, root: Path) -> bytes:
    data = path.read_bytes().replace(str(root).encode(), b"ROOT")
    if path.suffix == ".json":
        return json.dumps(without(json.loads(data)), sort_keys=True).encode()
    if path.name == "trace.csv":
        rows = list(csv.DictReader(io.StringIO(data.decode())))
        return json.dumps([{k: v for k, v in row.items() if k != "seconds"} for row in rows]).encode()
    return data


def without(value: Any) -> Any:
    """A document without measured times, and without the options by which an interrupted command is finished."""
    if isinstance(value, dict):
        # a command that was done before it could be killed is in the history twice
        drop = LIVE | {"history", "key"} | {k for k in value if k.endswith("_s")}
        return {k: without(v) for k, v in value.items() if k not in drop}
    return [without(v) for v in value] if isinstance(value, list) else value


# ---- a cluster that dies ----------------------------------------------------------------------------------------


def cluster(bench: Bench, trials: int) -> int:
    """Batches on a Dask scheduler over TCP whose worker or scheduler is killed; run again on a new one. Trials done."""
    job = JOBS[-1]
    root, command = bench.fresh(job, "whole")
    assert run(command, bench.out / "run", cwd=root).status == 0
    whole = contents(root)
    for k in range(trials):
        root, command = bench.fresh(job, "work")
        for attempt in range(2):
            with Cluster() as dask:
                extra = ["--scheduler", dask.address]
                child = start([*command[:4], *extra, *command[4:]], bench.out / "run", cwd=root)
                if attempt == 0:
                    time.sleep(bench.random.uniform(0.2, 6))
                    (dask.worker if k % 2 else dask.scheduler).kill()
                    if k % 2:
                        dask.start_worker()
                done = child.wait(300)
                if done.timed_out:
                    bench.blame(job, f"hung after its {'worker' if k % 2 else 'scheduler'} died")
                if done.traceback:
                    bench.blame(job, f"traceback after its cluster died: {done.stderr[:1500]}")
                if done.status == 0:
                    break
            wait_for_orphans(root)
            bench.check_files(job, root, [contents(bench.scene(job.source)), whole], "dead cluster")
        if done.status:
            bench.blame(job, f"could not be finished on a new cluster: {done.stderr[-300:]}")
        else:
            bench.check_end(job, root, whole)
    return trials


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--clusters", type=int, default=4, help="batches on a Dask cluster that dies")
    parser.add_argument("--jobs", nargs="*", help="names of the jobs (default: all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("faults"))
    options = parser.parse_args()
    preload()
    bench = Bench(options.out.absolute(), options.seed)
    bench.prepare()
    jobs = [job for job in JOBS if not options.jobs or job.name in options.jobs]
    ends, table = {}, {}
    for job in jobs:
        root, command = bench.fresh(job, "whole")
        done = run(command, bench.out / "run", cwd=root)
        if done.status:
            sys.exit(f"{job.name} failed undisturbed: {done.stderr}")
        ends[job.name] = (contents(root), done.seconds)
        new = [
            p for p in root.rglob("*") if p.is_file() and not (bench.scene(job.source) / p.relative_to(root)).exists()
        ]
        sizes = sorted({p.stat().st_size for p in [*new, *root.glob("scene.json")] if p.stat().st_size})
        table[job.name] = {"seconds": round(done.seconds, 2), "sizes": sizes, "kills": 0, "full_disks": 0}
    for job in jobs:
        sizes = table[job.name]["sizes"]
        # a batch writes below itself what its commands write; those have their own rows
        if job.name not in ("batch", "fit in tiles"):
            table[job.name]["full_disks"] = bench.fill_disk(job, sizes)
        print(job.name, table[job.name], flush=True)
    total = 0
    while total < options.kills:
        for job in jobs:
            count = bench.kill(job, *ends[job.name])
            table[job.name]["kills"] += count
            total += count
        print(f"{total} kills, {len(bench.found)} found", flush=True)
    dead = cluster(bench, options.clusters) if not options.jobs or "batch" in options.jobs else 0
    for name, row in table.items():
        print(f"{name:20s} {row['seconds']:7.2f} s   {row['kills']:4d} kills   {row['full_disks']:3d} full disks")
    print(f"{total} kills, {sum(r['full_disks'] for r in table.values())} full disks, {dead} dead clusters:", end=" ")
    print(f"{len(bench.found)} found")
    (options.out / "faults.json").write_text(json.dumps({"jobs": table, "found": bench.found}, indent=1))
    sys.exit(bool(bench.found))


if __name__ == "__main__":
    main()

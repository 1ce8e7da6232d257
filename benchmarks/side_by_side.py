"""What several processes bring to the tiles of one `fit`: seconds, CPU seconds and memory with 1 and more threads.

    python benchmarks/side_by_side.py SCENE.json --out FOLDER [--tile 448] [--threads 1 2] [--runs 3] [--batch]

Fits copies of the scene's document without what was made of it, in turns; every model must be equal to the bit. With
--batch the same by `batch`, whose workers fit the tiles: one worker with all threads (what it did up to November 2026
on two cores) and its own choice.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import statistics
from pathlib import Path

from launched import Outcome, command

from sattools.scene import Scene
from sattools.scene.copies import in_another_root


def bare(document: Path, folder: Path) -> Path:
    """A copy of a scene in a new folder, as `prep` left it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    made = Scene.from_file(in_another_root(document, folder))
    made.products, made.history = {}, []
    return made.write()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tile", type=float, default=448.0)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--batch", action="store_true")
    options = parser.parse_args()
    most = max(options.threads)
    ways = {f"fit, {n} threads": (n, ["fit", "--tile", str(options.tile)]) for n in options.threads}
    if options.batch:
        config = options.out / "cut.toml"
        options.out.mkdir(parents=True, exist_ok=True)
        config.write_text(f"[fit]\ntile = {options.tile}\n", encoding="utf-8")
        call = ["batch", "--config", str(config), "--out"]
        ways[f"batch, 1 worker of {most} threads"] = (most, [*call, str(options.out / "one"), "--workers", "1"])
        ways[f"batch, {most} threads"] = (most, [*call, str(options.out / "own")])
    found: dict[str, list[Outcome]] = {name: [] for name in ways}
    models = set()
    for _ in range(options.runs):
        for name, (threads, call) in ways.items():
            document = bare(options.scene, options.out / "scene")
            for folder in ("one", "own"):
                shutil.rmtree(options.out / folder, ignore_errors=True)
            done = command(*call, str(document), "--threads", str(threads), "--quiet")
            if done.status:
                raise SystemExit(f"{name}: exit status {done.status}")
            found[name].append(done)
            found_models = options.out.rglob("fit/model.safetensors")
            (model,) = [path for path in found_models if path.parents[2].name != "tiles"]
            models.add(hashlib.sha256(model.read_bytes()).hexdigest()[:16])
    first = statistics.median(done.seconds for done in next(iter(found.values())))
    for name, runs in found.items():
        seconds, spent = (statistics.median(getattr(done, what) for done in runs) for what in ("seconds", "cpu_s"))
        peak = max(done.peak_gb for done in runs)
        print(f"{name:30s} {seconds:7.1f} s ({seconds / first:.2f}), {spent:7.1f} CPU s, {peak:.2f} GiB a process")
    print("models:", *sorted(models))


if __name__ == "__main__":
    main()

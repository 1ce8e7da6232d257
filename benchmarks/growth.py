"""How `prior` and `fit` grow with the area and with the number of images, and how much errors depend on the seed.

    python benchmarks/growth.py [--sizes 64 128 256 512] [--views 3 6 12 17] [--out FOLDER]
    python benchmarks/growth.py SCENE.json DSM --seeds 0 1 2

Areas: simulated cities of six images; images: a city of 128 m. CPU seconds of the whole command, which suffer less
from other programs than the clock, start-up included; the exponent is that of a power law through all points.
With --seeds a scene is fitted once per seed and scored: mean and spread of the error.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", type=Path)
    parser.add_argument("dsm", nargs="?", type=Path)
    parser.add_argument("--sizes", nargs="*", type=int, default=[64, 128, 256, 512], help="edges of the areas [m]")
    parser.add_argument("--views", nargs="*", type=int, default=[3, 6, 12, 17], help="numbers of images")
    parser.add_argument("--seeds", nargs="*", type=int, help="seeds of the fit of SCENE, scored against DSM")
    parser.add_argument("--out", type=Path, default=Path("growth"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.seeds:
        if options.scene is None or options.dsm is None:
            parser.error("--seeds expects SCENE.json and DSM")
        spread(options.scene, options.dsm, options.seeds)
        return
    rows = [measure("area", size, 6) for size in options.sizes]
    rows += [measure("views", 128, views) for views in options.views]
    with open(options.out / "growth.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    for kind in ("area", "views"):
        own = [row for row in rows if row["kind"] == kind]
        if len(own) < 2:
            continue
        amount = [row["size_m"] ** 2 if kind == "area" else row["views"] for row in own]
        for name in ("prior_cpu_s", "fit_cpu_s", "prior_mb", "fit_mb"):
            print(f"{kind}: {name} grows with exponent {exponent(amount, [row[name] for row in own]):.2f}")


def measure(kind: str, size: int, views: int) -> dict[str, Any]:
    """One simulated city through prior and fit."""
    with tempfile.TemporaryDirectory() as folder:
        run("simulate", "--out", folder, "--size", size, "--views", views, "--dates", min(6, views))
        scene = Path(folder) / "SIM_001/scene.json"
        row: dict[str, Any] = {"kind": kind, "size_m": size, "views": views}
        for command in ("prior", "fit"):
            line, cpu, wall = run(command, scene)
            entry = json.loads(line)["sattools"]["history"][-1]
            row |= {f"{command}_cpu_s": round(cpu, 2), f"{command}_s": round(wall, 2)}
            row[f"{command}_mb"] = entry["peak_memory_mb"]
    print(row, flush=True)
    return row


def run(*arguments: object) -> tuple[str, float, float]:
    """A command of the suite on one thread: stdout, CPU seconds, seconds."""
    before, start = os.times(), time.perf_counter()
    command = [sys.executable, "-m", "sattools", "-q", "--threads", "1", *map(str, arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return done.stdout, cpu, time.perf_counter() - start


def exponent(amounts: list[float], values: list[float]) -> float:
    """Slope of log value over log amount, least squares."""
    x, y = [math.log(a) for a in amounts], [math.log(v) for v in values]
    mx, my = sum(x) / len(x), sum(y) / len(y)
    return sum((a - mx) * (b - my) for a, b in zip(x, y, strict=True)) / sum((a - mx) ** 2 for a in x)


def spread(scene: Path, dsm: Path, seeds: list[int]) -> None:
    """Fit the scene once per seed in a folder of its own."""
    from sattools.compare import compare_dsm, read_reference
    from sattools.scene.copies import in_another_root

    truth, errors = read_reference(dsm), []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            copy = in_another_root(scene, Path(folder) / "fit")
            run("fit", copy, "--seed", seed, "--overwrite")
            run("export", copy, "--overwrite")
            figures = compare_dsm(Path(folder) / "fit/export/dsm.tif", truth).figures
        errors.append(figures["mae"])
        print(f"seed {seed}: MAE {figures['mae']:.4f} m, median {figures['median']:.4f} m", flush=True)
    mean = sum(errors) / len(errors)
    deviation = math.sqrt(sum((e - mean) ** 2 for e in errors) / max(1, len(errors) - 1))
    print(f"{len(seeds)} seeds: MAE {mean:.3f} m, standard deviation {deviation:.4f} m")


if __name__ == "__main__":
    main()

"""Does an area fitted in tiles equal the same area fitted at once, and what memory does a tile need?

    python benchmarks/tiles.py [--seeds 5 6 7] [--size 256] [--tile 128] [--overlap 32] [--out FOLDER]
    python benchmarks/tiles.py --memory 256 512 [--tile 128]

First: simulated cities, untiled and tiled. Errors of both; and the step of the *difference* between the two surfaces
across every seam (the line in the middle of an overlap), against the 95th percentile of the same measure along all
other lines of cells: a seam would show as a line along which the tiled surface steps where the untiled one does not.
Second: peak memory and CPU seconds of the commands that an area of that edge needs: the coarse pass, one tile, and the
joining, each a process of its own, beside the untiled fit.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", nargs="*", type=int, default=[5, 6, 7], help="seeds of the cities")
    parser.add_argument("--size", type=int, default=256, help="edge of the cities [m]")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--tile", type=float, default=128.0)
    parser.add_argument("--overlap", type=float, default=32.0)
    parser.add_argument("--memory", nargs="*", type=int, help="edges of the areas [m]")
    parser.add_argument("--out", type=Path, default=Path("tiles"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    cut = ["--tile", str(options.tile), "--overlap", str(options.overlap)]
    if options.memory:
        rows = [memory(size, options.views, cut) for size in options.memory]
        write(options.out / "memory.csv", rows)
        return
    rows = [likeness(seed, options.size, options.views, cut) for seed in options.seeds]
    write(options.out / "tiles.csv", rows)
    worst = max(abs(row["tiled_mae_m"] - row["untiled_mae_m"]) for row in rows)
    print(f"largest difference of the errors: {worst:.4f} m")
    print(f"seams within the 95th percentile: {sum(row['seams_within'] for row in rows)} of "
          f"{sum(row['seams'] for row in rows)}")  # fmt: skip


def likeness(seed: int, size: int, views: int, cut: list[str]) -> dict[str, Any]:
    """One city, both ways."""
    from sattools.compare import compare_dsm, read_reference
    from sattools.fit.options import FitOptions
    from sattools.fit.tiles.plan import Plan

    with tempfile.TemporaryDirectory() as folder:
        scene = simulate(folder, size, views, seed)
        truth = read_reference(scene.path("truth/SIM_001_DSM.tif"))
        found, seconds = [], []
        for extra in ([], cut):
            _, taken, _ = run("fit", *extra, "--overwrite", scene.root / "scene.json")
            found.append(model(scene.root))
            seconds.append(taken)
            (scene.root / "scene.json").write_text(scene.to_json() + "\n")  # without the prior of the fit before
        errors = [compare_dsm(height, truth, grid).figures["mae"] for height, grid in found]
        plan = Plan.make(scene, FitOptions(tile=float(cut[1]), overlap=float(cut[3])))
        step = [seams(found[1][0] - found[0][0], axis, plan) for axis in (0, 1)]
    lines = [line for one in step for line in one["seams"]]
    row = {
        "seed": seed,
        "size_m": size,
        "tiles": len(plan.tiles),
        "untiled_mae_m": round(errors[0], 4),
        "tiled_mae_m": round(errors[1], 4),
        "mean_difference_m": round(float(np.abs(found[1][0] - found[0][0]).mean()), 4),
        "seams": len(lines),
        "seams_within": sum(value <= one["limit"] for one in step for value in one["seams"]),
        "worst_seam_m": round(max(lines), 4),
        "p95_elsewhere_m": round(min(one["limit"] for one in step), 4),
        "untiled_s": round(seconds[0], 1),
        "tiled_s": round(seconds[1], 1),
    }
    print(row, flush=True)
    return row


def seams(difference: np.ndarray, axis: int, plan: Any) -> dict[str, Any]:
    """Mean absolute step of the difference [m] over the lines between cells along an axis: at seams, and the 95th
    percentile of all others."""
    steps = np.abs(np.diff(difference, axis=axis)).mean(axis=1 - axis)
    between = set()
    for tile in plan.tiles:
        span, before = ((tile.rows, tile.shared[0]), (tile.cols, tile.shared[2]))[axis]
        if before:
            first = span.start * plan.scene.require_grid().cell_size / plan.finest
            wide = before * plan.scene.require_grid().cell_size / plan.finest
            between.add(round(first + wide / 2) - 1)
    others = [value for k, value in enumerate(steps) if k not in between]
    return {"seams": [float(steps[k]) for k in sorted(between)], "limit": float(np.percentile(others, 95))}


def memory(size: int, views: int, cut: list[str]) -> dict[str, Any]:
    """Peak memory [MB] and seconds of every step over one city."""
    with tempfile.TemporaryDirectory() as folder:
        scene = simulate(folder, size, views, 1)
        path = scene.root / "scene.json"
        row: dict[str, Any] = {"size_m": size, "tile_m": float(cut[1]), "overlap_m": float(cut[3]), "views": views}
        _, row["coarse_s"], row["coarse_mb"] = run("fit", *cut, "--part", "split", path)
        tiles = sorted((scene.root / "fit/tiles").glob("r*/scene.json"))
        row["tiles"] = len(tiles)
        # the largest: with neighbours on all sides, from three by three tiles on
        _, row["tile_s"], row["tile_mb"] = run("fit", scene.root / "fit/tiles/r1c1/scene.json")
        for name in tiles:
            if not (name.parent / "fit/model.safetensors").exists():
                run("fit", name)
        bytes_there = sum(path.stat().st_size for path in (scene.root / "fit/tiles").rglob("*") if path.is_file())
        row["tiles_disk_mb"] = bytes_there / 2**20
        _, row["join_s"], row["join_mb"] = run("fit", *cut, "--part", "mosaic", path)
        path.write_text(scene.to_json() + "\n")
        _, row["untiled_s"], row["untiled_mb"] = run("fit", "--overwrite", path)
    print({name: round(value, 1) for name, value in row.items()}, flush=True)
    return row


def simulate(folder: str, size: int, views: int, seed: int) -> Any:
    """A city's scene."""
    from sattools.scene import Scene

    run("simulate", "--out", folder, "--size", size, "--views", views, "--seed", seed)
    return Scene.from_file(Path(folder) / "SIM_001/scene.json")


def model(root: Path) -> tuple[np.ndarray, Any]:
    """Heights of a fitted scene, and their grid."""
    from sattools.fit.checkpoint import load
    from sattools.scene import Grid

    tensors, meta = load(root / "fit/model.safetensors")
    return tensors["height"].numpy(), Grid.from_dict(meta["grid"])


def run(*arguments: object) -> tuple[str, float, float]:
    """A command of the suite on one thread: stdout, CPU seconds with start-up (which suffer less from other programs
    than the clock), peak memory [MB] as its history says."""
    before = os.times()
    command = [sys.executable, "-m", "sattools", "-q", "--threads", "1", *map(str, arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=dict(os.environ))
    after = os.times()
    taken = after.children_user + after.children_system - before.children_user - before.children_system
    return done.stdout, taken, json.loads(done.stdout)["sattools"]["history"][-1]["peak_memory_mb"]


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Rows as CSV."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()

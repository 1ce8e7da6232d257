"""Field samples per second of a fit, against the rate at which this machine reads textures at all.

    python benchmarks/throughput.py [SCENE.json] [--epochs 5] [--repeats 5] [--threads N] [--json FILE]

The fit is a real one, losses, smoothness, shadows, poses and optimiser included; a sample that is read forward and
again backward counts once. The rate to compare with is torch's `grid_sample` of a texture of the same size and number
of channels (1 height and the colours), one sample per cell, at positions moved as on a height plane, forward and
backward to the texture. Both are measured in turns within one process with the same threads, and medians of the
quotients are given.

One thread by default: torch reads a single texture with one thread however many there are, so that more threads would
only flatter the fit. Steps of a ray through empty air, which read the map of highest surfaces and find that nothing is
near, count as samples (about four in ten); the first epoch of every stage, which resamples the images, is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", type=Path, help="scene.json; without it a city is simulated")
    parser.add_argument("--epochs", type=int, default=5, help="passes over all views per stage")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the result here")
    options = parser.parse_args()

    from sattools.cli import set_threads

    set_threads(options.threads)  # before torch and numba are imported
    import torch

    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(options.scene, Path(folder))
        fit_once(scene, 2)  # compiles
        repeats = []
        for number in range(options.repeats):
            stages = fit_once(scene, options.epochs)
            for stage in stages:
                stage["raw_samples_per_s"] = raw_rate(stage["shape"], stage["channels"])
                stage["ratio"] = stage["fit_samples_per_s"] / stage["raw_samples_per_s"]
            repeats.append(stages)
            print(f"run {number + 1} of {options.repeats}: ratio {overall(stages):.2f}", flush=True)
    result = {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores",
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "repeats": options.repeats,
        "ratio": round(statistics.median(overall(stages) for stages in repeats), 3),
        "stages": [summary([stages[k] for stages in repeats]) for k in range(len(repeats[0]))],
    }
    report(result)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")


def load_scene(path: Path | None, folder: Path) -> Any:
    """The scene with `folder` as its root, so that nothing is written into its own."""
    from sattools.scene import Scene
    from sattools.simulate import SimulateOptions, simulate

    if path is None:
        return simulate(SimulateOptions(), folder / "SIM_001")
    scene = Scene.from_file(path)
    for item in scene.items:
        for asset in item.assets.values():
            asset.href = str(scene.path(asset.href))
    scene.products = {name: str(scene.path(href)) for name, href in scene.products.items()}
    scene.root = folder
    return scene


def fit_once(scene: Any, epochs: int) -> list[dict[str, Any]]:
    """One fit; per stage the size of its textures, the samples and the seconds after the first epoch."""
    from sattools.fit.checkpoint import load
    from sattools.fit.options import FitOptions
    from sattools.fit.stage import fit
    from sattools.render.surface import COUNTER

    moments: list[tuple[str, float, int]] = []

    def watch(fraction: float, message: str) -> None:
        if ", epoch " in message:
            moments.append((message.split(",")[0], time.perf_counter(), COUNTER["forward"]))

    fit(scene, FitOptions(epochs=[epochs]), watch)
    tensors, _ = load(scene.path(scene.products["model"]))
    stages = []
    for name in dict.fromkeys(m[0] for m in moments):
        own = [m for m in moments if m[0] == name]
        seconds, samples = own[-1][1] - own[0][1], own[-1][2] - own[0][2]
        cell = float(name.split()[0])
        stages.append(
            {
                "cell_m": cell,
                "shape": scene.grid.resized(cell).shape,
                "channels": 1 + tensors["albedo"].shape[-1],
                "samples": samples,
                "seconds": seconds,
                "fit_samples_per_s": samples / seconds,
            }
        )
    return stages


def raw_rate(shape: tuple[int, int], channels: int, seconds: float = 0.5) -> float:
    """Samples per second of `grid_sample`, forward and backward."""
    import torch

    rows, cols = shape
    texture = torch.rand(1, channels, rows, cols, requires_grad=True)
    x = (torch.arange(cols) + 3.37) / (cols - 1) * 2 - 1  # moved by a few cells, as on a height plane
    y = (torch.arange(rows) - 1.71) / (rows - 1) * 2 - 1
    where = torch.stack([x.expand(rows, cols), y[:, None].expand(rows, cols)], dim=-1)[None]
    upstream = torch.rand(1, channels, rows, cols)

    def step() -> None:
        texture.grad = None
        torch.nn.functional.grid_sample(texture, where, padding_mode="border", align_corners=True).backward(upstream)

    for _ in range(3):
        step()
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        count += 1
    return count * rows * cols / (time.perf_counter() - start)


def overall(stages: list[dict[str, Any]]) -> float:
    """Seconds in which the raw rate would read all samples, over the seconds of the fit."""
    raw = sum(s["samples"] / s["raw_samples_per_s"] for s in stages)
    return raw / sum(s["seconds"] for s in stages)


def summary(stages: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians of one stage over the repeats."""
    rates = {
        name: round(statistics.median(s[name] for s in stages), 3)
        for name in ("fit_samples_per_s", "raw_samples_per_s", "ratio", "seconds")
    }
    return {name: stages[0][name] for name in ("cell_m", "shape", "channels", "samples")} | rates


def report(result: dict[str, Any]) -> None:
    """The table for people."""
    print(f"{result['machine']}, torch {result['torch']}, {result['threads']} threads, {result['repeats']} runs")
    print("cell [m]      texture   samples      fit [M/s]   grid_sample [M/s]   ratio")
    for s in result["stages"]:
        texture = f"{s['channels']} x {s['shape'][0]} x {s['shape'][1]}"
        fit, raw = s["fit_samples_per_s"] / 1e6, s["raw_samples_per_s"] / 1e6
        print(f"{s['cell_m']:8g} {texture:>12} {s['samples']:9d} {fit:14.1f} {raw:19.1f} {s['ratio']:7.2f}")
    print(f"all stages, weighted by time: ratio {result['ratio']:.2f}")


if __name__ == "__main__":
    main()

"""Surface, density grid and networks on one scene in one run: samples per second, and error after equal seconds.

    python benchmarks/field_speed.py [--seconds 60] [--seed 1] [--size 64] [--width N] [--fields ...] [--out FILE.json]

Every field gets the same seconds of training on the same simulated city (six views, exact cameras) with one thread,
the surface ends sooner if its 16 epochs are done; surface and grid start from the depth prior, whose seconds are
given beside; so do the networks, but for those marked "noise", which start as in their papers. Samples are
positions at which a field was evaluated forward in a training step, those of rays to the sun included; scoring does
not count. Not measured on a GPU.
"""

from __future__ import annotations

import argparse
import csv
import json
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

NETWORKS = ("eonerf", "eonerf-learned-shadow", "satnerf", "spsnerf", "rpv-nerf", "hapke-nerf")
FIELDS = ["surface", "voxel", *NETWORKS, "eonerf, noise", "satnerf, noise"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", type=float, default=64.0)
    parser.add_argument("--width", type=int, help="of the networks (default: the papers')")
    parser.add_argument("--fields", nargs="*", default=FIELDS)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()

    from sattools.cli import set_threads

    set_threads(1)
    import torch

    torch.set_num_threads(1)
    from sattools.prior import PriorOptions
    from sattools.prior.stage import prior
    from sattools.simulate import SimulateOptions, simulate

    with tempfile.TemporaryDirectory() as folder:
        scene = simulate(SimulateOptions(size=options.size, views=6, dates=3, seed=options.seed), Path(folder) / "S")
        prior(scene, PriorOptions())  # compiles
        begun = time.perf_counter()
        prior(scene, PriorOptions())
        rows = [
            {
                "field": "prior alone",
                "seconds": round(time.perf_counter() - begun, 1),
                "MAE [m]": error(scene, "prior_dsm"),
            }
        ]
        for name in options.fields:
            rows.append(run(scene, name, options))
            print(rows[-1], flush=True)
    names = list(dict.fromkeys(n for row in rows for n in row))
    print("| " + " | ".join(names) + " |\n|" + "---|" * len(names))
    for row in rows:
        print("| " + " | ".join(str(row.get(n, "")) for n in names) + " |")
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


def run(scene: Any, name: str, options: argparse.Namespace) -> dict[str, Any]:
    """One field for the given seconds."""
    from sattools.field.mlp import MlpField
    from sattools.field.voxel import VoxelField
    from sattools.fit.presets import resolve
    from sattools.fit.stage import fit
    from sattools.render.surface import COUNTER

    counted = {"points": 0}
    kept = {cls: cls.density for cls in (MlpField, VoxelField)}
    for cls, density in kept.items():

        def count(self: Any, points: Any, density: Any = density) -> Any:
            counted["points"] += len(points)
            return density(self, points)

        cls.density = count  # type: ignore[method-assign]
    given: dict[str, Any] = {"budget": options.seconds}
    if name in ("surface", "voxel"):
        chosen = resolve("fast", {**given, "resolution": 1.0, "field": name, "steps": 10**6})
    else:
        preset, _, start = name.partition(", ")
        chosen = resolve(preset, {**given, "width": options.width, "start": start or "prior"})
    before = COUNTER["forward"]
    if name == "surface":
        fit(scene, resolve("fast", {"epochs": [1], "resolution": 1.0}))  # compiles
        before = COUNTER["forward"]
    ends: list[int] = []
    fit(scene, chosen, lambda share, text: ends.append(counted["points"]))
    for cls, density in kept.items():
        cls.density = density  # type: ignore[method-assign]
    with open(scene.path("fit/trace.csv"), newline="", encoding="utf-8") as file:
        seconds = float(list(csv.DictReader(file))[-1]["seconds"])
    samples = COUNTER["forward"] - before if name == "surface" else max(ends)
    return {
        "field": name,
        "seconds": round(seconds, 1),
        "samples/s": f"{samples / seconds / 1e6:.4f} M",
        "MAE [m]": error(scene, "model"),
        "peak [GB]": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }


def error(scene: Any, product: str) -> float:
    """MAE of a product against the truth."""
    from sattools.compare import compare_dsm, read_reference
    from sattools.fit.checkpoint import load
    from sattools.scene import Grid
    from sattools.scene.raster import read_raster

    path = scene.path(scene.products[product])
    if product == "model":
        tensors, meta = load(path)
        height, grid = tensors["height"].numpy(), Grid.from_dict(meta["grid"])
    else:
        array, grid = read_raster(path)
        height = array[0]
    truth = read_reference(str(scene.path(scene.products["truth_dsm"])))
    return round(float(compare_dsm(height, truth, grid).figures["mae"]), 3)


if __name__ == "__main__":
    main()

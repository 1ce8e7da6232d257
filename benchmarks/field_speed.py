"""Surface, density grid, columns and networks on one scene in one run: samples a second, error after equal seconds.

    python benchmarks/field_speed.py [--seconds 60] [--seed 1] [--size 64] [--width N] [--threads 1] [--fields ...]
        [--out FILE.json]

Every field gets the same seconds of training on the same simulated city (six views, exact cameras), with one thread
unless told otherwise; the surface ends sooner if its 16 epochs are done; surface and grid start from the depth prior,
whose seconds are given beside; so do the networks, but for those marked "noise", which start as in their papers.
Samples are positions on the rays of training steps, those of rays to the sun included, whether or not a field has to
be evaluated there: it need not be where a column is empty, or behind the last that is seen; scoring does not count.
CPU seconds are those of the whole fit, start and reading-off included: on a busy machine they say more than the
seconds. The last line is how many points a CPU second torch's `grid_sample` reads, forward and alone, of as many
values as the neural field has at a point. On a GPU: `gpu.py`.
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
FIELDS = ["surface", "voxel", "neural", *NETWORKS, "eonerf, noise", "satnerf, noise"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", type=float, default=64.0)
    parser.add_argument("--width", type=int, help="of the networks (default: the papers')")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--fields", nargs="*", default=FIELDS)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()

    from sattools.cli import set_threads

    set_threads(options.threads)
    import torch

    torch.set_num_threads(options.threads)
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
    print(f"grid_sample: {raw_rate() / 1e6:.2f} M points/CPU s")
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


def run(scene: Any, name: str, options: argparse.Namespace) -> dict[str, Any]:
    """One field for the given seconds."""
    from sattools.field.mlp import MlpField
    from sattools.field.neural import NeuralField
    from sattools.field.voxel import VoxelField
    from sattools.fit.presets import resolve
    from sattools.fit.stage import fit
    from sattools.render.columns import COUNTER as FOLLOWED
    from sattools.render.surface import COUNTER

    counted = {"points": 0}
    kept = {cls: cls.density for cls in (MlpField, NeuralField, VoxelField)}
    for cls, density in kept.items():

        def count(self: Any, points: Any, density: Any = density) -> Any:
            counted["points"] += len(points)
            return density(self, points)

        cls.density = count  # type: ignore[method-assign]
    given: dict[str, Any] = {"budget": options.seconds}
    if name in ("surface", "voxel"):
        chosen = resolve("fast", {**given, "resolution": 1.0, "field": name, "steps": 10**6})
    elif name == "neural":
        chosen = resolve("fast", {**given, "field": name, "steps": 10**6})
    else:
        preset, _, start = name.partition(", ")
        chosen = resolve(preset, {**given, "width": options.width, "start": start or "prior"})
    before = COUNTER["forward"]
    if name == "surface":
        fit(scene, resolve("fast", {"epochs": [1], "resolution": 1.0}))  # compiles
        before = COUNTER["forward"]
    ends: list[int] = []
    followed = FOLLOWED["forward"]  # by kernels that do not ask the field
    begun = time.process_time()
    fit(scene, chosen, lambda share, text: ends.append(counted["points"] + FOLLOWED["forward"] - followed))
    used = time.process_time() - begun
    for cls, density in kept.items():
        cls.density = density  # type: ignore[method-assign]
    with open(scene.path("fit/trace.csv"), newline="", encoding="utf-8") as file:
        seconds = float(list(csv.DictReader(file))[-1]["seconds"])
    samples = COUNTER["forward"] - before if name == "surface" else max(ends)
    return {
        "field": name,
        "seconds": round(seconds, 1),
        "samples/s": f"{samples / seconds / 1e6:.4f} M",
        "CPU [s]": round(used, 1),
        "samples/CPU s": f"{samples / used / 1e6:.4f} M",
        "MAE [m]": error(scene, "model"),
        "peak [GB]": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }


def raw_rate(points: int = 2048 * 32, cells: int = 128, layers: int = 50) -> float:
    """Points a CPU second that `grid_sample` reads of the maps and volumes of a neural field of three bands."""
    import torch
    from torch.nn.functional import grid_sample

    where = torch.rand(1, 1, points, 2) * 2 - 1
    inside = torch.rand(1, 1, 1, points, 3) * 2 - 1
    maps = [torch.rand(1, channels, cells, cells) for channels in (7, 9)]
    volumes = [torch.rand(1, 3, layers // n, cells // (2 * n), cells // (2 * n)) for n in (1, 2, 4)]
    seconds = []
    for _ in range(10):
        begun = time.process_time()
        for values in maps:
            grid_sample(values, where, align_corners=False)
        for values in volumes:
            grid_sample(values, inside, align_corners=True)
        seconds.append(time.process_time() - begun)
    return points / sorted(seconds)[len(seconds) // 2]


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

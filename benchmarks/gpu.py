"""Fits on a GPU: seconds from a prior to the model, error, samples a second, memory; and where a step's time goes.

    python benchmarks/gpu.py SCENE.json=REFERENCE.tif[@REGION] [--fields surface neural eonerf ...] [--runs 2]
        [--device cuda] [--steps N] [--rays N] [--width N] [--samples N] [--resolution M] [--seed N] [--budget S]
        [--start noise] [--tf32] [--profile] [--out FILE.json]
    python benchmarks/gpu.py IMAGES/=REFERENCE.tif[@REGION] [--metadata FOLDER] ...

The scene has a prior (`sattools prior`). Of a folder of images one is made first, by the whole pipe with its surface,
as often as asked for. Each fit is that of `sattools fit --preset NAME` or `--field NAME` with the options of this
version; `surface-torch` is the surface rendered by plain torch on the device instead of compiled kernels. All is done
in this process: the first run of each also compiles and starts CUDA, and is told apart. Errors by the protocol, after
`export`. `--start noise` is the papers' own way, with their samples, and tells the error after every twentieth of the
steps (which its seconds do not count). `--tf32` lets the card round to 10 bits what it multiplies. `--profile` adds
milliseconds of ten steps of networks and neural fields, in all and on the device, and the operations that take the
most.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from papers import counted_points, scored

from sattools import api
from sattools.fit import whole
from sattools.fit.presets import PRESETS, resolve
from sattools.fit.rays.recorded import RecordedSteps
from sattools.fit.rays.trainer import RayTrainer
from sattools.scene import Scene
from sattools.scene.copies import absolute_copy
from sattools.scene.raster import read_raster

PROFILED = range(20, 30)
TORCH = "surface-torch"
NETWORK = ("steps", "rays", "width", "samples", "resolution", "seed", "start")  # options of what is no surface


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", metavar="SCENE=REFERENCE[@REGION]")
    parser.add_argument("--metadata", help="of a folder of images")
    parser.add_argument("--fields", nargs="*", default=["surface", "neural", "eonerf"])
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--rays", type=int)
    parser.add_argument("--width", type=int)
    parser.add_argument("--samples", type=int)
    parser.add_argument("--resolution", type=float)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--budget", type=float)
    parser.add_argument("--start", choices=["surface", "prior", "noise"], help="of networks")
    parser.add_argument("--tf32", action="store_true")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--keep", type=Path, help="folder for the scenes (default: a temporary one)")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    card = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    print(f"{card}, {torch.get_num_threads()} threads, torch {torch.__version__}", flush=True)
    torch.set_float32_matmul_precision("high" if options.tf32 else "highest")
    rows: list[dict[str, Any]] = []

    def add(row: dict[str, Any]) -> None:
        rows.append(row)
        print(json.dumps(row), flush=True)
        if options.out:
            options.out.write_text(json.dumps({"card": card, "rows": rows}, indent=1) + "\n")

    with tempfile.TemporaryDirectory() if options.keep is None else nullcontext(options.keep) as folder:
        path, _, against = options.scene.partition("=")
        if Path(path).is_dir():
            images = sorted(str(p) for p in Path(path).iterdir() if p.suffix.lower() in (".tif", ".ntf", ".jp2"))
            for number in range(options.runs):
                scene, matched, row = pipe(images, options.metadata, Path(folder) / f"pipe_{number}")
                add({"field": "whole pipe", "run": number, **errors_of(scene, against), **row})
            path = str(matched)
            print(f"scene with its prior: {path}", flush=True)
        for field in options.fields:
            if options.profile and field not in ("surface", TORCH):
                profile(field, path, options)
            for number in range(options.runs):
                target = Path(folder) / f"{field}_{number}"
                add({"field": field, "run": number, **run(field, path, against, target, options)})


def pipe(images: list[str], metadata: str | None, folder: Path) -> tuple[Scene, Path, dict[str, Any]]:
    """Its scene, the document of the scene with its prior, seconds and CPU seconds of every step, in this process."""
    found: dict[str, Any] = {}
    begun, used = time.perf_counter(), time.process_time()

    def told(name: str) -> None:
        nonlocal begun, used
        now, cpu = time.perf_counter(), time.process_time()
        found[name] = [round(now - begun, 2), round(cpu - used, 2)]
        begun, used = now, cpu

    given = {"id": "SCENE", "out": str(folder), **({"metadata": metadata} if metadata else {})}
    scene = api.prepare(images, given)
    told("prep")
    scene = api.match(scene)
    told("prior")
    matched = folder / "matched.json"
    matched.write_text(scene.to_json() + "\n")
    scene = api.fit(scene)
    told("fit")
    scene = api.export(scene)
    told("export")
    return scene, matched, {"seconds": round(sum(seconds for seconds, _ in found.values()), 2), **found}


def errors_of(scene: Scene, against: str) -> dict[str, float]:
    """Error of the exported surface by the protocol [m]."""
    height, grid = read_raster(scene.path(scene.products["dsm"]))
    return {"MAE": round(scored(height[0], grid, against)["MAE"], 4)}


def run(field: str, path: str, against: str, folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """One fit from the prior, exported and scored."""
    from sattools.export.options import ExportOptions
    from sattools.export.stage import export
    from sattools.fit.stage import fit

    given: dict[str, Any] = {"device": options.device, "budget": options.budget}
    if field not in (*PRESETS, TORCH):
        given["field"] = field
    if field not in ("surface", TORCH):
        given |= {name: value for name in NETWORK if (value := getattr(options, name))}
    if options.start == "noise":
        given["reference"] = against
    chosen = resolve(field if field in PRESETS else "fast", given)
    scene = absolute_copy(Scene.from_file(path), folder)
    points, cuda = with_replayed(counted_points()), torch.cuda.is_available()
    told: list[tuple[float, int, str]] = []
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    before, whole.SURFACE_DEVICE = whole.SURFACE_DEVICE, torch.device(options.device if field == TORCH else "cpu")
    begun, used = time.perf_counter(), time.process_time()
    try:
        fit(scene, chosen, lambda share, text: told.append((time.perf_counter(), points(), text)))
    finally:
        whole.SURFACE_DEVICE = before
    ended, used = time.perf_counter(), time.process_time() - used
    export(scene, ExportOptions())
    steps = [one for one in told if one[2].startswith("step ")]
    row = errors_of(scene, against)
    row |= {"seconds": round(ended - begun, 2), "CPU s": round(used, 2)}
    row |= {"export s": round(time.perf_counter() - ended, 2)}
    if len(steps) > 1:
        (first, before_it, _), (last, count, text) = steps[0], steps[-1]
        row |= {"start s": round(first - begun, 2), "after steps s": round(ended - last, 2)}
        row |= {"steps": text.split(",")[0], "M samples/s": round((count - before_it) / (last - first) / 1e6, 2)}
    if options.start == "noise":
        with open(scene.root / "fit" / "trace.csv", newline="") as file:
            row["trace"] = [[one["seconds"], one["step"], one.get("mae_m")] for one in csv.DictReader(file)]
    if cuda:
        row["GPU GB"] = round(torch.cuda.max_memory_allocated() / 2**30, 2)
    return row


def with_replayed(points: Callable[[], int]) -> Callable[[], int]:
    """The same count with those of recorded steps, which are asked for when the step is recorded and not again."""
    again, known, plain = [0], dict[Any, int](), RecordedSteps.step

    def step(self: RecordedSteps, phase: Any, chosen: torch.Tensor, *given: Any) -> torch.Tensor:
        before = points()
        loss = plain(self, phase, chosen, *given)
        if asked := points() - before:
            known[phase, len(chosen)] = asked
        else:
            again[0] += known[phase, len(chosen)]
        return loss

    RecordedSteps.step = step  # type: ignore[method-assign]
    return lambda: points() + again[0]


def profile(field: str, path: str, options: argparse.Namespace) -> None:
    """Print what ten steps of training take, and what of them the device."""
    from torch.profiler import ProfilerActivity
    from torch.profiler import profile as profiler

    cuda = torch.cuda.is_available()
    kinds = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if cuda else [])]
    plain, watch, clock = RayTrainer.step, profiler(activities=kinds), [0.0, 0.0]

    def step(self: RayTrainer, number: int) -> float:
        if number in (PROFILED.start, PROFILED.stop):
            if cuda:
                torch.cuda.synchronize()
            clock[number == PROFILED.stop] = time.perf_counter()
        if number == PROFILED.stop:
            watch.__enter__()
        loss = plain(self, number)
        if number == PROFILED.stop + 9:
            watch.__exit__(None, None, None)
        return loss

    RayTrainer.step = step  # type: ignore[method-assign]
    try:
        from sattools.fit.stage import fit

        given = {"device": options.device, "steps": 4 * PROFILED.stop}
        chosen = resolve(field, given) if field in PRESETS else resolve("fast", {"field": field, **given})
        with tempfile.TemporaryDirectory() as folder:
            fit(absolute_copy(Scene.from_file(path), Path(folder) / "profiled"), chosen)
    finally:
        RayTrainer.step = plain  # type: ignore[method-assign]
    averages = watch.key_averages()
    # what asked for a kernel has its time as well, and a marked part of the program the span of all that is in it
    there = [a for a in averages if "CUDA" in str(a.device_type) and not getattr(a, "is_user_annotation", False)]
    kernels = sum(a.self_device_time_total for a in there) / 1e3
    print(f"{field}: ten steps take {1e3 * (clock[1] - clock[0]):.1f} ms, {kernels:.1f} ms of them on the device")
    order = "self_device_time_total" if cuda else "self_cpu_time_total"
    for one in sorted(averages, key=lambda a: -getattr(a, order))[:12]:
        print(f"  {getattr(one, order) / 1e3:8.2f} ms {one.count:6d} x {one.key[:90]}")
    most = sorted(averages, key=lambda a: -a.self_cpu_time_total)[:8]
    print("  on the host: " + ", ".join(f"{a.key[:40]} {a.self_cpu_time_total / 1e3:.1f} ms" for a in most), flush=True)


if __name__ == "__main__":
    main()

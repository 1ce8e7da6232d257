"""The papers' networks and the fields of our own on one scene in equal seconds: heights, a new view, memory, samples.

    python benchmarks/papers.py [--seconds 300] [--seed 1] [--size 64] [--width N] [--threads 1] [--fields ...]
        [--precision float32 bf16] [--steps N] [--start noise] [--rays N] [--samples N]
        [--scene SCENE.json=REFERENCE.tif[@REGION]] [--out FILE.json]
    python benchmarks/papers.py --tables hdr|natural --scene SCENE.json=REFERENCE.tif [--seconds 300] [--width N]
        [--resolution M] [--fields ...] [--out FILE.json]

Without `--scene`: a simulated city with exact cameras and seven views of three dates, one of them held out. Every field
starts from the same prior in a process of its own, trains for the given seconds (start and reading-off included) and is
exported. Columns: mean absolute error by the protocol, about the median, at most 5 m; beside steps of more than 3 m
signed and absolute, away from them; PSNR of the held-out views, colours matched on their western and scored on their
eastern half; seconds and CPU seconds of the fit; points at which the field was evaluated in training, per CPU second
(rays to the sun included, reading-off in the seconds but not in the points); largest memory of the process. The prior
has a row of its own, and one of its means over cells of 1 m. Not measured on a GPU. `--precision`: networks once with
each, beside each other; `--steps`: after so many steps instead of seconds. Of a simulated city, the error of the albedo
over its mean, too (`albedo.py`).

`--tables`: those of the papers by their networks (`paper_tables.py`), in the same seconds each, with maps (w.tif, ...
beside the reference) and held-out views where the scene has them; rows that are in `--out` already are kept. On a CPU
most of the seconds of a large network go into reading it off, which `--width` and `--resolution` reduce.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from albedo import errors as albedo_errors
from paper_tables import TABLES, cell_text, with_prior, write_tables
from steps import averaged, reference

PRESETS = ("satnerf", "eonerf", "eonerf-learned-shadow", "spsnerf", "rpv-nerf", "hapke-nerf")
SURFACES = {"surface": "lambert", "surface, rpv": "rpv", "surface, hapke": "hapke"}
FIELDS = [*SURFACES, "neural", *PRESETS]
NETWORK = ("width", "start", "rays", "samples")  # options of networks
ERRORS = ("MAE", "centred", "capped", "near, signed", "near", "away")
COLUMNS = ["field", *ERRORS, "albedo", "PSNR", "steps", "seconds", "CPU s", "M samples/CPU s", "peak GB"]
AVERAGE_M = 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", type=float, default=64.0)
    parser.add_argument("--width", type=int, help="of the networks (default: the papers')")
    parser.add_argument("--resolution", type=float, help="of networks with --tables [m] (default: the prior's cells)")
    parser.add_argument("--precision", nargs="+", default=["float32"], help="of networks, one after the other")
    parser.add_argument("--steps", type=int, help="of fields of rays, instead of --seconds")
    parser.add_argument("--start", choices=["surface", "prior", "noise"], help="of networks")
    parser.add_argument("--rays", type=int, help="of networks")
    parser.add_argument("--samples", type=int, help="of networks")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--fields", nargs="*", help="surface (also with rpv or hapke), neural, voxel, a preset; with --tables its rows"
    )
    parser.add_argument("--tables", choices=list(TABLES), help="of a paper, instead of --fields")
    parser.add_argument("--scene", metavar="SCENE=REFERENCE[@REGION]", help="instead of a simulated city")
    parser.add_argument("--out", type=Path, help="all figures as JSON")
    options = parser.parse_args()
    if options.tables:
        if not options.scene:
            parser.error("--tables: found no --scene, expected SCENE=REFERENCE")
        return write_tables(options)
    with tempfile.TemporaryDirectory() as folder:
        path, against = scene_of(options, Path(folder))
        rows = starts(path, against)
        print(table(rows), flush=True)
        asked = [(name, each) for name in options.fields or FIELDS
                 for each in (options.precision if name in PRESETS else ["float32"])]  # fmt: skip
        for name, precision in asked:
            given = (name, precision, path, against, Path(folder) / f"{name}_{precision}", options)
            # a process of its own: its memory is its own, and nothing is warm
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                rows.append(pool.submit(run, given).result())
            print(table(rows[-1:]).splitlines()[-1], flush=True)
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


def scene_of(options: argparse.Namespace, folder: Path) -> tuple[str, str]:
    """Scene document with a prior, and what it is scored against."""
    from sattools.simulate import SimulateOptions, simulate

    if options.scene:
        path, _, against = options.scene.partition("=")
    else:
        city = SimulateOptions(id="TOWN", size=options.size, views=7, dates=3, test_views=1, seed=options.seed)
        scene = simulate(city, folder / "TOWN")
        path, against = str(scene.write()), str(scene.path(scene.products["truth_dsm"]))
    return with_prior(path, folder / "start"), against


def starts(path: str, against: str) -> list[dict[str, Any]]:
    """The prior, and its means over larger cells."""
    from sattools.scene import Scene
    from sattools.scene.raster import read_raster

    scene = Scene.from_file(path)
    height, grid = read_raster(scene.path(scene.products["prior_dsm"]))
    means, cells = averaged(height[0], grid, AVERAGE_M)
    return [
        {"field": "prior", **scored(height[0], grid, against)},
        {"field": f"prior, means of {AVERAGE_M:g} m", **scored(means, cells, against)},
    ]


def scored(height: Any, grid: Any, against: str) -> dict[str, float]:
    """Errors [m] of a height map."""
    from sattools.compare import compare_dsm

    figures = compare_dsm(height, reference(against), grid).figures
    near, away = figures["near_steps"], figures["away_from_steps"]
    values = [figures["mae"], figures["mae_centred"], figures["mae_capped_5m"]]
    values += [near["signed"], near["absolute"], away["absolute"]]
    return dict(zip(ERRORS, values, strict=True))


def run(given: tuple[str, str, str, str, Path, argparse.Namespace]) -> dict[str, Any]:
    """One field for the given seconds or steps, exported and scored."""
    name, precision, path, against, folder, asked = given
    from sattools.cli import set_threads

    set_threads(asked.threads)
    import torch

    torch.set_num_threads(asked.threads)
    from sattools.compare.images import compare_views
    from sattools.export.options import ExportOptions
    from sattools.export.stage import export
    from sattools.fit.stage import fit
    from sattools.scene import Scene
    from sattools.scene.copies import absolute_copy
    from sattools.scene.raster import read_raster

    scene = absolute_copy(Scene.from_file(path), folder)
    options = chosen(name, precision, asked)
    if name in SURFACES:
        fit(scene, replace(options, epochs=[1]))  # compiles
    points = counted_points()
    told: list[tuple[int, str]] = []
    begun, used = time.perf_counter(), time.process_time()
    fit(scene, options, lambda share, text: told.append((points(), text)))
    begun, used = time.perf_counter() - begun, time.process_time() - used
    held_out = [item.id for item in scene.items if item.held_out]
    export(scene, ExportOptions(view=held_out))
    height, grid = read_raster(scene.path(scene.products["dsm"]))
    training = [(count, text) for count, text in told if text.startswith("step ")]
    samples, last = training[-1] if training else (points(), "")
    return {
        "field": name if len(asked.precision) == 1 else f"{name}, {precision}",
        **scored(height[0], grid, against),
        "albedo": None if asked.scene else albedo_errors(scene, folder.parent / "TOWN")[0],
        "PSNR": compare_views(scene)["psnr"] if held_out else None,
        "steps": last.removeprefix("step ").split("/")[0],
        "seconds": round(begun, 1),
        "CPU s": round(used, 1),
        "M samples/CPU s": samples / used / 1e6,
        "peak GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def chosen(name: str, precision: str, asked: argparse.Namespace) -> Any:
    """Options of a field that ends after the seconds or steps that are asked for."""
    from sattools.fit.presets import resolve

    end = {"steps": asked.steps} if asked.steps else {"budget": asked.seconds, "steps": 10**6}
    if name in PRESETS:
        own = {option: value for option in NETWORK if (value := getattr(asked, option)) is not None}
        return resolve(name, {**end, **own, "precision": precision})
    if name in SURFACES:
        return resolve("fast", {"budget": asked.seconds, "brdf": SURFACES[name]})
    return resolve("fast", {**end, "field": name})


def counted_points() -> Any:
    """A function that says at how many points a field has been evaluated so far."""
    from sattools.field.mlp import MlpField
    from sattools.field.neural import NeuralField
    from sattools.field.voxel import VoxelField
    from sattools.render.columns import COUNTER as FOLLOWED
    from sattools.render.surface import COUNTER

    counted, before, followed = {"points": 0}, COUNTER["forward"], FOLLOWED["forward"]
    kinds: tuple[Any, ...] = (MlpField, NeuralField, VoxelField)
    for kind in kinds:

        def count(self: Any, points: Any, density: Any = kind.density) -> Any:
            counted["points"] += len(points)
            return density(self, points)

        kind.density = count
    # what a volume's rays see of the prior is rendered as a surface, and no sample of the field
    return lambda: counted["points"] + FOLLOWED["forward"] - followed or COUNTER["forward"] - before


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [COLUMNS, ["---"] * len(COLUMNS), *([cell_text(row.get(name)) for name in COLUMNS] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    main()

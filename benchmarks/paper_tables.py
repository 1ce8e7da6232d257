"""The papers' tables from their networks, with seconds: rows and text of `papers.py --tables`.

hdr: "HDR satellite NeRF", tables 1 to 3: Sat-NeRF and EO-NeRF under four losses, EO-NeRF' with and without regularised
shadows, errors by class. natural: Hapke-NeRF, tables 1 and 4: Lam, RPV, Hpk, Hpk0 (Hapke without a Lambertian phase),
maps, a held-out view and heights. Beside them the prior, its means over larger cells, and fits of the surface field.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from steps import averaged, reference

LOSSES = {"mse": "MSE", "mse-gamma": "MSE-γ", "raw-gamma": "RawNeRF-γ", "raw-log": "RawNeRF"}
SHADOWS = {
    "(w.o.)": {"loss": "mse", "shadow_weight": 0.0},
    "(RawNeRF)": {"loss": "raw-log", "shadow_weight": 0.0},
    "(reg)": {"loss": "mse", "shadow_weight": None},  # the loss's own
    "(RawNeRF+reg)": {"loss": "raw-log", "shadow_weight": None},
}
Row = tuple[str, dict[str, Any]]  # preset, options beside it
HDR: dict[str, Row] = {
    "surface": ("fast", {}),
    **{f"Sat-NeRF, {text}": ("satnerf", {"loss": loss}) for loss, text in LOSSES.items()},
    **{f"EO-NeRF, {text}": ("eonerf", {"loss": loss}) for loss, text in LOSSES.items()},
    **{f"EO-NeRF' {text}": ("eonerf-learned-shadow", given) for text, given in SHADOWS.items()},
}
# from the prior a reflectance network has its Lambertian phase; from a fit of its own model it does without
NATURAL: dict[str, Row] = {
    "surface, Lam": ("fast", {"brdf": "lambert"}),
    "surface, RPV": ("fast", {"brdf": "rpv"}),
    "surface, Hpk": ("fast", {"brdf": "hapke"}),
    "surface, Hpk0": ("fast", {"brdf": "hapke", "pretrain": 0.0}),
    "Lam": ("spsnerf", {"start": "prior"}),
    "RPV": ("rpv-nerf", {"start": "prior"}),
    "Hpk": ("hapke-nerf", {"start": "prior"}),
    "Hpk0": ("hapke-nerf", {"start": "prior", "pretrain": 0.0}),
    "RPV, from the surface's": ("rpv-nerf", {}),
    "Hpk, from the surface's": ("hapke-nerf", {}),
}
TABLES = {"hdr": HDR, "natural": NATURAL}
ERRORS = {"mae": "MAE [m]", "mae_centred": "centred", "mae_capped_5m": "capped", "median": "median"}
CLASSES = ("ground", "trees", "buildings")
VIEW = ("psnr", "ssim", "lpips", "avg")
MAPS = ("w", "b", "c", "theta")
COST = {"steps": "steps", "seconds": "seconds", "cpu": "CPU s", "gigabytes": "peak GB"}
AVERAGE = 2.0  # cells of the mean, in cells of the prior


def write_tables(options: argparse.Namespace) -> None:
    """Run what `--out` does not hold yet, and print the tables."""
    path, _, against = options.scene.partition("=")
    store = options.out or Path(f"{options.tables}_tables.json")
    rows: dict[str, Any] = json.loads(store.read_text()) if store.exists() else {}
    with TemporaryDirectory() as folder:
        scene = with_prior(path, Path(folder) / "prior")
        for name, figures in () if "prior" in rows else starts(scene, against):
            rows[name] = figures
        for k, (name, row) in enumerate(TABLES[options.tables].items()):
            if name in rows or (options.fields and name not in options.fields):
                continue
            given = (row, scene, against, Path(folder) / str(k), options)
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                rows[name] = pool.submit(run, given).result()
            store.write_text(json.dumps(rows, indent=1) + "\n")
            print(name, rows[name], flush=True)
    print(text(options.tables, rows))


def with_prior(path: str, folder: Path) -> str:
    """A copy of the scene, with a prior."""
    from sattools.prior import PriorOptions
    from sattools.prior.stage import prior
    from sattools.scene import Scene
    from sattools.scene.copies import absolute_copy

    scene = absolute_copy(Scene.from_file(path), folder)
    if "prior_dsm" not in scene.products:
        prior(scene, PriorOptions())
    return str(scene.write())


def starts(path: str, against: str) -> list[tuple[str, dict[str, Any]]]:
    """Errors of the prior, and of its means over larger cells."""
    from sattools.compare import compare_dsm
    from sattools.scene import Scene
    from sattools.scene.raster import read_raster

    scene, truth = Scene.from_file(path), reference(against)
    height, grid = read_raster(scene.path(scene.products["prior_dsm"]))
    cell = AVERAGE * grid.cell_size
    found = {"prior": (height[0], grid), f"prior, means of {cell:g} m": averaged(height[0], grid, cell)}
    return [(name, chosen(compare_dsm(heights, truth, cells).figures)) for name, (heights, cells) in found.items()]


def chosen(figures: dict[str, Any]) -> dict[str, Any]:
    """What the tables tell of a comparison."""
    classes = {name: values["mae"] for name, values in (figures.get("classes") or {}).items()}
    return {name: figures[name] for name in ERRORS} | classes


def run(given: tuple[Row, str, str, Path, argparse.Namespace]) -> dict[str, Any]:
    """One row: fitted within the seconds, exported, compared."""
    (preset, beside), path, against, folder, asked = given
    seconds, width, cell, threads = asked.seconds, asked.width, asked.resolution, asked.threads
    import sattools
    from sattools.cli import set_threads
    from sattools.scene import Scene
    from sattools.scene.copies import absolute_copy

    set_threads(threads)
    folder.mkdir()
    scene = absolute_copy(Scene.from_file(path), folder)
    options: dict[str, Any] = {"preset": preset, "budget": seconds, **beside}
    if preset == "fast":
        # compiles; where maps have a truth, the field's cells are theirs
        options["resolution"] = scene.require_grid().cell_size if "brdf" in beside else None
        sattools.fit(scene, {**options, "epochs": [1]}, overwrite=True)
    else:
        options |= {"width": width, "resolution": cell, "steps": 10**6}
    told: list[str] = []
    begun, used = time.perf_counter(), time.process_time()
    sattools.fit(scene, options, overwrite=True, progress=lambda share, message: told.append(message))
    cost = {"seconds": time.perf_counter() - begun, "cpu": time.process_time() - used}
    held_out = [item.id for item in scene.items if item.held_out]
    sattools.export(scene, {"view": held_out, "undetermined": "prior"}, overwrite=True)
    beside_it = {name: Path(against).with_name(f"{name}.tif") for name in MAPS if name in scene.products}
    maps = [f"{name}={file}" for name, file in beside_it.items() if file.exists()]
    sattools.compare(scene, {"dsm": against, "map": maps, "views": bool(held_out)}, overwrite=True)
    figures = scene.history[-1]["errors"]
    views = [figures["views"][name] for name in held_out]
    found = chosen(figures)
    if views:
        found |= {name: float(np.mean([v[name] for v in views])) for name in VIEW if all(v[name] for v in views)}
    found |= {name: values["nrmse"] for name, values in figures.get("parameters", {}).items()}
    steps = [message for message in told if message.startswith("step ")]
    cost["gigabytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {**found, **cost, "steps": steps[-1].removeprefix("step ").split("/")[0] if steps else None}


def text(kind: str, rows: dict[str, Any]) -> str:
    """The tables in Markdown: of the HDR paper losses, shadows and classes, of Hapke-NeRF one."""
    if kind == "natural":
        return table(rows, list(rows), {**ERRORS, **{k: k for k in (*VIEW, *MAPS)}, **COST})
    starting = [name for name in rows if name.startswith(("prior", "surface"))]
    shaded = [f"EO-NeRF' {name}" for name in SHADOWS]
    losses = [name for name in rows if name not in shaded]
    plain = ["Sat-NeRF, MSE", "EO-NeRF, MSE"]
    parts = {
        "Losses:": table(rows, losses, {**ERRORS, **COST}),
        "Shadows:": table(rows, [*starting, *plain, *shaded], {"mae": "MAE [m]", **COST}),
        "Classes:": table(rows, [*starting, *shaded], {**{k: k for k in CLASSES}, "mae": "overall", **COST}),
    }
    return "\n\n".join(f"{title}\n\n{part}" for title, part in parts.items())


def cell_text(value: Any) -> str:
    """A figure as the tables show it."""
    if isinstance(value, float):
        return f"{value:.3f}" if value < 10 else f"{value:.1f}"
    return "" if value is None else str(value)


def table(rows: dict[str, Any], names: list[str], columns: dict[str, str]) -> str:
    """One table; columns without a figure are left out."""
    names = [name for name in names if name in rows]
    columns = {key: title for key, title in columns.items() if any(rows[name].get(key) is not None for name in names)}
    lines = [["", *columns.values()], ["---"] * (1 + len(columns))]
    lines += [[name, *(cell_text(rows[name].get(key)) for key in columns)] for name in names]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)

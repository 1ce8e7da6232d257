"""Simulated cities with extremes of light: what losses, shadows and transients do to the surface.

    python benchmarks/hdr_checks.py claim|cast|shadows|transients [--seeds 1 2 3] [--size 128] [--out FOLDER]

claim: DSM errors of the four losses on linear 11-bit images and on the same scene as 8-bit tone-mapped RGB, once with
the depth prior (the default) and once from a flat start without it, where the photometric loss has to do everything.
cast: intersection over union of the shadows that the true heights cast with the ray-traced ones; (clear) leaves out the
cells that houses beyond the map may shade, (with the houses around) lets these cast their shadows, too. Where they
differ, by cause, in per cent of all that differs; a map of it goes to FOLDER/cast_<seed>.png.
shadows: the same from fitted heights;
correlation of learned shadows with the ray-traced ones, with and without regularisation, from both starts.
transients: the error with and without moving cars, with and without the transient model, and what `auto` chooses.

Tables go to stdout as Markdown and to FOLDER/<check>.json. One run each; seeds are of the scene and of the fit.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

WEIGHTS = {"0.01": None, "off": 0.0, "1": 1.0, "0.01, start lit": None, "off, start lit": 0.0}
CLEAR_M = 20.0  # the neighbouring blocks are no higher
AROUND = 90  # cells of 0.5 m
WALL_M = 1.5  # step between neighbouring cells
LOSSES = ("mse", "mse-gamma", "raw-gamma", "raw-log")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("check", choices=["claim", "cast", "shadows", "transients"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--size", type=float, default=128.0, help="edge of the city [m]")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--resolution", type=float, default=1.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("hdr_checks"))
    options = parser.parse_args()

    from sattools.cli import set_threads

    set_threads(options.threads)
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        checks = {"claim": claim, "cast": cast, "shadows": shadows, "transients": transients}
        rows = checks[options.check](options, Path(folder))
    print(table(rows))
    (options.out / f"{options.check}.json").write_text(json.dumps(rows, indent=1) + "\n")


def claim(options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Losses on linear and tone-mapped images."""
    rows = []
    for start, extra in (("prior", {}), ("flat", {"prior_weight": 0.0})):
        for bits in (11, 8):
            for loss in LOSSES if bits == 11 else ("mse", "raw-log"):
                row: dict[str, Any] = {"start": start, "input": f"{bits} bits", "loss": loss}
                errors = []
                for seed in options.seeds:
                    scene = city(folder, options, seed, hdr=True, bits=bits)
                    found = fitted(scene, options, loss=loss, seed=seed, **extra)
                    errors.append(found["mae"])
                    row[f"seed {seed}"] = round(found["mae"], 3)
                    row["seconds"] = round(row.get("seconds", 0) + found["seconds"] / len(options.seeds), 1)
                row["mean MAE [m]"] = round(sum(errors) / len(errors), 3)
                rows.append(row)
                print(row, file=sys.stderr, flush=True)
    return rows


def cast(options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Shadows of the true heights."""
    from sattools.scene.raster import read_raster

    rows = []
    for seed in options.seeds:
        scene = city(folder, options, seed, hdr=True, bits=11)
        (truth, grid), (classes, _) = (
            read_raster(scene.path(scene.products[n])) for n in ("truth_dsm", "truth_classes")
        )
        row: dict[str, Any] = {"seed": seed}
        for label, where in (("all", classes[0] > 0), ("ground", classes[0] == 2), ("no trees", classes[0] != 5)):
            for extra, clear in (("", 0.0), (" (clear)", CLEAR_M)):
                iou = shadow_iou(scene, truth[0], grid, truth[0], grid, clear, where)
                row[f"IoU, {label}{extra}"] = round(iou, 3)
        iou = shadow_iou(scene, truth[0], grid, truth[0], grid, 0.0, around=wider(options, seed))
        row["IoU, all, with the houses around"] = round(iou, 3)
        rows.append(row | causes(scene, truth[0], classes[0], grid, options.out / f"cast_{seed}.png"))
    return rows


def wider(options: argparse.Namespace, seed: int) -> Any:
    """True heights of the map and of AROUND cells on every side of it, as far as the simulated city goes."""
    import numpy as np

    from sattools.scene import Grid
    from sattools.simulate import SimulateOptions, world_of

    grid, world = world_of(SimulateOptions(size=options.size, seed=seed))
    cell, cells = grid.cell_size, 2 * AROUND + grid.width
    grid = Grid(grid.crs, grid.left - AROUND * cell, grid.top + AROUND * cell, cell, cells, cells)
    return world.surface(*np.meshgrid(grid.x(), grid.y())).astype(np.float32)


def causes(scene: Any, height: Any, classes: Any, grid: Any, picture: Path) -> dict[str, Any]:
    """Where cast shadows of the truth differ from the ray-traced ones, in per cent of the cells that differ: the first
    cause that applies. Draws a map of the view that differs most."""
    import cv2
    import numpy as np
    from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter

    wall = maximum_filter(height, 3) - minimum_filter(height, 3) > WALL_M
    names = ("beyond the map", "crowns", "beside a wall", "edge of a shadow", "other")
    colours = np.array([(255, 160, 0), (0, 150, 0), (200, 0, 200), (0, 200, 255), (0, 0, 255)], np.uint8)  # BGR
    count, worst = np.zeros(len(names)), 0
    missed = 0
    for cast, lit, seen, clear in compared(scene, height, grid, height, grid):
        real = lit < 0.5
        wrong = (cast != real) & seen
        missed += int((wrong & real).sum())
        edge = binary_dilation(real, iterations=1) & binary_dilation(~real, iterations=1)
        kind = np.select([clear < CLEAR_M, classes == 5, wall, edge], [0, 1, 2, 3], 4)
        count += np.bincount(kind[wrong], minlength=len(names))
        if wrong.sum() > worst:
            worst = wrong.sum()
            drawn = np.repeat(np.where(real, 70, 200).astype(np.uint8)[..., None], 3, axis=2)
            drawn[~seen] = 130
            drawn[wrong] = colours[kind[wrong]]
    cv2.imwrite(str(picture), cv2.resize(drawn, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST))
    found = {f"{name} [%]": round(100 * n / count.sum(), 1) for name, n in zip(names, count, strict=True)}
    return found | {"missed, of all that differs [%]": round(100 * missed / count.sum(), 1)}


def shadows(options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Shadow maps against the ray-traced truth."""
    import numpy as np
    import torch

    from sattools.fit.checkpoint import load
    from sattools.scene import Grid
    from sattools.scene.raster import read_raster

    rows = []
    for seed in options.seeds:
        scene = city(folder, options, seed, hdr=True, bits=11)
        truth, grid = read_raster(scene.path(scene.products["truth_dsm"]))
        row: dict[str, Any] = {"seed": seed}
        for label, clear in (("", 0.0), (" (clear)", CLEAR_M)):
            row[f"IoU, true DSM{label}"] = round(shadow_iou(scene, truth[0], grid, truth[0], grid, clear), 3)
        for cell in (0.5, options.resolution):
            fitted(scene, options, seed=seed, resolution=cell)
            tensors, meta = load(scene.path("fit/model.safetensors"))
            own = Grid.from_dict(meta["grid"])
            for label, clear in (("", 0.0), (" (clear)", CLEAR_M)):
                iou = shadow_iou(scene, tensors["height"].numpy(), own, truth[0], grid, clear)
                row[f"IoU, fit at {cell:g} m{label}"] = round(iou, 3)
        for name, weight in WEIGHTS.items():
            start = "lit" if "lit" in name else "geometric"
            found = fitted(
                scene, options, shadow="learned", loss="raw-log", shadow_weight=weight, shadow_start=start, seed=seed
            )
            tensors, meta = load(scene.path("fit/model.safetensors"))
            heights = tensors["height"].numpy()
            known = list(compared(scene, heights, own, truth[0], grid))
            for label, clear in (("", 0.0), (" (clear)", CLEAR_M)):
                pairs = [
                    (net[torch.from_numpy(use)].numpy(), lit[use])
                    for net, (_, lit, seen, rise) in zip(tensors["s_net"], known, strict=True)
                    for use in [seen & (rise >= clear)]
                ]
                net, lit = (np.concatenate(part) for part in zip(*pairs, strict=True))
                row[f"s_net correlation, weight {name}{label}"] = round(float(np.corrcoef(net, lit)[0, 1]), 3)
            row[f"MAE [m], weight {name}"] = round(found["mae"], 3)
        rows.append(row)
        print(row, file=sys.stderr, flush=True)
    return rows


def transients(options: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Moving cars."""
    rows = []
    for seed in options.seeds:
        row: dict[str, Any] = {"seed": seed}
        for cars in (0, 60):
            scene = city(folder, options, seed, hdr=True, bits=11, cars=cars)
            for transient in ("off", "on", "auto"):
                found = fitted(scene, options, transient=transient, seed=seed)
                if transient == "auto":
                    row[f"{cars} cars, auto"] = found["notes"][0]
                else:
                    row[f"{cars} cars, {transient}: MAE [m]"] = round(found["mae"], 3)
        rows.append(row)
        print(row, file=sys.stderr, flush=True)
    return rows


def city(folder: Path, options: argparse.Namespace, seed: int, **extra: Any) -> Any:
    """A simulated city; made once."""
    from sattools.scene import Scene
    from sattools.scene.files import write_text
    from sattools.simulate import SimulateOptions, simulate

    name = "_".join(["C", str(seed), *(f"{k}{v}" for k, v in extra.items())])
    path = folder / name / "scene.json"
    if path.exists():
        return Scene.from_file(path)
    scene = simulate(SimulateOptions(id=name, size=options.size, seed=seed, **extra), folder / name)
    write_text(path, scene.to_json() + "\n")
    return scene


def fitted(scene: Any, options: argparse.Namespace, **extra: Any) -> dict[str, Any]:
    """Fit; MAE [m] by the unregistered difference to the truth, seconds without the prior, notes."""
    from sattools.compare import compare_dsm, read_reference
    from sattools.fit.checkpoint import load
    from sattools.fit.options import FitOptions
    from sattools.fit.stage import fit
    from sattools.prior import PriorOptions
    from sattools.prior.stage import prior
    from sattools.scene import Grid
    from sattools.scene.files import write_text

    chosen = FitOptions(epochs=[options.epochs], resolution=options.resolution)
    chosen = replace(chosen, **{k: v for k, v in extra.items() if k in {f.name for f in fields(chosen)}})
    if chosen.prior_weight and "prior_dsm" not in scene.products:
        prior(scene, PriorOptions())
        write_text(scene.output("scene.json"), scene.to_json() + "\n")
    begun = time.perf_counter()
    notes = fit(scene, chosen)["notes"]
    seconds = time.perf_counter() - begun
    tensors, meta = load(scene.path("fit/model.safetensors"))
    truth = read_reference(str(scene.path(scene.products["truth_dsm"])))
    figures = compare_dsm(tensors["height"].numpy(), truth, Grid.from_dict(meta["grid"])).figures
    return {"mae": float(figures["mae"]), "seconds": seconds, "notes": notes}


def truth_on(scene: Any, grid: Any, height: Any, height_grid: Any) -> list[tuple[Any, Any]]:
    """Per training view the ray-traced share of sunlit ground ``[H, W]`` at the cells of a grid, and where the view
    sees them."""
    import numpy as np
    import torch

    from sattools.camera.rpc import RPC
    from sattools.render import sun_visibility
    from sattools.scene.raster import read_image
    from sattools.scene.regrid import resize_map
    from sattools.views import make_view, shown_on

    heights = resize_map(height, height_grid, grid)
    middle = float(np.median(heights))
    found = []
    for item in scene.train_items():
        rpc = RPC.from_file(scene.path(item.assets["rpc"].href))
        lit = read_image(scene.path(item.assets["truth_lit"].href))
        view = make_view(item.id, lit, rpc, grid, middle, scene.require_height_range(), sun=item.sun)
        shown, seen = shown_on(view, heights, grid.cell_size)
        upwards = np.array([*view.slope, 1.0]) / np.linalg.norm([*view.slope, 1.0])
        free = sun_visibility(torch.from_numpy(heights), grid.cell_size, tuple(upwards)).numpy()
        found.append((shown[..., 0], (seen[..., 0] > 0) & (free > 0.95)))
    return found


def shadow_iou(
    scene: Any, height: Any, own: Any, truth: Any, truth_grid: Any, clear: float, where: Any = True, around: Any = None
) -> float:
    """Intersection over union of the shadows that `height` casts with the ray-traced ones, over all views.

    Only cells whose ray to the sun has risen `clear` metres where it leaves the map: houses beyond cast shadows, too;
    and only `where` that is true. around: see `compared`.
    """
    both = either = 0
    for cast, lit, seen, rise in compared(scene, height, own, truth, truth_grid, around):
        real = lit < 0.5
        use = seen & where & (rise >= clear)
        both += int((cast & real & use).sum())
        either += int(((cast | real) & use).sum())
    return both / either


def compared(scene: Any, height: Any, own: Any, truth: Any, truth_grid: Any, around: Any = None) -> Any:
    """Per training view ``[H, W]``: where `height` casts shadow, the share of light that the ray tracer saw, which
    cells the view sees, and how far their rays to the sun have risen where they leave the map [m].

    around: heights of the map and AROUND cells on every side that cast shadows instead of `height`.
    """
    import numpy as np
    import torch

    from sattools.camera.ground import grid_sun
    from sattools.render import sun_visibility

    for item, (lit, seen) in zip(scene.train_items(), truth_on(scene, own, truth, truth_grid), strict=True):
        sun = grid_sun(own, *item.sun)
        casting = torch.from_numpy(height if around is None else around)
        cast = sun_visibility(casting, own.cell_size, tuple(sun)).numpy() < 0.5
        if around is not None:
            cast = cast[AROUND:-AROUND, AROUND:-AROUND]
        yield cast, lit, seen, rise_to_the_edge(own.shape, own.cell_size, np.asarray(sun))


def rise_to_the_edge(shape: tuple[int, int], cell: float, sun: Any) -> Any:
    """How far the ray of every cell to the sun has risen where it leaves the map [m]."""
    import numpy as np

    rows, columns = np.mgrid[: shape[0], : shape[1]]
    level = np.hypot(sun[0], sun[1])
    east, south = sun[0] / level, -sun[1] / level
    across = np.where(east > 0, shape[1] - 1 - columns, columns) / max(abs(east), 1e-9)
    along = np.where(south > 0, shape[0] - 1 - rows, rows) / max(abs(south), 1e-9)
    return np.minimum(across, along) * cell * sun[2] / level


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    lines = [names, ["---"] * len(names), *([str(row.get(name, "")) for name in names] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    main()

"""Recovery of reflectance on simulated natural scenes: maps against their truth, a held-out oblique view, the DSM.

    python benchmarks/reflectance_recovery.py [--seeds 20 21] [--variants Lam RPV Hpk Hpk0] [--out FOLDER]
    python benchmarks/reflectance_recovery.py --variants Hpk hapke-nerf --budget 600 --size 256

For every seed a scene of 384 m at 2 m GSD is simulated with one pass of 21 views; the 7 most nadir ones (8 to 14) train
every variant from the same prior, view 3 is predicted and scored with no gain or offset of its own. Seeds 0, 10 and
100 to 105 were used for tuning; docs/reflectance.md quotes others. Prints one line per scene and
variant and the means, and writes them as JSON. `rpv-nerf` and `hapke-nerf` are networks of the papers' widths, trained
for --budget seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from sattools.cli import set_threads

VARIANTS: dict[str, dict[str, object]] = {
    "Lam": {"brdf": "lambert"},
    "RPV": {"brdf": "rpv"},
    "Hpk": {"brdf": "hapke"},
    "Hpk0": {"brdf": "hapke", "pretrain": 0.0},
    "Hpk-frozen": {"brdf": "hapke", "normals": "prior"},
    "Hpk0-frozen": {"brdf": "hapke", "normals": "prior", "pretrain": 0.0},
    "Hpk-one": {"brdf": "hapke", "materials": 1},
}
NETWORKS = ("rpv-nerf", "hapke-nerf")
MAPS = ("w", "b", "c", "theta")


def coverage(scene, name: str) -> tuple[float, float]:
    """Share of cells within two standard deviations of the truth; root mean square of error over deviation."""
    from sattools.scene.raster import read_raster

    found, std, truth = (read_raster(scene.path(scene.products[n]))[0] for n in (name, f"{name}_std", f"truth_{name}"))
    z = (found - truth) / std
    return float((np.abs(z) <= 2).mean()), float(np.sqrt((z**2).mean()))


def measure(scene, options, held_out: str) -> dict[str, object]:
    from sattools.compare.images import compare_views
    from sattools.compare.metrics import map_errors
    from sattools.export.options import ExportOptions
    from sattools.export.stage import export
    from sattools.fit.stage import fit
    from sattools.scene.raster import read_raster

    start, cpu = time.perf_counter(), time.process_time()
    notes = fit(scene, options)["notes"]
    row: dict[str, object] = {
        "fit_s": round(time.perf_counter() - start, 1), "fit_cpu_s": round(time.process_time() - cpu, 1)
    }  # fmt: skip
    export(scene, ExportOptions(view=[held_out], undetermined="prior"))
    dsm, truth = (read_raster(scene.path(scene.products[n]))[0][0] for n in ("dsm", "truth_dsm"))
    row["dsm_mae"] = float(np.abs(dsm - truth).mean())
    row |= {k: v for k, v in compare_views(scene).items() if k in ("psnr", "ssim", "lpips", "avg")}
    for name in MAPS:
        if name in scene.products and f"truth_{name}" in scene.products:
            arrays = [read_raster(scene.path(scene.products[n]))[0] for n in (name, f"truth_{name}")]
            errors = map_errors(*arrays)
            row |= {f"{name}_{k}": errors[k] for k in ("nrmse", "nrmse_constant", "nrmse_scaled", "correlation")}
            if f"{name}_std" in scene.products:
                row[f"{name}_coverage"], row[f"{name}_z"] = coverage(scene, name)
    if "normal" in scene.products:
        found, true = (read_raster(scene.path(scene.products[n]))[0] for n in ("normal", "truth_normal"))
        row["normal_deg"] = float(np.degrees(np.arccos(np.clip((found * true).sum(0), -1, 1))).mean())
    row["notes"] = notes
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[20, 21])
    parser.add_argument("--variants", nargs="+", choices=[*VARIANTS, *NETWORKS], default=["Lam", "RPV", "Hpk", "Hpk0"])
    parser.add_argument("--size", type=float, default=384.0)
    parser.add_argument("--reflectance", choices=["lambert", "rpv", "hapke"], default="hapke")
    parser.add_argument("--dsm", help="relief to take instead of fractals")
    parser.add_argument("--sun-elevation", type=float, default=48.0)
    parser.add_argument("--budget", type=float, default=600.0, help="of a network [s]")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("reflectance_recovery.json"))
    arguments = parser.parse_args()
    set_threads(arguments.threads)

    from sattools.fit.options import FitOptions
    from sattools.fit.presets import resolve
    from sattools.prior import PriorOptions
    from sattools.prior.stage import prior
    from sattools.scene import Scene
    from sattools.simulate import SimulateOptions, simulate

    rows = []
    for seed in arguments.seeds:
        folder = Path(tempfile.mkdtemp(prefix="reflectance_"))
        simulated = SimulateOptions(
            terrain="natural", id=f"NAT{seed}", seed=seed, size=arguments.size, reflectance=arguments.reflectance,
            sun_elevation=arguments.sun_elevation, dsm=arguments.dsm,
        )  # fmt: skip
        scene = simulate(simulated, folder / simulated.id)
        prior(scene, PriorOptions())
        document = scene.to_json()
        for name in arguments.variants:
            copy = Scene.from_json(document)
            for product in MAPS:
                copy.products.pop(product, None)
            if name in NETWORKS:
                options = resolve(name, {"budget": arguments.budget, "steps": 10**6})
            else:
                options = replace(FitOptions(resolution=simulated.gsd), **VARIANTS[name])
            row = {"seed": seed, "variant": name, **measure(copy, options, f"{simulated.id}_003")}
            rows.append(row)
            print(line(row), flush=True)
        shutil.rmtree(folder)
    print("\nmeans")
    for name in arguments.variants:
        mine = [row for row in rows if row["variant"] == name]
        keys = [k for k, v in mine[0].items() if isinstance(v, float)]
        mean = {k: float(np.mean([row[k] for row in mine])) for k in keys}
        print(line({"seed": "all", "variant": name, **mean}))
    machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    arguments.out.write_text(
        json.dumps({"machine": machine, "threads": arguments.threads, "rows": rows}, indent=1) + "\n"
    )


def line(row: dict[str, object]) -> str:
    def number(key: str, digits: int = 3) -> str:
        value = row.get(key)
        return "-" if value is None else f"{value:.{digits}f}"

    parts = [f"{row['seed']!s:>4} {row['variant']:<12}", f"{number('fit_s', 1)} s", f"DSM {number('dsm_mae')} m"]
    parts.append(f"PSNR {number('psnr', 2)} SSIM {number('ssim', 4)}")
    if "normal_deg" in row:
        parts.append(f"normals {number('normal_deg', 1)} deg")
    for name in MAPS:
        if f"{name}_nrmse" in row:
            parts.append(
                f"{name} {number(name + '_nrmse')} (constant {number(name + '_nrmse_constant')}) "
                f"r {number(name + '_correlation', 2)} cov {number(name + '_coverage', 2)} z {number(name + '_z', 2)}"
            )
    return "  ".join(parts)


if __name__ == "__main__":
    main()

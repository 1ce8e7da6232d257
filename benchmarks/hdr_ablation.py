"""Model x loss x regularisation on one scene: the HDR satellite NeRF's three tables, with seconds.

    python benchmarks/hdr_ablation.py SCENE.json TRUTH [--start prior|flat] [--losses mse raw-log]
        [--epochs 8] [--out FOLDER] [--threads N]

TRUTH is the folder of the lidar in the contest's layout, or a DSM. The models, all on the surface field:
eonerf: geometric shadows; eonerf' : learned shadows (s_net), without and with regularisation (0.01 with raw losses,
0.0005 with the others). One run each, seed 0; seconds are those of the fit with the threads given, prior excluded.
With --start flat there is no depth prior: the photometric loss alone finds the surface.
Writes tables.md, results.json and a difference map per run into FOLDER. Runs that are in results.json already are kept.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

LOSSES = ("mse", "mse-gamma", "raw-gamma", "raw-log")
NAMES = {"mse": "MSE", "mse-gamma": "MSE-γ", "raw-gamma": "RawNeRF-γ", "raw-log": "RawNeRF"}
MODELS: dict[str, dict[str, Any]] = {
    "eonerf": {"shadow": "geometric"},
    "eonerf'": {"shadow": "learned", "shadow_weight": 0.0},
    "eonerf' + reg": {"shadow": "learned"},
}
# the paper's table 2 calls the plain loss "w.o." and the logarithmic one "RawNeRF"
ROWS = {"(w.o.)": ("eonerf'", "mse"), "(RawNeRF)": ("eonerf'", "raw-log")}
ROWS |= {"(reg)": ("eonerf' + reg", "mse"), "(RawNeRF + reg)": ("eonerf' + reg", "raw-log")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--start", choices=["prior", "flat"], default="prior")
    parser.add_argument("--losses", nargs="+", choices=LOSSES, default=list(LOSSES))
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--resolution", type=float)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--out", type=Path, default=Path("hdr_ablation"))
    options = parser.parse_args()

    from sattools.cli import set_threads

    set_threads(options.threads)
    options.out.mkdir(parents=True, exist_ok=True)
    store = options.out / "results.json"
    results: dict[str, Any] = json.loads(store.read_text()) if store.exists() else {}
    for loss in options.losses:
        for model, chosen in MODELS.items():
            key = f"{model} | {loss}"
            if key not in results:
                results[key] = run(options, loss, chosen, f"{model.replace(' ', '')}_{loss}".replace("'", "p"))
                store.write_text(json.dumps(results, indent=1) + "\n")
            print(key, results[key], file=sys.stderr, flush=True)
    if not {f"{model} | {loss}" for model, loss in ROWS.values()} <= set(results):
        return  # the tables compare mse with raw-log
    text = tables(results)
    (options.out / "tables.md").write_text(text)
    print(text)


def run(options: argparse.Namespace, loss: str, chosen: dict[str, Any], name: str) -> dict[str, Any]:
    """One fit, scored."""
    import tempfile

    from sattools.compare import compare_dsm, read_dfc2019, read_reference
    from sattools.compare.picture import difference_picture
    from sattools.fit.checkpoint import load
    from sattools.fit.options import FitOptions
    from sattools.fit.stage import fit
    from sattools.scene import Grid, Scene
    from sattools.scene.copies import in_another_root

    with tempfile.TemporaryDirectory() as folder:
        scene = Scene.from_file(in_another_root(options.scene, Path(folder) / "fit"))
        prior = {} if options.start == "prior" else {"prior_weight": 0.0}
        begun = time.perf_counter()
        fit(scene, FitOptions(loss=loss, epochs=[options.epochs], resolution=options.resolution, **chosen, **prior))  # type: ignore[arg-type]
        seconds = time.perf_counter() - begun
        tensors, meta = load(scene.path("fit/model.safetensors"))
    truth = read_dfc2019(options.truth, scene.id) if options.truth.is_dir() else read_reference(options.truth)
    found = compare_dsm(tensors["height"].numpy(), truth, Grid.from_dict(meta["grid"]))
    difference_picture(found.difference, found.grid, f"{scene.id}: {name}", options.out / f"{name}.png")
    classes = {k: v["mae"] for k, v in (found.figures.get("classes") or {}).items()}
    return {"mae": found.figures["mae"], "median": found.figures["median"], "classes": classes, "seconds": seconds}


def tables(results: dict[str, Any]) -> str:
    """The three tables as Markdown."""
    lines = ["Losses:", "", "| model | loss | MAE [m] | median [m] | seconds |", "|---|---|---|---|---|"]
    for model in MODELS:
        for loss in (name for name in LOSSES if f"{model} | {name}" in results):
            r = results[f"{model} | {loss}"]
            lines.append(f"| {model} | {NAMES[loss]} | {r['mae']:.3f} | {r['median']:.3f} | {r['seconds']:.0f} |")
    lines += ["", "Shadows:", "", "| variant | MAE [m] | seconds |", "|---|---|---|"]
    for label, (model, loss) in ROWS.items():
        r = results[f"{model} | {loss}"]
        lines.append(f"| EO-NeRF' {label} | {r['mae']:.3f} | {r['seconds']:.0f} |")
    lines += [
        "",
        "Objects:",
        "",
        "| variant | ground | trees | buildings | overall | seconds |",
        "|---|---|---|---|---|---|",
    ]
    for label, (model, loss) in ROWS.items():
        r = results[f"{model} | {loss}"]
        parts = " | ".join(f"{r['classes'][k]:.3f}" for k in ("ground", "trees", "buildings"))
        lines.append(f"| EO-NeRF' {label} | {parts} | {r['mae']:.3f} | {r['seconds']:.0f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()

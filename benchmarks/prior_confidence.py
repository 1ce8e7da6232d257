"""Does the prior's confidence mean something? Error against confidence, as a table and a figure.

    sattools prior SCENE --overwrite
    python benchmarks/prior_confidence.py SCENE/scene.json --truth DIR --out FOLDER [--region west]
    python benchmarks/prior_confidence.py SCENE/scene.json --dsm REFERENCE.tif --out FOLDER

Cells are sorted by confidence; the figure shows, per tenth, the mean and the median absolute error, and the error of
what is left when only the most confident part of the map is kept.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from sattools.compare import compare_dsm, read_reference
from sattools.compare.truth import read_dfc2019
from sattools.scene import Scene
from sattools.scene.files import write_text
from sattools.scene.raster import read_raster
from sattools.scene.regrid import reproject_map


def error_and_confidence(scene: Scene, arguments: argparse.Namespace) -> tuple[np.ndarray, np.ndarray]:
    """Absolute error [m] and confidence of every scored cell of the reference, each ``[N]``."""
    truth = read_reference(arguments.dsm) if arguments.dsm else read_dfc2019(Path(arguments.truth), scene.id)
    if arguments.region:
        truth = truth.within(arguments.region)
    height, grid = read_raster(scene.path(scene.products["prior_dsm"]))
    confidence, _ = read_raster(scene.path(scene.products["prior_confidence"]))
    compared = compare_dsm(height[0], truth, grid, method=arguments.register)
    # the confidence must follow the heights where registration moved them
    east, north, _ = compared.figures["shift_m"]
    moved = grid.moved(east, north)
    cell_confidence = reproject_map(confidence[0], moved, truth.grid)
    known = np.isfinite(compared.difference) & np.isfinite(cell_confidence)
    return np.abs(compared.difference[known]), cell_confidence[known]


def table(error: np.ndarray, cell_confidence: np.ndarray) -> dict[str, Any]:
    """Errors by tenths of falling confidence and of the most confident halves."""
    order = np.argsort(-cell_confidence, kind="stable")
    error, cell_confidence = error[order], cell_confidence[order]
    tenths = [slice(round(k * error.size / 10), round((k + 1) * error.size / 10)) for k in range(10)]
    half = error.size // 2
    return {
        "cells": int(error.size),
        "mae_m": float(error.mean()),
        "median_m": float(np.median(error)),
        "mae_of_the_surer_half_m": float(error[:half].mean()),
        "mae_of_the_rest_m": float(error[half:].mean()),
        "ratio": float(error[:half].mean() / error[half:].mean()),
        "tenths": [
            {
                "confidence": float(cell_confidence[part].mean()),
                "mae_m": float(error[part].mean()),
                "median_m": float(np.median(error[part])),
                "mae_of_all_surer_m": float(error[: part.stop].mean()),
            }
            for part in tenths
        ],
    }


def draw(figures: dict[str, Any], title: str, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tenths = figures["tenths"]
    left, right = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")[1]
    left.plot([t["confidence"] for t in tenths], [t["mae_m"] for t in tenths], "o-", label="mean")
    left.plot([t["confidence"] for t in tenths], [t["median_m"] for t in tenths], "s-", label="median")
    left.set(xlabel="confidence (mean of each tenth of the cells)", ylabel="absolute error [m]", yscale="log")
    left.legend()
    right.plot(range(10, 101, 10), [t["mae_of_all_surer_m"] for t in tenths], "o-")
    right.set(xlabel="most confident part of the map [%]", ylabel="mean absolute error [m]", ylim=(0, None))
    left.figure.suptitle(f"{title}: surer half {figures['ratio']:.2f} times the error of the rest")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    left.figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--truth", help="folder of the 2019 contest's reference files")
    parser.add_argument("--dsm", type=Path, help="any reference DSM")
    parser.add_argument("--region", help="west, east, north, south or W,S,E,N")
    parser.add_argument("--register", default="ncc", choices=["ncc", "nuth-kaab", "z", "none"])
    parser.add_argument("--out", type=Path, default=Path("."))
    arguments = parser.parse_args()
    if bool(arguments.truth) == bool(arguments.dsm):
        parser.error("give either --truth or --dsm")
    scene = Scene.from_file(arguments.scene)
    figures = table(*error_and_confidence(scene, arguments))
    draw(figures, scene.id, arguments.out / f"{scene.id}_prior_confidence.png")
    text = json.dumps(figures, indent=1)
    write_text(arguments.out / f"{scene.id}_prior_confidence.json", text + "\n")
    print(text)


if __name__ == "__main__":
    main()

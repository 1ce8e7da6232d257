"""Whether `align` finds a known shift, and how near the true orthophoto comes to the ground, on simulated scenes.

    python benchmarks/products.py --out products

Align: natural ground of 512 m goes through `prior | fit | export`; its reference is the truth in cells of 10 m, moved
by (3, -2, 5) m, so that this is what `align` has to find; `compare` with the truth, which moves as well, has to say
afterwards what it said before. Orthophoto: a city of 128 m; share of the cells that two views see (validity 1) which
have a colour, RMS of the albedo against the truth's, also where the main image does not look, and how far the two
pictures lie apart. Prints both and writes products.json.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from change import sattools

from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster, write_cog
from sattools.scene.regrid import resize_map

SHIFT = (3.0, -2.0, 5.0)
CELL = 10.0


def made(out: Path, name: str, options: list[str], products: list[str]) -> Scene:
    """A simulated scene, exported; as it is where it is there."""
    document = out / name / "scene.json"
    if document.exists() and "dsm" in Scene.from_file(document).products:
        return Scene.from_file(document)
    text = sattools("simulate", "--id", name, "--out", str(out), *options, "--overwrite")
    for stage, more in (("prior", []), ("fit", []), ("export", products)):
        text = sattools(stage, *more, "--overwrite", text=text)
    return Scene.from_file(document)


def moved(array: np.ndarray, grid: Grid) -> tuple[np.ndarray, Grid]:
    return array + np.float32(SHIFT[2]), grid.moved(*SHIFT[:2])


def align(out: Path, seed: int) -> dict[str, Any]:
    scene = made(out, "ALIGN", ["--terrain", "natural", "--views", "9", "--seed", str(seed)], [])
    truth, grid = read_raster(scene.path(scene.products["truth_dsm"]))
    columns, rows = (int(count * grid.cell_size / CELL) for count in (grid.width, grid.height))
    coarse = Grid(grid.crs, grid.left, grid.top, CELL, columns, rows)
    write_cog(out / "reference.tif", *moved(resize_map(truth[0], grid, coarse), coarse))
    write_cog(out / "truth.tif", *moved(truth[0], grid))
    shutil.rmtree(out / "moved", ignore_errors=True)  # `align` changes the scene
    shutil.copytree(scene.root, out / "moved")
    document = str(out / "moved" / "scene.json")
    own = str(scene.path(scene.products["truth_dsm"]))
    before = json.loads(sattools("compare", document, "--dsm", own, "--overwrite"))
    sattools("align", document, "--to", str(out / "reference.tif"), "--overwrite")
    after = json.loads(sattools("compare", document, "--dsm", str(out / "truth.tif"), "--overwrite"))
    entry = next(e for e in reversed(Scene.from_file(document).history) if e["command"] == "align")
    found = [entry["shift"][name] for name in ("east", "north", "up")]
    return {
        "found_m": found,
        "off_m": [round(a - b, 3) for a, b in zip(found, SHIFT)],
        "own_shift_m": before["shift_m"],
        "mae_before_m": before["mae"],
        "mae_after_m": after["mae"],
    }


def ortho(out: Path, seed: int) -> dict[str, Any]:
    scene = made(out, "ORTHO", ["--views", "8", "--dates", "4", "--seed", str(seed)], ["--products", "ortho"])
    photo, grid = read_raster(scene.path(scene.products["ortho"]))
    source, _ = read_raster(scene.path(scene.products["ortho_source"]))
    validity, coarse = read_raster(scene.path(scene.products["validity"]))
    truth, finest = read_raster(scene.path(scene.products["truth_albedo"]))
    x, y = np.meshgrid(grid.x(), grid.y())

    def here(array: np.ndarray, own: Grid) -> np.ndarray:
        rows = np.clip(((own.top - y) / own.cell_size).astype(int), 0, own.height - 1)
        return array[..., rows, np.clip(((x - own.left) / own.cell_size).astype(int), 0, own.width - 1)]

    true, two = here(truth, finest), here(validity[0], coarse) == 1
    shown = np.isfinite(photo).all(axis=0)
    main = np.bincount(source[source > 0].astype(int)).argmax()
    error = np.sqrt(np.mean((photo - true) ** 2, axis=0))
    elsewhere = shown & (source[0] != main)
    one, other = [np.nan_to_num(band, nan=float(np.nanmean(band))).astype(np.float32) for band in (photo[1], true[1])]
    (east, south), _ = cv2.phaseCorrelate(one, other, cv2.createHanningWindow(grid.shape[::-1], cv2.CV_32F))
    return {
        "filled_of_seen_by_two": round(float((shown & two).sum() / two.sum()), 4),
        "rms": round(float(np.sqrt(np.mean(error[shown] ** 2))), 4),
        "rms_where_the_main_image_does_not_look": round(float(np.sqrt(np.mean(error[elsewhere] ** 2))), 4),
        "share_from_other_images": round(float(elsewhere.sum() / shown.sum()), 3),
        "spread_of_the_truth": round(float(true.std(axis=(1, 2)).mean()), 4),
        "apart_cells": [round(east, 3), round(south, 3)],
    }


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, default=Path("products"))
    parser.add_argument("--seed", type=int, default=900)
    options = parser.parse_args()
    found = {}
    for part in (align, ortho):
        found[part.__name__] = part(options.out, options.seed)
        print(part.__name__, json.dumps(found[part.__name__]), flush=True)
        (options.out / "products.json").write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()

"""What does a small area lose at its border? Priors of boxes within larger scenes, with and without surroundings.

    python benchmarks/borders.py SCENE/scene.json=REFERENCE.tif ... [--size METRES] [--boxes N] [--beyond METRES ...]

Scenes come from `sattools prep` without an area, so that their images go on beyond a box in the middle; references as
for `benchmarks/steps.py`. Every box is matched by itself and with so much beyond its border (`--beyond`), and is cut
out of the prior of the whole. All are registered as the whole scene's prior is. Columns: mean absolute error about each
box's median; each error at most 5 m; share of the cells more than 3 m off; CPU seconds of matching per box (the first
scene's include compiling); share of the cells whose shadow, under the suns of all images, is not that of the whole.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from steps import reference

from sattools.camera.ground import grid_sun
from sattools.compare import Truth, compare_dsm
from sattools.prior import PriorOptions
from sattools.prior.matched import match_sources
from sattools.render.shadows import light_from
from sattools.scene import Grid, Scene
from sattools.scene.regrid import reproject_map
from sattools.views import load_sources

KNOWN = 0.95  # of a box that has a reference


def heights(scene: Scene, grid: Grid) -> np.ndarray:
    """What `sattools prior` finds on that grid of a scene."""
    sources = load_sources(replace(scene, grid=grid), scene.train_items())
    found = match_sources(sources, grid, scene.require_height_range(), PriorOptions())
    assert found is not None, f"{scene.id}: all images from one direction"
    return found[0].height


def errors(truth: Truth, height: np.ndarray, grid: Grid) -> np.ndarray:
    """``[H, W]`` errors of a prior on its own cells, registered as `compare` does; NaN where there is no reference."""
    east, north, up = compare_dsm(height, truth, grid).figures["shift_m"]
    there = truth.grid.moved(-east, -north)
    return height - reproject_map(truth.heights.astype(np.float32) - np.float32(up), there, grid)


def boxes(known: np.ndarray, cells: int, count: int) -> list[tuple[slice, slice]]:
    """Up to ``count`` squares of a grid, side by side, that have a reference, in an order that chance chose."""
    rows, cols = known.shape
    found = [
        (slice(r, r + cells), slice(c, c + cells))
        for r in range(0, rows - cells + 1, cells)
        for c in range(0, cols - cells + 1, cells)
        if known[r : r + cells, c : c + cells].mean() > KNOWN
    ]
    return [found[k] for k in np.random.default_rng(0).permutation(len(found))[:count]]


def shadows(height: np.ndarray, cell_size: float, suns: Sequence[tuple[float, float, float]]) -> np.ndarray:
    """``[suns, H, W]`` bool, where heights cast shadows."""
    return np.stack([light_from(height.astype(np.float32), cell_size, sun) < 0.5 for sun in suns])


def row(name: str, found: Sequence[np.ndarray], seconds: float = float("nan"), shadow: float = float("nan")) -> None:
    """Print a row of the table."""
    error = np.concatenate([np.abs(part - np.nanmedian(part)).ravel() for part in found])
    error = error[np.isfinite(error)]
    figures = f"{error.mean():6.3f} {np.minimum(error, 5).mean():6.3f} {100 * (error > 3).mean():5.1f} %"
    print(f"{name:34s} {figures} {seconds / len(found):6.1f} {100 * shadow:5.1f} %", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", metavar="SCENE=REFERENCE")
    parser.add_argument("--size", type=float, default=48.0, help="edge of a box [m]")
    parser.add_argument("--boxes", type=int, default=4, help="of a scene, at most")
    parser.add_argument("--beyond", type=float, nargs="+", default=[0.0, 16.0], help="their border [m]")
    options = parser.parse_args()
    for text in options.scenes:
        path, _, name = text.partition("=")
        scene, truth = Scene.from_file(Path(path)), reference(name)
        grid = scene.require_grid()
        whole = heights(scene, grid)
        error = errors(truth, whole, grid)
        places = boxes(np.isfinite(error), round(options.size / grid.cell_size), options.boxes)
        if not places:
            print(f"{scene.id}: no box of {options.size:g} m has a reference")
            continue
        row(f"{scene.id}: of the whole scene", [error[place] for place in places])
        suns = [grid_sun(grid, *item.sun) for item in scene.train_items() if item.sun is not None]
        cast = shadows(whole, grid.cell_size, suns)
        for metres in options.beyond:
            around, start = round(metres / grid.cell_size), time.process_time()
            found, wrong = [], []
            for rows, cols in places:
                wide = grid.part(rows, cols).widened(around)
                inside = slice(around, wide.height - around), slice(around, wide.width - around)
                height = heights(scene, wide)
                found.append(height[inside] - (whole - error)[rows, cols])
                own = shadows(height, grid.cell_size, suns)[:, *inside]
                wrong.append(float((own != cast[:, rows, cols]).mean()))
            seconds = time.process_time() - start
            row(f"{scene.id}: with {metres:g} m beyond", found, seconds, float(np.mean(wrong)))


if __name__ == "__main__":
    main()

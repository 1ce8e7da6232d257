"""Which trees does the prior find, and how large are their crowns?

    python benchmarks/trees.py SCENE/scene.json=X_DSM.tif[@REGION] ... [--variant 'NAME: OPTION=VALUE ...'] ...
        [--cache FOLDER] [--exported]

Scenes, references and variants are those of `benchmarks/steps.py`; the class map beside the reference names the trees
(5) and buildings (6), `X_DTM.tif` the bare ground (else the reference's cells of class 2, interpolated). A tree is a
connected piece of class 5 that is higher than 3 m somewhere and has 4 m2 or more that is higher than 2 m. It is found
where at least half of these cells are found, which is a surface higher above the true ground than half of the tree
there. Crown area ratio: cells of the surface higher than 2 m over those of the truth, within 3 m of a tree and not
within 1.5 m of a building. Columns: trees; recall; the same of trees below 16 m2, 16 to 60 m2, above; crown area
ratio; cells of trees found; mean and absolute error of the height there; the measures of `benchmarks/steps.py`.
--exported scores the scene's own `dsm` instead.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from probability import found as cached
from scipy.ndimage import distance_transform_edt, label
from steps import HEADER, matched, reference, row, switched, variant

from sattools.compare import Truth, compare_dsm
from sattools.export.ground import interpolated
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_on, read_raster

TREES, BUILDING, GROUND = 5, 6, 2
LEAST_M, CROWN_M, LEAST_M2 = 3.0, 2.0, 4.0
SIZES_M2 = (4.0, 16.0, 60.0, np.inf)
NEAR_M, OFF_M = 3.0, 1.5


@dataclass(frozen=True)
class Trees:
    """Trees of a reference.

    Attributes:
        truth: the reference.
        ground: ``[H, W]`` bare ground [m].
        number: ``[H, W]`` of the tree, 0 = none.
        area: ``[N]`` of the trees [m2], the first is that of no tree.
        around: ``[H, W]`` bool, cells whose crowns count.
    """

    truth: Truth
    ground: np.ndarray
    number: np.ndarray
    area: np.ndarray
    around: np.ndarray


def trees_of(text: str) -> Trees:
    truth = reference(text)
    name = Path(text.partition("@")[0])
    bare = name.with_name(name.name.replace("_DSM", "_DTM"))
    known = np.isfinite(truth.heights)
    if bare != name and bare.exists():
        ground = read_on(bare, truth.grid)[0]
    else:
        ground = interpolated(truth.heights.astype(np.float32), known & (truth.classes == GROUND))
    height = np.where(known, truth.heights - ground, 0)
    number, count = label((truth.classes == TREES) & (height > CROWN_M))
    cell = truth.grid.cell_size
    area = np.bincount(number.ravel(), minlength=count + 1) * cell**2
    top = np.zeros(count + 1)
    np.maximum.at(top, number.ravel(), height.ravel())
    small = (area < LEAST_M2) | (top < LEAST_M)
    number[small[number]] = 0
    area[small], area[0] = 0, 0
    near = distance_transform_edt(number == 0) * cell <= NEAR_M
    off = distance_transform_edt(truth.classes != BUILDING) * cell > OFF_M
    return Trees(truth, ground, number, area, near & off & known)


def score(trees: Trees, surface: np.ndarray, grid: Grid) -> str:
    """Columns for a surface."""
    difference = compare_dsm(surface, trees.truth, grid).difference
    level = np.nanmedian(difference)
    truth = trees.truth.heights - trees.ground
    found = truth + difference - level
    inside = (trees.number > 0) & np.isfinite(found)
    right = inside & (found > truth / 2)
    count = len(trees.area)
    share = np.bincount(trees.number[right], minlength=count) / np.maximum(
        np.bincount(trees.number[inside], minlength=count), 1
    )
    known = (trees.area > 0) & (np.bincount(trees.number[inside], minlength=count) > 0)
    text = f"{known.sum():4d} {(share[known] >= 0.5).mean():6.2f} ("
    for low, high in pairwise(SIZES_M2):
        of = known & (trees.area >= low) & (trees.area < high)
        text += f" {(share[of] >= 0.5).mean():4.2f}" if of.any() else "  -  "
    around = trees.around & np.isfinite(found)
    ratio = (around & (found > CROWN_M)).sum() / max((around & (truth > CROWN_M)).sum(), 1)
    error = (difference - level)[inside]
    shares = f"{ratio:5.2f} {right.sum() / max(inside.sum(), 1):5.2f}"
    return f"{text} ) {shares} {error.mean():+6.2f} {np.abs(error).mean():5.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", metavar="SCENE=REFERENCE[@REGION]")
    parser.add_argument("--variant", action="append", default=[], metavar="'NAME: OPTION=VALUE ...'")
    parser.add_argument("--cache", type=Path, help="folder that keeps what matching found at the defaults")
    parser.add_argument("--exported", action="store_true", help="score the scene's own DSM")
    options = parser.parse_args()
    print(HEADER)
    for text in options.scenes:
        path, _, against = text.partition("=")
        scene, trees = Scene.from_file(Path(path)), trees_of(against)
        print(scene.id, flush=True)
        variants = [("as it is", {})] if options.exported else [("as it is", {}), *map(variant, options.variant)]
        for name, changed in variants:
            if options.exported:
                heights, grid = read_raster(scene.path(scene.products["dsm"]))
                surface = heights[0]
            elif not changed and options.cache:
                match, grid = cached(scene, options.cache)
                surface = match.height
            else:
                with switched(changed) as prior_options:
                    match, grid, _ = matched(scene, prior_options)
                surface = match.height
            row(f"  {name}", surface, grid, trees.truth)
            print("     ", score(trees, surface, grid), flush=True)


if __name__ == "__main__":
    main()

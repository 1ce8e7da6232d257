"""How much does the surface depend on where the box lies? Priors of boxes of one place, against each other and truth.

    python benchmarks/boxes.py 'NAME=IMAGES:METADATA:REFERENCE[@REGION]' ... [--keep nothing cameras lattice]
        [--boxes NAME ...]

IMAGES and METADATA are folders, references as for `benchmarks/steps.py`. The first box is the reference's; others are
shifted (by half a cell they get one more on two sides: grids lie on multiples of their cells), larger, smaller, and all
of what the images show. Two ways to match the first box once more tell what chance alone does: pixels with noise of
0.1 %, and height planes 0.2 m lower. Every box is prepared (`prep --bounds`) and matched by itself, or with what is
kept: `cameras`, pixels and heights are those of `automatic`; of `lattice` also the places of the matching's cells.
All are judged on the ground that all hold. Columns: height range; against the first box, registered by parts of a
cell: mean absolute difference, each at most 5 m, median, share of the cells that differ by more than 1 m, and of these
how many lie beside steps of the reference of more than 3 m, in trees, within 8 m of that ground's border (of which all
cells: first row); against the reference: mean absolute error about the median, each at most 5 m, beside steps signed
and absolute (likewise); mean absolute error about the median as `compare` registers, by whole cells; both shifts
eastwards and northwards [m]; CPU seconds of matching. The last row has means and standard deviations.
"""

from __future__ import annotations

import argparse
import logging
import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
from frontier import Area
from steps import matched, reference

from sattools.compare import Truth, compare_dsm
from sattools.compare.heights import CLASSES
from sattools.compare.steps import beside_steps
from sattools.prep.options import PrepOptions
from sattools.prep.stage import prepare
from sattools.prior import PriorOptions
from sattools.prior.surroundings import with_surroundings
from sattools.scene import Grid, Scene
from sattools.scene.regrid import reproject_map
from sattools.views import Source, load_sources

Box = tuple[float, float, float, float]
# by name: eastwards, northwards, larger on every side [m]; None = all of what the images show
BOXES: dict[str, tuple[float, float, float] | None] = {
    "first": (0.0, 0.0, 0.0), "noise": (0.0, 0.0, 0.0), "planes": (0.0, 0.0, 0.0), "half a cell": (0.25, 0.25, 0.0),
    "two cells": (1.0, -1.0, 0.0), "7 m": (-7.0, 5.0, 0.0), "5 % larger": (0.0, 0.0, 6.5),
    "10 m less": (0.0, 0.0, -10.0), "20 m larger": (0.0, 0.0, 20.0), "automatic": None,
}  # fmt: skip
COMMON = -12.0  # metres by which the ground that all boxes hold is larger than the first one
NOISE, PLANES_M = 1e-3, -0.2
LATTICE = 7  # cells of the surface, which are five pairs of the matching's (`--detail 0.7`)
BORDER_M, LARGE_M, CAPPED_M = 8.0, 1.0, 5.0
FIGURES = ("mae", "capped", "near", "whole")


def prepared(area: Area, truth: Truth, folder: str, name: str) -> Scene:
    """The scene that `prep` makes of a box."""
    where, crs = BOXES[name], truth.grid.crs
    bounds = [] if where is None else list(moved(known_box(truth)[1], *where))
    number = f"box{list(BOXES).index(name)}"
    options = PrepOptions(metadata=str(area.metadata), out=folder, id=number, bounds=bounds, crs=crs)
    return prepare(area.images, options)[0]


def known_box(truth: Truth) -> tuple[tuple[slice, slice], Box]:
    """Rows and columns of what is known of a reference, and their (west, south, east, north) [m]."""
    known = np.isfinite(truth.heights)
    rows, cols = (np.flatnonzero(known.any(axis)) for axis in (1, 0))
    window = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)
    return window, truth.grid.part(*window).bounds


def moved(box: Box, east: float, north: float, larger: float) -> Box:
    """The box elsewhere, and larger on every side [m]."""
    west, south, right, top = box
    return west + east - larger, south + north - larger, right + east + larger, top + north + larger


def noisy(*args: Any) -> list[Source]:
    """The images with a little noise."""
    chance = np.random.default_rng(0)
    return [
        replace(s, radiance=s.radiance * chance.normal(1, NOISE, s.radiance.shape).astype(np.float32))
        for s in load_sources(*args)
    ]


def on_lattice(*args: Any) -> Grid:
    """The area with its surroundings, and what is left to cells of the matching that lie the same for all boxes."""
    grid = with_surroundings(*args)
    left, top = round(grid.left / grid.cell_size), round(grid.top / grid.cell_size)
    add_left, add_top = left - math.floor(left / LATTICE) * LATTICE, math.ceil(top / LATTICE) * LATTICE - top
    return grid.part(slice(-add_top, grid.height), slice(-add_left, grid.width))


def surface(name: str, keep: str, own: Scene, whole: Scene) -> tuple[np.ndarray, Grid, float, tuple[float, float]]:
    """Heights, their grid, CPU seconds and height range of a box with what is kept."""
    scene = own if keep == "nothing" else replace(whole, grid=own.grid)
    low, high = scene.require_height_range()
    scene = replace(scene, height_range_m=(low + (PLANES_M if name == "planes" else 0.0), high))
    with ExitStack() as stack:
        if name == "noise":
            stack.enter_context(patch("steps.load_sources", noisy))
        if keep == "lattice":
            stack.enter_context(patch("steps.with_surroundings", on_lattice))
        found, grid, seconds = matched(scene, PriorOptions())
    return found.height, grid, seconds, scene.require_height_range()


def registered(height: np.ndarray, grid: Grid, truth: Truth) -> tuple[np.ndarray, tuple[float, float]]:
    """Errors ``[H, W]`` about their median, and the shift (east, north) [m] of the least, each at most 5 m."""
    scored = truth.scored()

    def error(shift: tuple[float, float]) -> np.ndarray:
        difference = reproject_map(height, grid.moved(*shift), truth.grid) - scored
        return np.asarray(difference - np.nanmedian(difference))

    east, north, _ = compare_dsm(height, truth, grid).figures["shift_m"]
    best = east, north
    for step in (grid.cell_size / 2, grid.cell_size / 4):
        around = [(best[0] + right * step, best[1] + up * step) for right in (-1, 0, 1) for up in (-1, 0, 1)]
        best = min(around, key=lambda shift: float(np.nanmean(np.abs(error(shift)).clip(0, CAPPED_M))))
    return error(best), best


def parts(truth: Truth, grid: Grid) -> dict[str, np.ndarray]:
    """What ``[h, w]`` bool of a grid lies beside steps, in trees, at the border of the ground that is judged."""
    (rows, cols), _ = known_box(truth)
    n, border = round(BORDER_M / truth.grid.cell_size), np.isfinite(truth.heights)
    border[rows.start + n : rows.stop - n, cols.start + n : cols.stop - n] = False
    trees = np.zeros_like(border) if truth.classes is None else np.isin(truth.classes, CLASSES["trees"])
    found = {"steps": beside_steps(truth.heights, truth.grid.cell_size), "trees": trees, "border": border}
    return {
        name: reproject_map((part & np.isfinite(truth.heights)).astype(np.float32), truth.grid, grid, nearest=True) > 0
        for name, part in found.items()
    }


def against(height: np.ndarray, grid: Grid, first: Truth, where: dict[str, np.ndarray]) -> dict[str, float]:
    """How a surface differs from that of the first box."""
    error = np.abs(registered(height, grid, first)[0])
    own, large = error[np.isfinite(error)], error > LARGE_M
    found = {"mean": own.mean(), "capped": own.clip(0, CAPPED_M).mean(), "median": np.median(own)}
    found |= {"large": large.sum() / own.size}
    found |= {name: (large & part).sum() / max(large.sum(), 1) for name, part in where.items()}
    return {f"to_{name}": float(value) for name, value in found.items()}


def judged(height: np.ndarray, grid: Grid, truth: Truth) -> dict[str, Any]:
    """Errors on the ground that all boxes hold [m], registered by parts of a cell and as `compare` does."""
    error, shift = registered(height, grid, truth)
    near = error[parts(truth, truth.grid)["steps"] & np.isfinite(error)].clip(-CAPPED_M, CAPPED_M)
    figures = compare_dsm(height, truth, grid).figures
    found = {"mae": np.nanmean(np.abs(error)), "capped": np.nanmean(np.abs(error).clip(0, CAPPED_M))}
    found |= {"signed": near.mean(), "near": np.abs(near).mean(), "whole": figures["mae_centred"]}
    return {n: float(v) for n, v in found.items()} | {"shifts": [*shift, *figures["shift_m"][:2]]}


def run(area: Area, keeps: Sequence[str], names: Sequence[str]) -> None:
    """Print all rows of a place."""
    whole = reference(str(area.reference))
    common = moved(known_box(whole)[1], 0.0, 0.0, COMMON)
    truth = whole.within(",".join(f"{edge:.3f}" for edge in common))
    known = np.isfinite(truth.heights).sum()
    shares = ", ".join(f"{name} {100 * part.sum() / known:.0f} %" for name, part in parts(truth, truth.grid).items())
    print(f"{area.name}: of {known} cells {shares}")
    with TemporaryDirectory() as folder:
        scenes = {name: prepared(area, whole, folder, name) for name in dict.fromkeys([*names, "automatic"])}
        for keep in keeps:
            own: list[dict[str, Any]] = []
            for name in names:
                height, grid, seconds, z_range = surface(name, keep, scenes[name], scenes["automatic"])
                row = judged(height, grid, truth) | {"keep": keep, "box": name, "range": z_range, "seconds": seconds}
                if not own:
                    first = replace(truth, grid=grid, heights=height, classes=None).within(truth.region or "")
                else:
                    row |= against(height, grid, first, parts(truth, first.grid))
                own.append(row)
                show(row)
            summary(own)


def show(row: dict[str, Any]) -> None:
    """Print a row."""
    text = f"  {row['keep']:8s} {row['box']:12s} {row['range'][0]:7.2f} {row['range'][1]:7.2f} |"
    if "to_mean" in row:
        text += " ".join(f"{row[f'to_{name}']:6.3f}" for name in ("mean", "capped", "median"))
        text += "".join(f"{100 * row[f'to_{name}']:5.1f}" for name in ("large", "steps", "trees", "border"))
    else:
        text += " " * 40
    text += f" | {row['mae']:6.3f} {row['capped']:6.3f} {row['signed']:+6.2f} {row['near']:6.3f} | {row['whole']:6.3f}"
    print(text + "".join(f" {m:+5.2f}" for m in row["shifts"]) + f" {row['seconds']:6.1f} s", flush=True)


def summary(rows: list[dict[str, Any]]) -> None:
    """Print means and spreads of all boxes."""
    table = np.array([[row[name] for name in FIGURES] for row in rows])
    found = zip(FIGURES, table.mean(axis=0), table.std(axis=0), strict=True)
    print(f"  {rows[0]['keep']:8s} " + ", ".join(f"{name} {mean:.3f} ± {std:.3f}" for name, mean, std in found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("places", nargs="+", metavar="NAME=IMAGES:METADATA:REFERENCE[@REGION]")
    parser.add_argument("--keep", nargs="+", default=["nothing"], choices=("nothing", "cameras", "lattice"))
    parser.add_argument("--boxes", nargs="+", default=list(BOXES), choices=list(BOXES), metavar="NAME")
    options = parser.parse_args()
    logging.getLogger("sattools").setLevel(logging.ERROR)  # what `prep` warns of is the same for every box
    for text in options.places:
        run(Area.of(text, []), options.keep, options.boxes)


if __name__ == "__main__":
    main()

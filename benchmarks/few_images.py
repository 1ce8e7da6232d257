"""What error to expect of so many images: sets of them, drawn at random.

    python benchmarks/few_images.py 'NAME=IMAGES:METADATA:REFERENCE' ... [--inside NAME ...] [--numbers 2 3 4 5 6 8 10]
        [--sets 3] [--seed 0] [--fit]

IMAGES, METADATA, REFERENCE and --inside as in `benchmarks/frontier.py`. Every set goes through `prep | prior`, with
--fit through `fit | export` besides, and is scored with holes filled. Columns: images;
mean absolute error, about the median, each error at most 5 m, median [m]; which of the folder's images, from 1; what
the commands warn of.
A set that a command refuses has its words in place of figures. The last lines are medians, lowest and highest.
"""

from __future__ import annotations

import argparse
import random
import re
import statistics
import subprocess
import sys
import tempfile
from itertools import islice
from pathlib import Path

import rasterio
from frontier import Area
from steps import reference

from sattools.compare import Truth, compare_dsm
from sattools.scene import Scene
from sattools.scene.raster import read_raster

FIGURES = ("mae", "mae_centred", "mae_capped_5m", "median")
TOLD = re.compile(r"agree about [\d.]+ %|clouds or glare hide \d+ %|laid level")


def drawn(area: Area, number: int, sets: int, seed: int) -> list[tuple[Path, ...]]:
    """Sets of so many images, no two alike."""
    rng = random.Random(f"{area.name} {number} {seed}")
    found: dict[tuple[Path, ...], None] = {}
    for _ in range(100 * sets):
        found[tuple(sorted(rng.sample(area.images, number)))] = None
        if len(found) == sets:
            break
    return list(islice(found, sets))


def called(command: str, *arguments: str, given: str = "") -> tuple[str, str]:
    """What a command prints and says; what it says instead of a traceback, where it refuses."""
    call = [sys.executable, "-m", "sattools", "--progress", "none", command, *arguments]
    done = subprocess.run(call, input=given, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ValueError((done.stderr.strip().splitlines() or ["no word"])[-1])
    return done.stdout, done.stderr


def scored(area: Area, images: tuple[Path, ...], truth: Truth, *, fit: bool) -> tuple[dict[str, float], str]:
    """Errors of the surface of a set [m], and what was warned of."""
    with tempfile.TemporaryDirectory() as folder:
        first = [*map(str, images), "--metadata", str(area.metadata), "--id", area.name, "--out", folder]
        if area.inside:
            with rasterio.open(area.reference) as data:
                first += ["--bounds", *map(str, data.bounds), "--crs", str(data.crs)]
        given, told = called("prep", *first)
        for command in ("prior", "fit", "export") if fit else ("prior",):
            given, more = called(command, given=given)
            told += more
        scene = Scene.from_json(given)
        height, grid = read_raster(scene.path(scene.products["dsm" if fit else "prior_dsm"]))
    figures = compare_dsm(height[0], truth, grid).figures
    return {name: float(figures[name]) for name in FIGURES}, ", ".join(dict.fromkeys(TOLD.findall(told)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("areas", nargs="+", metavar="NAME=IMAGES:METADATA:REFERENCE")
    parser.add_argument("--inside", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--numbers", nargs="+", type=int, default=[2, 3, 4, 5, 6, 8, 10])
    parser.add_argument("--sets", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fit", action="store_true")
    options = parser.parse_args()
    table: dict[tuple[str, int], list[dict[str, float]]] = {}
    for area in (Area.of(text, options.inside) for text in options.areas):
        truth = reference(str(area.reference))
        for number in (n for n in options.numbers if n <= len(area.images)):
            for images in drawn(area, number, options.sets, options.seed):
                places = " ".join(str(area.images.index(path) + 1) for path in images)
                try:
                    figures, told = scored(area, images, truth, fit=options.fit)
                except ValueError as error:
                    print(f"{area.name:12s} {number:3d}  {places}: {error}", flush=True)
                    continue
                table.setdefault((area.name, number), []).append(figures)
                values = " ".join(f"{figures[name]:7.3f}" for name in FIGURES)
                print(f"{area.name:12s} {number:3d} {values}  {places}  {told}", flush=True)
    print("\nmedian (lowest to highest) of the sets: " + ", ".join(FIGURES))
    for (name, number), rows in table.items():
        parts = [sorted(row[figure] for row in rows) for figure in FIGURES]
        text = "; ".join(f"{statistics.median(part):.2f} ({part[0]:.2f} to {part[-1]:.2f})" for part in parts)
        print(f"{name:12s} {number:3d}  {text}")


if __name__ == "__main__":
    main()

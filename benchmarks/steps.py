"""What does a choice of the prior do beside height steps? Variants on several scenes, every measure for each.

    python benchmarks/steps.py SCENE/scene.json=REFERENCE.tif[@REGION] ... [--variant 'NAME: OPTION=VALUE ...'] ...
        [--average METRES] [--fit] [--detail] [--out FILE.json]

Scenes come from `sattools prep`; a reference is anything that `sattools compare --dsm` takes, `X_CLS.tif` beside
`X_DSM.tif` is its class map. Variants are options of `sattools prior`, such as `--variant 'flat: rough_passes=0'`, or
parts that no option switches off (means over neighbours, suns, courtyards, torn roofs, pits, consistency), such as
`--variant 'raw: means=0'`; the defaults are always the first. Columns: mean absolute error by the protocol; the same
about the median; each at most 5 m; beside steps of more than 3 m signed and absolute; away from them absolute; median;
CPU seconds of matching (--detail adds the errors by class and the walls' mean place outward, and what 90 % keep, by
height, as registered and moved by what all walls have in common besides; NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 holds
it to a thread; the first scene's include compiling).
"""

from __future__ import annotations

import argparse
import json
import math
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np

from sattools.compare import Truth, compare_dsm, read_reference
from sattools.compare.facades import find_walls, wall_figures
from sattools.prior import PriorOptions
from sattools.prior.confidence import match_confidence
from sattools.prior.files import write_surroundings
from sattools.prior.frame import Frame
from sattools.prior.matched import match_sources, matching_height
from sattools.prior.matching.match import Match, _prepared
from sattools.prior.stage import write_maps
from sattools.prior.surroundings import with_surroundings
from sattools.scene import Grid, Scene
from sattools.scene.copies import absolute_copy
from sattools.scene.files import write_text
from sattools.scene.raster import read_raster
from sattools.scene.regrid import reproject_map
from sattools.views import load_sources, open_images

WALLS_M = (3.0, 15.0, 50.0, np.inf)
# parts of the prior that no option switches off: `--variant 'NAME: PART=0'`
PARTS: dict[str, tuple[str, Any]] = {
    "means": ("sattools.prior.matching.match.mean_of_neighbours", lambda height, doubt, **_: height),
    "suns": ("sattools.prior.matching.match._prepared", lambda frame, *rest: _prepared(sunless(frame), *rest)),
    "courtyards": ("sattools.prior.matching.match.open_courtyards", lambda task, surface: surface),
    "torn": ("sattools.prior.matching.match.pieces_of_roofs", lambda height, *_: np.zeros(height.shape, bool)),
    "pits": ("sattools.prior.matching.match.close_pits", lambda task, visibility, height: height),
    "consistency": ("sattools.prior.matching.match.filled", lambda height, sure, cell: height),
}
HEADER = f"{'':34s} {'MAE':>6s} {'cent.':>6s} {'capped':>6s} {'near':>6s} {'|near|':>6s} {'|away|':>6s} {'median':>6s}"


def variant(text: str) -> tuple[str, dict[str, Any]]:
    """Name and changed options of 'NAME: OPTION=VALUE ...'."""
    name, _, rest = text.partition(":")
    kinds = {f.name: type(f.default) for f in fields(PriorOptions)} | dict.fromkeys(PARTS, int)
    changed = {}
    for key, value in re.findall(r"(\w+)=(\S+)", rest):
        kind = kinds[key] if kinds[key] in (int, str) else float
        changed[key] = value == "True" if kinds[key] is bool else kind(value)
    return name.strip(), changed


def sunless(frame: Frame) -> Frame:
    """The same views, their suns unknown."""
    return replace(frame, suns=(None,) * len(frame.suns))


@contextmanager
def switched(changed: dict[str, Any]) -> Iterator[PriorOptions]:
    """Options of a variant; parts that no option switches off are switched off meanwhile."""
    options = replace(PriorOptions(), **{name: value for name, value in changed.items() if name not in PARTS})
    with ExitStack() as stack:
        for name, value in changed.items():
            if name in PARTS and not value:
                target, instead = PARTS[name]
                stack.enter_context(patch(target, instead))
        yield options


def reference(text: str) -> Truth:
    """Truth of FILE[@REGION]."""
    name, _, region = text.partition("@")
    path = Path(name)
    beside = path.with_name(path.name.replace("_DSM", "_CLS"))
    truth = read_reference(path, beside if beside != path and beside.exists() and not is_contest(path) else None)
    return truth.within(region) if region else truth


def is_contest(path: Path) -> bool:
    """A tile without georeference of its own; its class map is found by itself."""
    return path.with_suffix(".txt").exists()


def matched(scene: Scene, options: PriorOptions) -> tuple[Match, Grid, float]:
    """What `sattools prior` finds, its grid, CPU seconds of the matching."""
    found, wide, seconds = matched_widely(scene, options)
    grid = scene.require_grid().resized(wide.cell_size)
    return area_of(found, wide, grid), grid, seconds


def matched_widely(scene: Scene, options: PriorOptions) -> tuple[Match, Grid, float]:
    """The same with the surroundings of the area that are matched with it."""
    return matched_of_pairs(scene, options)[:3]


def matched_of_pairs(scene: Scene, options: PriorOptions) -> tuple[Match, Grid, float, int]:
    """The same, and the number of pairs of images that were matched."""
    whole, z_range = scene.require_grid(), scene.require_height_range()
    items = scene.train_items()
    images = open_images(scene, items)
    shapes = [image.shape for image in images.parts]
    grid = with_surroundings(
        whole.resized(options.resolution or whole.cell_size), images.cameras, shapes, matching_height(z_range)
    )
    sources = load_sources(replace(scene, grid=grid), items, images)
    start = time.process_time()
    found = match_sources(sources, grid, z_range, options)
    assert found is not None, f"{scene.id}: all images from one direction"
    return found[0], grid, time.process_time() - start, len(found[2])


def area_of(found: Match, wide: Grid, grid: Grid) -> Match:
    """What was found of an area, without its surroundings."""
    inside = wide.window(grid)
    maps = {name: array[inside] for name, array in vars(found).items() if isinstance(array, np.ndarray)}
    return replace(found, **maps)


def averaged(height: np.ndarray, grid: Grid, cell: float) -> tuple[np.ndarray, Grid]:
    """Means of square blocks of cells; what does not fill a block at the lower and right border is left out."""
    n = max(1, round(cell / grid.cell_size))
    rows, cols = height.shape[0] // n, height.shape[1] // n
    mean = height[: rows * n, : cols * n].reshape(rows, n, cols, n).mean(axis=(1, 3), dtype=np.float64)
    return mean.astype(np.float32), Grid(grid.crs, grid.left, grid.top, grid.cell_size * n, cols, rows)


def fitted(scene: Scene, found: Match, wide: Grid, grid: Grid) -> tuple[np.ndarray, np.ndarray, Grid]:
    """The surface that `sattools fit` makes of this prior, with its defaults, and its standard deviation [m]."""
    from sattools.export.options import ExportOptions
    from sattools.export.stage import export
    from sattools.fit.options import FitOptions
    from sattools.fit.stage import fit

    with TemporaryDirectory() as folder:
        copy = absolute_copy(scene, Path(folder))
        copy.products, copy.history = {}, []  # the scene may have been fitted already
        area = area_of(found, wide, grid)
        write_maps(copy, area.height, match_confidence(area), grid)
        write_surroundings(copy, found.height, wide if wide != grid else None)
        fit(copy, FitOptions())
        export(copy, ExportOptions())
        height, own = read_raster(copy.path(copy.products["dsm"]))
        std, _ = read_raster(copy.path(copy.products["dsm_std"]))
    return height[0], std[0], own


def coverage(figures: dict[str, Any], difference: np.ndarray, std: np.ndarray, grid: Grid, truth: Truth) -> str:
    """Share of the errors (about their median) within one and two standard deviations."""
    east, north, _ = figures["shift_m"]
    moved = grid.moved(east, north)
    error = np.abs(difference - np.nanmedian(difference))
    sigmas = error / reproject_map(std, moved, truth.grid)
    known = np.isfinite(sigmas)
    figures["coverage"] = [float((sigmas[known] < n).mean()) for n in (1, 2)]
    return "      within 1, 2 dsm_std: " + ", ".join(f"{100 * share:.0f} %" for share in figures["coverage"])


def detail(figures: dict[str, Any], registered: np.ndarray, truth: Truth) -> str:
    """Errors by class, places of walls by height."""
    parts = [f"{name} {of['mae']:.2f}" for name, of in figures["classes"].items() if of.get("mae") is not None]
    lines = ["      " + ", ".join(parts)]
    walls = find_walls(registered, truth.heights, truth.grid.cell_size, truth.classes)
    for key, title, found in (
        ("walls", "walls", walls),
        ("walls_without_shift", "without what all are shifted by", walls.without_shift()),
    ):
        parts = []
        for heights in pairwise(WALLS_M):
            of = figures[f"{key}_{heights[0]:g}"] = wall_figures(found.between(heights).offset)
            if of["median"] is not None:
                parts.append(f"from {heights[0]:g} m {of['mean']:+.2f} ({of['p90']:.2f}, {of['pieces']})")
        if parts:
            lines.append(f"      {title} " + ", ".join(parts))
    return "\n".join(lines)


def row(
    name: str,
    height: np.ndarray,
    grid: Grid,
    truth: Truth,
    seconds: float | None = None,
    *,
    more: bool = False,
    std: np.ndarray | None = None,
) -> dict[str, Any]:
    """Score, print, return."""
    compared = compare_dsm(height, truth, grid)
    figures = compared.figures
    near, away = figures["near_steps"], figures["away_from_steps"]
    values = [figures["mae"], figures["mae_centred"], figures["mae_capped_5m"]]
    text = " ".join(f"{value:6.3f}" for value in values)
    signed, beside = (math.nan if value is None else value for value in (near["signed"], near["absolute"]))  # no step
    text += f" {signed:+6.2f} {beside:6.3f} {away['absolute']:6.3f} {figures['median']:6.3f}"
    print(f"{name:34s} {text}" + (f" {seconds:6.1f} s" if seconds is not None else ""), flush=True)
    if more:
        print(detail(figures, truth.heights + compared.difference, truth), flush=True)
    if std is not None:
        print(coverage(figures, compared.difference, std, grid, truth), flush=True)
    return {"name": name, "seconds": seconds, **figures}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", metavar="SCENE=REFERENCE[@REGION]")
    parser.add_argument("--variant", action="append", default=[], metavar="'NAME: OPTION=VALUE ...'")
    parser.add_argument("--average", type=float, help="also score the prior averaged to these cells [m]")
    parser.add_argument("--fit", action="store_true", help="also score the fit that starts from it")
    parser.add_argument("--detail", action="store_true", help="errors by class, places of walls by height")
    parser.add_argument("--out", type=Path, help="all figures as JSON")
    options = parser.parse_args()
    variants = [variant("as it is"), *map(variant, options.variant)]
    print(HEADER)
    table: dict[str, list[dict[str, Any]]] = {}
    for text in options.scenes:
        path, _, against = text.partition("=")
        scene, truth = Scene.from_file(Path(path)), reference(against)
        print(scene.id)
        rows = table.setdefault(scene.id, [])
        for name, changed in variants:
            with switched(changed) as prior_options:
                found, wide, seconds = matched_widely(scene, prior_options)
            grid = scene.require_grid().resized(wide.cell_size)
            height = area_of(found, wide, grid).height
            rows.append(row(f"  {name}", height, grid, truth, seconds, more=options.detail))
            if options.average:
                rows.append(row("    averaged", *averaged(height, grid, options.average), truth))
            if options.fit:
                height, std, own = fitted(scene, found, wide, grid)
                rows.append(row("    fitted", height, own, truth, more=options.detail, std=std))
    if options.out:
        write_text(options.out, json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()

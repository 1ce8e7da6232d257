"""Error against CPU seconds, of the prior, its means and the whole pipe, by settings and by numbers of images.

    python benchmarks/frontier.py 'NAME=IMAGES:METADATA:REFERENCE' ... --out FOLDER [--inside NAME ...] [--runs 1]

IMAGES and METADATA are folders, REFERENCE anything that `sattools compare --dsm` takes (`X_CLS.tif` beside `X_DSM.tif`
is its class map); with --inside `prep` gets the bounds of the reference. Every way runs `prep | prior | fit | export`
on one thread in processes of their own and counts their CPU seconds, start-up included; the surface of `prior` counts
with the seconds of `prep` and `prior` alone, its means over cells of 1 m with the same. The first way is run once
more before, as it compiles. Prints a table (medians of the runs); FOLDER gets frontier.csv and frontier.png. Without
any scene the picture is drawn anew from the table.
"""

from __future__ import annotations

import argparse
import csv
import math
import statistics
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from steps import averaged, reference
from versions import HERE, Way, run

from sattools.compare import Truth, compare_dsm
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster

MEANS_M = 1.0
COLUMNS = ("scene", "way", "images", "surface", "seconds", "mae", "centred", "capped", "near_signed", "near", "away")
SURFACES = {"prior": "prep and prior", "averaged": "its means over 1 m", "fit": "whole pipe"}


@dataclass(frozen=True)
class Area:
    """Images, and what their surface is judged by."""

    name: str
    images: tuple[Path, ...]
    metadata: Path
    reference: Path
    inside: bool

    @classmethod
    def of(cls, text: str, inside: list[str]) -> Area:
        """NAME=IMAGES:METADATA:REFERENCE."""
        name, _, rest = text.partition("=")
        images, metadata, against = rest.split(":")
        return cls(name, tuple(sorted(Path(images).glob("*.tif"))), Path(metadata), Path(against), name in inside)

    def some(self, count: int) -> tuple[Path, ...]:
        """So many of the images, spread over all."""
        return tuple(self.images[k] for k in np.unique(np.linspace(0, len(self.images) - 1, count).round().astype(int)))


@dataclass(frozen=True)
class Setting:
    """A way through the pipe: how many images (0 = all), options of `prior`."""

    name: str
    images: int = 0
    prior: tuple[str, ...] = ()


SETTINGS = (
    Setting("default"),
    Setting("detail 1", prior=("--detail", "1")),
    Setting("detail 0.85", prior=("--detail", "0.85")),
    Setting("detail 0.5", prior=("--detail", "0.5")),
    *(Setting(f"{count} images", images=count) for count in (3, 5, 8)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("areas", nargs="*", metavar="NAME=IMAGES:METADATA:REFERENCE")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--inside", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--runs", type=int, default=1)
    options = parser.parse_args()
    if not options.areas:
        draw(options.out / "frontier.png", read(options.out / "frontier.csv"))
        return
    options.out.mkdir(parents=True, exist_ok=True)
    areas = [Area.of(text, options.inside) for text in options.areas]
    once(areas[0], SETTINGS[0], reference(str(areas[0].reference)))
    print("".join(f"{name:>12s}" for name in COLUMNS))
    rows: list[dict[str, Any]] = []
    for area in areas:
        truth = reference(str(area.reference))
        for setting in SETTINGS:
            if setting.images < len(area.images):
                rows += medians(area, setting, [once(area, setting, truth) for _ in range(options.runs)])
        write(options.out / "frontier.csv", rows)
        draw(options.out / "frontier.png", rows)


def once(area: Area, setting: Setting, truth: Truth) -> dict[str, dict[str, float]]:
    """Seconds and errors of each surface of one way."""
    way = Way(f"{area.name}, {setting.name}", HERE)
    with tempfile.TemporaryDirectory() as folder:
        files = [str(path.resolve()) for path in (area.some(setting.images) if setting.images else area.images)]
        first = [*files, "--metadata", str(area.metadata.resolve()), "--id", area.name, "--out", folder]
        if area.inside:
            with rasterio.open(area.reference) as data:
                first += ["--bounds", *map(str, data.bounds), "--crs", str(data.crs)]
        given, prep = run(way, ["prep", *first], b"")
        given, prior = run(way, ["prior", *setting.prior], given)
        scene = Scene.from_json(given.decode())
        height, grid = read_raster(scene.path(scene.products["prior_dsm"]))
        given, fit = run(way, ["fit"], given)
        given, export = run(way, ["export"], given)
        scene = Scene.from_json(given.decode())
        surface, own = read_raster(scene.path(scene.products["dsm"]))
    means, wide = averaged(height[0], grid, MEANS_M)
    before, after = prep + prior, prep + prior + fit + export
    return {
        "prior": {"seconds": before, **errors(height[0], grid, truth)},
        "averaged": {"seconds": before, **errors(means, wide, truth)},
        "fit": {"seconds": after, **errors(surface[0], own, truth)},
    }


def errors(height: np.ndarray, grid: Grid, truth: Truth) -> dict[str, float]:
    """What `compare` says of a surface [m]."""
    of = compare_dsm(height, truth, grid).figures
    near, away = of["near_steps"], of["away_from_steps"]
    found = {
        "mae": of["mae"],
        "centred": of["mae_centred"],
        "capped": of["mae_capped_5m"],
        "near_signed": near["signed"],
        "near": near["absolute"],
        "away": away["absolute"],
    }
    return {name: math.nan if value is None else value for name, value in found.items()}  # ground without steps


def medians(area: Area, setting: Setting, runs: list[dict[str, dict[str, float]]]) -> Iterator[dict[str, Any]]:
    """A row for each surface, printed."""
    for surface in SURFACES:
        figures = {name: statistics.median(one[surface][name] for one in runs) for name in runs[0][surface]}
        about = {"scene": area.name, "way": setting.name, "images": setting.images or len(area.images)}
        row = {**about, "surface": surface, **{name: round(value, 3) for name, value in figures.items()}}
        print("".join(f"{row[name]!s:>12s}" for name in COLUMNS), flush=True)
        yield row


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """All rows as CSV."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of such a file."""
    with open(path, newline="", encoding="utf-8") as file:
        return [{k: v if k in COLUMNS[:4] else float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def draw(path: Path, rows: list[dict[str, Any]]) -> None:
    """One panel a scene: a line for the settings of all images, one for the numbers of images."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(10, 3.6 * math.ceil(len(scenes) / 2)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(math.ceil(len(scenes) / 2), 2, squeeze=False).ravel()
    for axes, scene in zip(panels, scenes, strict=False):
        own = [row for row in rows if row["scene"] == scene]
        for surface, marker in zip(SURFACES, "oxs", strict=True):
            for kind, colour in (("detail", "tab:blue"), ("images", "tab:orange")):
                line = [r for r in own if r["surface"] == surface and (kind in r["way"] or r["way"] == "default")]
                line.sort(key=lambda r: r["seconds"])
                at = [r["seconds"] for r in line], [r["mae"] for r in line]
                full = surface == "fit"
                axes.plot(*at, color=colour, marker=marker, ls="-" if full else "none", mfc=colour if full else "none")
                side = (6, 4) if kind == "images" else (-2, -12)
                for r in line if full else []:
                    if kind in r["way"]:
                        place = (r["seconds"], r["mae"])
                        axes.annotate(r["way"], place, xytext=side, textcoords="offset points", size=8, color=colour)
        axes.set(title=scene, xlabel="CPU seconds", xscale="log", ylabel="mean absolute error [m]")
        axes.set_ylim(0, 1.1 * max(r["mae"] for r in own))
        axes.set_xlim(0.9 * min(r["seconds"] for r in own), 1.35 * max(r["seconds"] for r in own))
        ticks = [t for t in (5, 10, 20, 50, 100, 200) if axes.get_xlim()[0] < t < axes.get_xlim()[1]]
        axes.set_xticks(ticks, [f"{t} s" for t in ticks])
        axes.set_xticks([], minor=True)
        axes.grid(alpha=0.3)
    for marker, name in zip("oxs", SURFACES.values(), strict=True):
        panels[0].plot([], [], marker, color="gray", mfc="gray" if marker == "s" else "none", label=name)
    panels[0].legend(fontsize=8)
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main()

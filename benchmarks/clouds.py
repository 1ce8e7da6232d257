"""What do clouds cost? Simulated towns with clear skies, with clouds that are masked, and with clouds that are kept.

    python benchmarks/clouds.py [--out FOLDER] [--terrain downtown] [--seeds N ...] [--share S ...] [--views N]

For every seed a town is simulated without and with clouds over half of the dates (`simulate --clouds`; cameras, dates,
noise and traffic are the same), and goes through `prep --bounds` of its truth, `fit`, `export` and `compare --protocol
dfc2019`: without clouds, with `prep --clouds mask` (the default) and with `keep`. Columns: mean absolute error; with
holes filled; about the median; each error at most 5 m; images in which clouds were found, and the share of what they
show of the area.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import rasterio

FOUND = re.compile(r"clouds or glare hide (\d+) %")


def sattools(*arguments: str, text: str = "") -> tuple[str, str]:
    """What a command prints and says."""
    command = [sys.executable, "-m", "sattools", *arguments]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout, done.stderr


def simulated(folder: Path, terrain: str, seed: int, share: float, views: int) -> Path:
    """The folder of a town."""
    name = f"{terrain}_{seed}_{views}_{100 * share:.0f}"
    options = ["--views", str(views), "--dates", str(min(views, 6))]
    options += ["--terrain", terrain, "--seed", str(seed), "--bias-px", "2" if terrain == "city" else "3"]
    sattools("simulate", "--id", name, "--out", str(folder), "--clouds", str(share), *options, "--overwrite")
    return folder / name


def prepared(town: Path, out: Path, *options: str) -> tuple[str, str]:
    """What `prep` prints and says of the area of a town's truth."""
    with rasterio.open(town / "truth" / f"{town.name}_DSM.tif") as data:
        area = ["--crs", str(data.crs), "--bounds", *map(str, data.bounds)]
    images = map(str, sorted((town / "images").glob("*.tif")))
    where = ["--metadata", str(town / "metadata"), "--out", str(out)]
    return sattools("prep", *images, *where, *area, *options, "--overwrite")


def errors(text: str, town: Path, out: Path) -> dict[str, Any]:
    """What `compare` finds of a town's fitted scene, by the town's truth."""
    text, _ = sattools("export", "--overwrite", text=text)
    reference = str(town / "truth" / f"{town.name}_DSM.tif")
    sattools("compare", "--protocol", "dfc2019", "--dsm", reference, "--overwrite", text=text)
    return dict(json.loads((out / town.name / "compare/errors.json").read_text()))


def row(name: str, town: Path, out: Path, clouds: str) -> None:
    """Print a row of the table."""
    text, said = prepared(town, out / clouds, "--clouds", clouds)
    text, _ = sattools("fit", "--overwrite", text=text)
    figures = errors(text, town, out / clouds)
    hidden = [int(share) for share in FOUND.findall(said)]
    print(
        f"{name:32s} {figures['mae']:7.3f} {figures['mae_filled']:7.3f} {figures['mae_centred']:7.3f} "
        f"{figures['mae_capped_5m']:7.3f} "
        f"{len(hidden):3d} {sum(hidden) / max(len(hidden), 1):4.0f} %",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("clouds"))
    parser.add_argument("--terrain", choices=["city", "downtown"], default="downtown")
    parser.add_argument("--seeds", type=int, nargs="+", default=[2020, 2021, 2022])
    parser.add_argument("--share", type=float, nargs="+", default=[0.2, 0.5], help="of the sky under clouds")
    parser.add_argument("--views", type=int, default=12, help="images, on six dates at most")
    options = parser.parse_args()
    views = options.views
    print(f"{'town, clouds':32s} {'MAE':>7s} {'filled':>7s} {'median':>7s} {'at 5 m':>7s} {'images, covered':>10s}")
    for seed in options.seeds:
        clear = simulated(options.out, options.terrain, seed, 0.0, views)
        row(f"{options.terrain} {seed}, none", clear, options.out, "mask")
        for share in options.share:
            town = simulated(options.out, options.terrain, seed, share, views)
            for clouds in ("mask", "keep"):
                row(f"{options.terrain} {seed}, {100 * share:.0f} %, {clouds}", town, options.out, clouds)


if __name__ == "__main__":
    main()

"""What does it cost that images were made 8 bits wide? Towns of 11 bits, and as programs scale them down.

    python benchmarks/stretched.py [--out FOLDER] [--terrain downtown] [--seeds N ...]

Every town is simulated with linear images of 11 bits; copies have 8 bits: scaled (0 to the 99.8th percentile of every
image), stretched (2nd to 98th percentile, what is darker or brighter is cut off) and with a tone curve (exponent 1 /
2.2). All go through `prep --bounds` of the truth, `prior`, `fit`, `export` and `compare --protocol dfc2019`. Columns:
mean absolute error; about the median; each error at most 5 m.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
import rasterio
from blurred import row
from clouds import simulated

WAYS = ("scaled", "stretched", "toned")


def eight_bits(image: np.ndarray, way: str) -> np.ndarray:
    """An image ``[C, H, W]`` as numbers up to 255."""
    low, high = np.percentile(image, (2, 98)) if way == "stretched" else (0.0, np.percentile(image, 99.8))
    share = np.clip((image - low) / (high - low), 0, 1)
    return np.asarray(np.round(255 * (share ** (1 / 2.2) if way == "toned" else share)).astype(np.uint8))


def copied(town: Path, way: str) -> Path:
    """A town with such images."""
    new = town.parent / way / town.name
    shutil.rmtree(new, ignore_errors=True)
    shutil.copytree(town, new)
    for path in (new / "images").glob("*.tif"):
        with rasterio.open(path) as data:
            image, profile, tags, rpc = data.read(), data.profile, data.tags(), data.tags(ns="RPC")
        path.unlink()
        with rasterio.open(path, "w", **(profile | {"dtype": "uint8"})) as data:
            data.write(eight_bits(image.astype(float), way))
            data.update_tags(**tags)
            data.update_tags(ns="RPC", **rpc)
    return new


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("stretched"))
    parser.add_argument("--terrain", choices=["city", "downtown"], default="downtown")
    parser.add_argument("--seeds", type=int, nargs="+", default=[2050, 2051])
    options = parser.parse_args()
    print(f"{'town, images':40s} {'MAE':>7s} {'median':>7s} {'at 5 m':>7s}")
    for seed in options.seeds:
        town = simulated(options.out, options.terrain, seed, 0.0)
        row(f"{options.terrain} {seed}, 11 bits", town, options.out / "linear")
        for way in WAYS:
            row(f"{options.terrain} {seed}, 8 bits, {way}", copied(town, way), options.out / f"of_{way}")


if __name__ == "__main__":
    main()

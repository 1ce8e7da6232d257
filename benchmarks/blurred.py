"""What do poor images cost beside good ones? Towns of twelve images, a third of them blurred or coarse.

    python benchmarks/blurred.py [--out FOLDER] [--terrain downtown] [--seeds N ...]

Every town is simulated, images 1, 4, 7 and 10 are blurred (standard deviation 1.6 pixels) or made four times as
coarse (means of 4 x 4 pixels), and everything goes through `prep --bounds` of the truth, `prior`, `fit`, `export` and
`compare --protocol dfc2019`: as it is, with `prior --blurred 1` (all images count alike), and without the spoilt
images. Columns: mean absolute error; about the median; each error at most 5 m.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import rasterio
from clouds import errors, prepared, sattools, simulated

from sattools.camera import RPC

COARSER = 4
WAYS = ("blurred", "coarse")


def spoilt(image: np.ndarray, way: str) -> np.ndarray:
    """An image ``[C, H, W]``, worse."""
    if way == "blurred":
        return np.stack([cv2.GaussianBlur(band, (0, 0), 1.6) for band in image])
    bands, rows, cols = (size // COARSER * COARSER if k else size for k, size in enumerate(image.shape))
    blocks = image[:, :rows, :cols].reshape(bands, rows // COARSER, COARSER, cols // COARSER, COARSER)
    return np.asarray(blocks.mean(axis=(2, 4)))


def spoil(town: Path, way: str) -> Path:
    """A town with a third of its images spoilt, and beside it `good`, the others alone."""
    new = town.parent / way / town.name
    shutil.rmtree(new, ignore_errors=True)
    shutil.copytree(town, new)
    for k, path in enumerate(sorted((new / "images").glob("*.tif"))):
        if k % 3:
            continue
        with rasterio.open(path) as data:
            image, profile, rpc = data.read(), data.profile, RPC.from_tags(data.tags(ns="RPC"))
        worse = spoilt(image.astype(float), way)
        profile |= {"height": worse.shape[1], "width": worse.shape[2]}
        if way == "coarse":
            rpc = rpc.reduced(COARSER)
        path.unlink()
        with rasterio.open(path, "w", **profile) as data:
            data.write(np.clip(np.round(worse), 0, np.iinfo(image.dtype).max).astype(image.dtype))
            data.update_tags(ns="RPC", **rpc.to_tags())
        beside = new / "metadata" / f"{path.stem}.json"
        said = json.loads(beside.read_text())
        beside.write_text(json.dumps({name: said[name] for name in said if name not in ("rpc", "height", "width")}))
    good = new.parent / "good" / town.name
    shutil.rmtree(good, ignore_errors=True)
    shutil.copytree(new, good)
    for path in sorted((good / "images").glob("*.tif"))[::3]:
        path.unlink()
    return new


def row(name: str, town: Path, out: Path, *options: str) -> None:
    """Print a row of the table."""
    text, _ = prepared(town, out)
    text, _ = sattools("prior", *options, "--overwrite", text=text)
    text, _ = sattools("fit", "--overwrite", text=text)
    figures = errors(text, town, out)
    print(f"{name:40s} {figures['mae']:7.3f} {figures['mae_centred']:7.3f} {figures['mae_capped_5m']:7.3f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("blurred"))
    parser.add_argument("--terrain", choices=["city", "downtown"], default="downtown")
    parser.add_argument("--seeds", type=int, nargs="+", default=[2040, 2041])
    options = parser.parse_args()
    print(f"{'town, four of twelve images':40s} {'MAE':>7s} {'median':>7s} {'at 5 m':>7s}")
    for seed in options.seeds:
        town = simulated(options.out, options.terrain, seed, 0.0)
        name = f"{options.terrain} {seed}"
        row(f"{name}, none spoilt", town, options.out / "none")
        for way in WAYS:
            worse = spoil(town, way)
            row(f"{name}, {way}", worse, options.out / "now")
            row(f"{name}, {way}, all count alike", worse, options.out / "alike", "--blurred", "1")
            row(f"{name}, {way}, without these", worse.parent / "good" / town.name, options.out / "without")


if __name__ == "__main__":
    main()

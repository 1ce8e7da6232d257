"""A harbour with waves: errors of the prior on water and on land, with water laid level with its shore and kept.

    python benchmarks/waves.py --out FOLDER [--seeds 932 ...] [--images 12 ...] [--one-pass] [SCENE=REFERENCE.tif ...]

The western three fifths of a simulated downtown become water 2 m below its ground, and every image gets waves and
glints of its own there, as no two images of water show the same. So many of its twelve images of many dates are
matched; with `--one-pass` it is seen by three images of one pass instead, 20 degrees off nadir. More scenes
(`SCENE/scene.json`, from `sattools prep`) whose reference has a class map with water (9) beside it can be given; with
an empty `--seeds` nothing is simulated. Errors are about the median of those on land.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio
from scipy.ndimage import gaussian_filter
from steps import matched_of_pairs, reference

from sattools.prior import PriorOptions
from sattools.prior.brightness import brightness_of_blocks
from sattools.prior.confidence import match_confidence
from sattools.prior.water import level_water
from sattools.scene import Scene
from sattools.scene.regrid import reproject_map
from sattools.views import open_images

WATER, GROUND = 9, 2
BELOW_M = 2.0


def sattools(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "sattools", *arguments], check=True, stdout=subprocess.DEVNULL)


def with_water(truth: Path, out: Path) -> float:
    """Write a DSM whose west is water, and its class map, both beside ``out``; the water's height [m]."""
    with rasterio.open(f"{truth}_DSM.tif") as dsm, rasterio.open(f"{truth}_CLS.tif") as cls:
        height, classes, profiles = dsm.read(1), cls.read(1), (dsm.profile, cls.profile)
    row, col = np.mgrid[: height.shape[0], : height.shape[1]]
    wet = col < height.shape[1] * (0.6 + 0.1 * np.sin(5 * row / height.shape[0]))
    level = float(np.median(height[classes == GROUND])) - BELOW_M
    height[wet], classes[wet] = level, WATER
    for name, values, profile in zip(("DSM", "CLS"), (height, classes), profiles, strict=True):
        with rasterio.open(f"{out}_{name}.tif", "w", **profile) as file:
            file.write(values, 1)
    return level


def add_waves(image: Path, heights: Path, level: float, seed: int) -> None:
    """Give what an image shows of the water waves of its own: 15 % of its brightness, swell of 20 %, glints."""
    rng = np.random.default_rng(seed)
    with rasterio.open(heights) as file:
        wet = np.abs(file.read(1) - level) < 0.05

    def noise(sigma: float) -> np.ndarray:
        values = gaussian_filter(rng.normal(size=wet.shape), sigma)
        return np.asarray(values / values.std())

    factor = 1 + 0.15 * noise(1.2) + 0.2 * noise(20.0) + np.maximum(0.85 * noise(0.7) - 2.2, 0.0)
    with rasterio.open(image, "r+") as file:
        pixels = file.read().astype(np.float64)
        for band in pixels:
            band[wet] = np.median(band[wet]) * factor[wet]
        file.write(np.clip(pixels, 1, 2047).astype(file.dtypes[0]))


def harbour(out: Path, seed: int, counts: list[int], one_pass: bool) -> list[tuple[Path, Path]]:
    """Prepared scenes of so many images each, and their reference."""
    sattools("simulate", "--terrain", "downtown", "--seed", str(seed), "--id", "town", "--out", str(out))
    level = with_water(out / "town/truth/town", out / "harbour")
    given = ["--dsm", f"{out}/harbour_DSM.tif", "--classes", f"{out}/harbour_CLS.tif", "--bias-px", "2", "--seed", "5"]
    given += ["--views", "3", "--dates", "1", "--off-nadir", "20"] if one_pass else []
    sattools("simulate", "--terrain", "downtown", *given, "--id", "harbour", "--out", str(out))
    images = sorted((out / "harbour/images").glob("*.tif"))
    for k, image in enumerate(images):
        add_waves(image, out / f"harbour/truth/views/{image.stem}_HEIGHT.tif", level, k + 1)
    scenes = []
    for count in [len(images)] if one_pass else counts:
        names = [str(images[round(k)]) for k in np.linspace(0, len(images) - 1, count)]
        scene = f"{seed}_{count}"
        sattools("prep", *names, "--metadata", f"{out}/harbour/metadata", "--id", scene, "--out", str(out))
        scenes.append((out / scene / "scene.json", out / "harbour/truth/harbour_DSM.tif"))
    return scenes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE=REFERENCE")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="*", default=[932])
    parser.add_argument("--images", type=int, nargs="+", default=[12])
    parser.add_argument("--one-pass", action="store_true")
    options = parser.parse_args()
    pairs: list[tuple[Path, Path]] = []
    for seed in options.seeds:
        folder = options.out / str(seed)
        folder.mkdir(parents=True, exist_ok=True)
        pairs += harbour(folder, seed, options.images, options.one_pass)
    for text in options.scenes:
        scene, _, truth = text.partition("=")
        pairs.append((Path(scene), Path(truth)))
    for path, truth in pairs:
        scene = Scene.from_file(path)
        found, wide, _, pairs = matched_of_pairs(scene, replace(PriorOptions(), water="keep"))
        level, confidence = found.height.copy(), match_confidence(found)
        items = scene.train_items()
        looks = brightness_of_blocks(scene, items, open_images(scene, items), wide)
        level_water(level, confidence, wide.cell_size, looks, pairs)
        grid = scene.require_grid().resized(wide.cell_size)
        heights = [height[wide.window(grid)] for height in (found.height, level)]
        known = reference(str(truth))
        assert known.classes is not None
        wet = known.classes == WATER
        kept, laid = (reproject_map(height, grid, known.grid) - known.heights for height in heights)
        middle = np.nanmedian(kept[~wet])
        share = (heights[0] != heights[1]).mean()
        print(f"{scene.id}: {100 * share:.1f} % laid level; mean error (more than 5 m)")
        for name, where in (("water", wet), ("land", ~wet)):
            off = [np.abs(error - middle)[where & np.isfinite(error)] for error in (kept, laid)]
            figures = ", ".join(f"{e.mean():.2f} m ({100 * (e > 5).mean():.1f} %)" for e in off)
            print(f"  {name:5s} {where.sum():6d} cells: kept, laid level {figures}")


if __name__ == "__main__":
    main()

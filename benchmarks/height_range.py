"""Does the height range that `sattools prep` finds hold the highest roof and the lowest ground, from few views, too?

    python benchmarks/height_range.py SIMULATED/scene.json ...

Scenes come from `sattools simulate` (with --bias-px, as raw images have). Of each, subsets of its images are prepared:
all, every second, the first three, three in the middle, every third, two thirds, and three pairs. Printed for each:
lowest and highest height of the truth, the range that was found, by how much it holds them at either end, and how many
times as wide it is as the truth. Images show more than the truth: a tower that stands beside it widens the range, too.
Cameras that are known to a few pixels leave all heights free to move by a few metres together.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sattools.compare import read_reference
from sattools.prep.options import PrepOptions
from sattools.prep.stage import prepare

SUBSETS = {
    "all": slice(None), "every second": slice(None, None, 2), "the others": slice(1, None, 2), "first three": slice(3),
    "three in the middle": slice(6, 9), "every third": slice(None, None, 3), "two thirds": slice(None, 8),
    "fourth and eighth": slice(3, 8, 4), "first and 11th": slice(0, 11, 10), "second and tenth": slice(1, 10, 8),
}  # fmt: skip
FEWEST = 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SIMULATED/scene.json")
    for path in parser.parse_args().scenes:
        root = path.parent
        heights = read_reference(next((root / "truth").glob("*DSM.tif"))).heights
        lowest, highest = float(np.nanmin(heights)), float(np.nanmax(heights))
        images = sorted((root / "images").glob("*.tif"))
        print(f"{path}: {lowest:.1f} to {highest:.1f} m")
        for name, chosen in SUBSETS.items():
            if len(images[chosen]) < FEWEST:
                continue
            with TemporaryDirectory() as folder:
                options = PrepOptions(metadata=str(root / "metadata"), id="S", out=folder)
                scene, _ = prepare(images[chosen], options)
            low, high = scene.require_height_range()
            holds = f"holds {lowest - low:+.1f}, {high - highest:+.1f} m"
            width = (high - low) / (highest - lowest)
            print(
                f"  {name:20s} {len(images[chosen]):2d} {low:8.1f} to {high:6.1f} m, {holds}, {width:.2f} x", flush=True
            )


if __name__ == "__main__":
    main()

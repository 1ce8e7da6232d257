"""How often is bright or dark ground in a corner of an image taken for a frame without data?

    python benchmarks/frames.py IMAGE.tif ... [--pieces 12] [--seed 0]

Of every image, as it is and stretched to 1 to 99 and 2 to 98 % of its numbers in eight bits, so many random pieces of
128, 256 and 400 pixels are looked at as images of their own. The images must have no frames themselves. What is printed
is the number of pieces, and of those with a frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rasterio.io import MemoryFile

from sattools.prep.frames import Frame, find_frames
from sattools.scene.opening import opened

EDGES_PX = (128, 256, 400)
CUTS_PERCENT = (0, 1, 2)


def stretched(values: np.ndarray, cut: int) -> np.ndarray:
    """An image ``[B, H, W]`` in eight bits, with so many per cent black and white; 0 = as it is."""
    if not cut:
        return values
    low, high = np.percentile(values, [cut, 100 - cut])
    return (np.clip((values - low) / (high - low), 0, 1) * 255).astype(np.uint8)


def frames_of(piece: np.ndarray) -> list[Frame]:
    bands, height, width = piece.shape
    with MemoryFile() as memory:
        with memory.open(driver="GTiff", count=bands, height=height, width=width, dtype=piece.dtype) as data:
            data.write(piece)
        with memory.open() as data:
            return find_frames(data, Path("piece"), (0, 0, width, height))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", nargs="+", type=Path)
    parser.add_argument("--pieces", type=int, default=12, help="of every image and stretch")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    seen = framed = 0
    for path in options.images:
        with opened(path) as data:
            whole = data.read()
        for cut in CUTS_PERCENT:
            values = stretched(whole, cut)
            for _ in range(options.pieces):
                edge = int(rng.choice([e for e in EDGES_PX if e < min(values.shape[1:])]))
                row, col = (int(rng.integers(0, n - edge)) for n in values.shape[1:])
                found = frames_of(values[:, row : row + edge, col : col + edge])
                seen, framed = seen + 1, framed + bool(found)
    print(f"{seen} pieces, {framed} with a frame")


if __name__ == "__main__":
    main()

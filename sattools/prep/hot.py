"""Hot pixels: single ones far brighter than those around them, by a sensor's fault or as a mark of saturation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.prep.numbers import read_band

# Optics spread a glint over its neighbours: the four nearest get a tenth of it and more. So no image of a bright thing
# is so many times as bright as all but two of the pixels around it (two, as hot pixels may touch)
TIMES = 16.0
TOUCHING = 2


def hot_pixels(data: DatasetReader, path: Path, window: Window) -> NDArray[np.bool_]:
    """Which pixels ``[H, W]`` of a window are hot in a band.

    Those are in the upper half of what the file's type of 16 bits and more can hold, and more than `TIMES` times as
    large as the neighbours but for two, so that images without them have none, whatever they show.

    Args:
        data: the open image.
        path: its name, for messages.
        window: of the file.

    Raises:
        InputError: it cannot be read.
    """
    found = np.zeros((int(window.height), int(window.width)), bool)
    for band in range(1, data.count + 1):
        dtype = np.dtype(data.dtypes[band - 1])
        if dtype.kind not in "iu" or dtype.itemsize < 2:
            continue
        least = np.iinfo(dtype).max // 2 + 1
        if np.greater_equal(read_band(data, path, band, window), least).any():
            found |= _alone(data, path, band, window, least)
    return found


def _alone(data: DatasetReader, path: Path, band: int, window: Window, least: int) -> NDArray[np.bool_]:
    """Which pixels of a band reach a number and are hot: the same ones, whatever windows an image is read in."""
    top, left = min(1, int(window.row_off)), min(1, int(window.col_off))
    bottom = min(1, data.height - int(window.row_off + window.height))
    right = min(1, data.width - int(window.col_off + window.width))
    wider = Window(
        window.col_off - left, window.row_off - top, window.width + left + right, window.height + top + bottom
    )
    values = read_band(data, path, band, wider)
    around = np.pad(values, ((1 - top, 1 - bottom), (1 - left, 1 - right)), mode="reflect")
    rows, cols = np.nonzero(around[1:-1, 1:-1] >= least)
    steps = [(r, c) for r in range(3) for c in range(3) if (r, c) != (1, 1)]
    neighbours = np.stack([around[rows + r, cols + c] for r, c in steps]).astype(np.float64)
    own = around[rows + 1, cols + 1]
    if data.nodata is not None:  # beside missing pixels nothing is known of what they would have shown
        neighbours[neighbours == data.nodata] = np.inf
    hot = (own > TIMES * np.sort(neighbours, axis=0)[-1 - TOUCHING]) & (own != data.nodata)
    found = np.zeros((int(window.height), int(window.width)), bool)
    found[rows[hot], cols[hot]] = True
    return found


__all__ = ["hot_pixels"]

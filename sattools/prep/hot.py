"""Hot pixels: single ones far brighter than those around them, by a sensor's fault or as a mark of saturation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.prep.numbers import LARGEST_NUMBER, read_band

# Optics spread a glint over its neighbours: the four nearest get a tenth of it and more. So no image of a bright thing
# is so many times as bright as all but two of the pixels around it (two, as hot pixels may touch)
TIMES = 16.0
TOUCHING = 2
# Floating point numbers have no range of which a half is bright: what is as many times as bright as most of the image
WHITE = 98  # per cent of the pixels that are darker
SQUARES, SQUARE_PX = 4, 128  # squares along an axis that tell it, the same ones for every window


def hot_pixels(data: DatasetReader, path: Path, window: Window) -> NDArray[np.bool_]:
    """Which pixels ``[H, W]`` of a window are hot in a band.

    Those are in the upper half of what the file's type of 16 bits and more can hold, of floating point numbers more
    than `TIMES` times as large as nearly all of the image, and as many times as large as the neighbours but for two, so
    that images without them have none, whatever they show.

    Args:
        data: the open image.
        path: its name, for messages.
        window: of the file.

    Raises:
        InputError: it cannot be read.
    """
    found = np.zeros((int(window.height), int(window.width)), bool)
    for band in range(1, data.count + 1):
        least = _least(data, path, band)
        if least is not None and np.greater_equal(read_band(data, path, band, window), least).any():
            found |= _alone(data, path, band, window, least)
    return found


def _least(data: DatasetReader, path: Path, band: int) -> float | None:
    """Number from which on a pixel of a band may be hot; None = none is."""
    dtype = np.dtype(data.dtypes[band - 1])
    if dtype.kind in "iu" and dtype.itemsize > 1:
        return float(np.iinfo(dtype).max // 2 + 1)
    if dtype.kind != "f":
        return None
    starts = [
        np.unique(np.linspace(0, max(0, size - SQUARE_PX), SQUARES).astype(int)) for size in (data.height, data.width)
    ]
    edges = min(SQUARE_PX, data.width), min(SQUARE_PX, data.height)
    some = [read_band(data, path, band, Window(col, row, *edges)) for row in starts[0] for col in starts[1]]
    numbers = np.concatenate([part.ravel() for part in some]).astype(np.float64)
    known = numbers[np.isfinite(numbers) & (numbers != data.nodata)]
    white = float(np.percentile(known, WHITE)) if known.size else 0.0
    return TIMES * white if white > 0 else None


def _alone(data: DatasetReader, path: Path, band: int, window: Window, least: float) -> NDArray[np.bool_]:
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
    neighbours[np.isnan(neighbours)] = np.inf
    own = around[rows + 1, cols + 1].astype(np.float64)
    if data.nodata is not None:  # beside missing pixels, NaN too, nothing is known of what they would have shown
        neighbours[neighbours == data.nodata] = np.inf
    hot = (own > TIMES * np.sort(neighbours, axis=0)[-1 - TOUCHING]) & (own != data.nodata)
    if values.dtype.kind == "f":
        hot &= own <= LARGEST_NUMBER  # what is larger is refused
    found = np.zeros((int(window.height), int(window.width)), bool)
    found[rows[hot], cols[hot]] = True
    return found


__all__ = ["hot_pixels"]

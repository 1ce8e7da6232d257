"""Frames around images: pixels of one number from a corner on, which vendors write without calling them no data."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from rasterio.features import geometry_mask
from rasterio.io import DatasetReader
from rasterio.windows import Window
from scipy.ndimage import binary_dilation, label

from sattools.prep.layout import convex_outline
from sattools.prep.numbers import read_band
from sattools.scene.blocks import Blocks
from sattools.scene.raster import has_mask

CORNER_PX = 4  # edge of what must be of one number in a corner
LEAST_SHARE = 0.005  # of the pixels: less is no frame, or does no harm
ELSEWHERE = 5e-4  # of the other pixels that may have the number by chance
BENT = 0.05  # of a frame that may lie within the outline of the rest: its border is straight but for pixels
LOOKED_AT = 1_000_000  # pixels by which the shape of a frame is found
_STRIP_PX = 4_000_000


@dataclass(frozen=True)
class Frame:
    """Where an image has a frame.

    Attributes:
        value: of its pixels, in all bands.
        share: of the pixels that were looked at.
        blocks: where it may be: a pixel of the number elsewhere is ground.
    """

    value: float
    share: float
    blocks: Blocks

    def __str__(self) -> str:
        percent = f"{100 * self.share:.2g}" if self.share < 0.1 else f"{100 * self.share:.0f}"
        return (
            f"{percent} % of the pixels, from a corner on, are {self.value:g} in all bands and taken for no data, "
            f"which the file does not say (gdal_edit.py -a_nodata {self.value:g} does)"
        )


def find_frames(data: DatasetReader, path: Path, window: tuple[int, int, int, int]) -> list[Frame]:
    """The frames of a window of an image, one of every number that has one.

    An image's outline is convex: whatever lies outside of it within a window reaches one of the window's corners and
    one of the file's, and leaves a convex rest. A roof in a corner may do so, too; so the number has to be rare among
    the other pixels, or to reach two of the window's corners.

    Args:
        data: the open image.
        path: its name, for messages.
        window: column, row, width, height.

    Raises:
        InputError: it cannot be read.
    """
    of_file = {_one_number(data, path, corner) for corner in _corners(0, 0, data.width, data.height)} - {None}
    if not of_file:
        return []
    col, row, width, height = window
    corners = [(_one_number(data, path, corner), corner) for corner in _corners(*window)]
    found = []
    for value in {v for v, _ in corners if v in of_file and v is not None}:
        step = max(1, math.ceil(math.sqrt(width * height / LOOKED_AT)))
        same = np.concatenate(list(_sampled(data, path, window, value, step)))
        pieces, _ = label(same)
        last = np.array(pieces.shape) - 1
        middles = [
            ((at.row_off - row + at.height // 2) // step, (at.col_off - col + at.width // 2) // step)
            for v, at in corners
            if v == value
        ]
        of_corners = [int(pieces[tuple(np.minimum(middle, last))]) for middle in middles]
        places = np.isin(pieces, sorted(set(of_corners) - {0}))
        share = float(places.mean())
        if share >= LEAST_SHARE and _is_frame(same, places, sum(k > 0 for k in of_corners)):
            # a block whose sampled pixel is ground may hold some of the frame
            found.append(Frame(value, share, Blocks(binary_dilation(places, np.ones((3, 3))), step, (col, row))))
    return found


def _is_frame(same: NDArray[np.bool_], places: NDArray[np.bool_], corners: int) -> bool:
    """Whether pixels of one number look like what lies outside of an image rather than like something bright or dark.

    Args:
        same: ``[h, w]`` that have the number.
        places: which of them hang together with a corner.
        corners: how many corners have the number.
    """
    if corners < 2 and (same & ~places).sum() > ELSEWHERE * (~places).sum():
        return False
    image = convex_outline(~places)
    if image.is_empty:
        return False
    to_middles = Affine(1, 0, -0.5, 0, 1, -0.5)
    within = geometry_mask([image], places.shape, to_middles, invert=True) & places
    return bool(within.sum() <= BENT * places.sum())


def _corners(col: int, row: int, width: int, height: int) -> list[Window]:
    size = min(CORNER_PX, width, height)
    return [Window(c, r, size, size) for r in (row, row + height - size) for c in (col, col + width - size)]


def _one_number(data: DatasetReader, path: Path, window: Window) -> float | None:
    """The number that all bands have in a window, None where it is not one, or no data already."""
    values = np.stack([read_band(data, path, band, window) for band in range(1, data.count + 1)])
    value = float(values.flat[0])
    if not math.isfinite(value) or value == data.nodata or not (values == values.flat[0]).all():
        return None
    return None if has_mask(data) and (data.dataset_mask(window=window) == 0).any() else value


def _sampled(
    data: DatasetReader, path: Path, window: tuple[int, int, int, int], value: float, step: int
) -> Iterator[NDArray[np.bool_]]:
    """Whether all bands have a number at every so many-th pixel, some rows at a time."""
    col, row, width, height = window
    strip = max(1, _STRIP_PX // (width * step)) * step
    for first in range(0, height, strip):
        rows = Window(col, row + first, width, min(strip, height - first))
        same = [read_band(data, path, band, rows)[::step, ::step] == value for band in range(1, data.count + 1)]
        yield np.logical_and.reduce(same)


__all__ = ["Frame", "find_frames"]

"""Pixels of an item's image: of the scene's own copy, or of a window of the original that the item refers to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sattools.errors import InputError
from sattools.scene.document import Item, Scene
from sattools.scene.opening import opened
from sattools.scene.raster import image_shape, read_image

WINDOW = "sattools:window"  # of an asset: column, row, width, height within its file


@dataclass(frozen=True)
class ImagePart:
    """The part of a file that is an item's image.

    Attributes:
        path: the file.
        rows, cols: of the file.
        referred: it is an original that `prep` has not copied; its own camera is not the corrected one.
    """

    path: Path
    rows: slice
    cols: slice
    referred: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows.stop - self.rows.start, self.cols.stop - self.cols.start

    @property
    def bands(self) -> int:
        """Number of bands."""
        with opened(self.path) as data:
            return int(data.count)

    @property
    def block(self) -> tuple[int, int]:
        """Rows and columns in which the file is stored."""
        with opened(self.path) as data:
            rows, cols = data.block_shapes[0]
        return int(rows), int(cols)

    def read(self, window: tuple[slice, slice] | None = None, reduce: int = 1) -> np.ndarray:
        """``[B, H, W]`` float32, NaN where there is no data; see `sattools.scene.raster.read_image`.

        Args:
            window: rows and columns within the part; None = all.
            reduce: pixels along an axis that are averaged.

        Raises:
            InputError: missing, truncated or not an image.
        """
        rows, cols = window or (slice(0, self.shape[0]), slice(0, self.shape[1]))
        up, left = self.rows.start, self.cols.start
        place = (slice(up + rows.start, up + rows.stop), slice(left + cols.start, left + cols.stop))
        return read_image(self.path, place, reduce)


def image_part(scene: Scene, item: Item, name: str = "image") -> ImagePart:
    """Where the pixels of an item's asset are.

    Raises:
        InputError: a file that cannot be read, or that is smaller than the window.
    """
    asset = item.assets[name]
    path = scene.path(asset.href)
    height, width = image_shape(path)
    window = asset.extra.get(WINDOW)
    if window is None:
        return ImagePart(path, slice(0, height), slice(0, width))
    col, row, cols, rows = (int(v) for v in window)
    if col + cols > width or row + rows > height:
        raise InputError(
            f"{path}: found {width} x {height} pixels, expected those of columns {col} to {col + cols} and rows {row} "
            f"to {row + rows}, of which item {item.id} is made"
        )
    return ImagePart(path, slice(row, row + rows), slice(col, col + cols), True)


__all__ = ["WINDOW", "ImagePart", "image_part"]

"""Pixels of an item's image: of the scene's own copy, or of a window of the original that the item refers to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rasterio.windows import Window

from sattools.errors import InputError, SceneError
from sattools.scene.blocks import Blocks
from sattools.scene.document import Item, Scene
from sattools.scene.opening import opened
from sattools.scene.raster import image_shape, read_image

WINDOW = "sattools:window"  # of an asset: column, row, width, height within its file
CLOUDS = "clouds"  # asset of an item whose image is an original: blocks of its pixels that clouds hide
BLOCKS = "sattools:blocks"  # of that asset: column and row of the first block within the file, pixels of an edge


@dataclass(frozen=True)
class ImagePart:
    """The part of a file that is an item's image.

    Attributes:
        path: the file.
        rows, cols: of the file.
        referred: it is an original that `prep` has not copied; its own camera is not the corrected one.
        hidden: pixels of the file that are no data, whatever it says.
    """

    path: Path
    rows: slice
    cols: slice
    referred: bool = False
    hidden: Blocks | None = None

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
        pixels = read_image(self.path, place, reduce)
        if self.hidden is not None:
            pixels[:, self._hidden(place, reduce)] = np.nan
        return pixels

    def _hidden(self, place: tuple[slice, slice], reduce: int) -> np.ndarray:
        """What is hidden in the middle of each mean of ``reduce`` x ``reduce`` pixels at a place of the file."""
        assert self.hidden is not None  # the caller has looked
        rows, cols = place
        window = Window(cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
        height, width = window.height // reduce, window.width // reduce
        return self.hidden.within(window)[reduce // 2 :: reduce, reduce // 2 :: reduce][:height, :width]


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
    return ImagePart(path, slice(row, row + rows), slice(col, col + cols), True, _clouds(scene, item, name))


def _clouds(scene: Scene, item: Item, name: str) -> Blocks | None:
    """What clouds hide of an original; those of a copy are masked in the copy itself."""
    asset = item.assets.get(CLOUDS)
    if asset is None or name != "image":
        return None
    if BLOCKS not in asset.extra:
        raise SceneError(
            f"scene {scene.id}: found no {BLOCKS!r} at the asset {CLOUDS!r} of item {item.id}, expected it"
        )
    col, row, step = (int(v) for v in asset.extra[BLOCKS])
    if step < 1:
        raise SceneError(f"scene {scene.id}: found blocks of {step} pixels at item {item.id}, expected one or more")
    return Blocks(read_image(scene.path(asset.href))[0] == 1.0, step, (col, row))


__all__ = ["BLOCKS", "CLOUDS", "WINDOW", "ImagePart", "image_part"]

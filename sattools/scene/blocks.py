"""Parts of an image, in blocks of its pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window


@dataclass(frozen=True)
class Blocks:
    """Some blocks of pixels of a file.

    Attributes:
        places: ``[h, w]`` bool, which blocks.
        step: pixels along the edge of a block.
        corner: column and row of the first.
    """

    places: NDArray[np.bool_]
    step: int
    corner: tuple[int, int]

    def within(self, window: Window) -> NDArray[np.bool_]:
        """Which pixels ``[height, width]`` of a window of the file they hold.

        Args:
            window: of the file; nothing is there where the blocks do not reach.
        """
        (col, row), (height, width) = self.corner, self.places.shape
        rows = (np.arange(window.row_off, window.row_off + window.height) - row) // self.step
        cols = (np.arange(window.col_off, window.col_off + window.width) - col) // self.step
        inside = (rows >= 0)[:, None] & (rows < height)[:, None] & (cols >= 0) & (cols < width)
        return np.asarray(self.places[np.clip(rows, 0, height - 1)][:, np.clip(cols, 0, width - 1)] & inside)


__all__ = ["Blocks"]

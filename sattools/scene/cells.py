"""Single cells of rasters in files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sattools.scene.raster import raster_bands, raster_grid, read_raster


class FiledCells:
    """A raster ``[B, H, W]`` in a file, of which the values ``[:, row, column]`` of single cells are read.

    Raises:
        InputError: as `read_raster`.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.grid = path, raster_grid(path)
        self.shape = (raster_bands(path), *self.grid.shape)

    def __getitem__(self, place: tuple[slice, int, int]) -> np.ndarray:
        bands, row, col = place
        array, _ = read_raster(self.path, self.grid.part(slice(row, row + 1), slice(col, col + 1)))
        return array[bands, 0, 0]


__all__ = ["FiledCells"]

"""The exported maps, read by blocks: what is made of them needs memory for a block, not for the area."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sattools.scene.files import written
from sattools.scene.grid import Grid
from sattools.scene.opening import opened
from sattools.scene.raster import raster_grid, read_on, read_raster

BLOCK = 512  # cells along a side
SAMPLE = 500_000  # cells of a map, about


@dataclass(frozen=True)
class Maps:
    """Maps of a scene by name, of which `dsm` gives the grid.

    Attributes:
        paths: files by the name of the product.
        grid: of the DSM.
    """

    paths: Mapping[str, Path]
    grid: Grid

    @classmethod
    def of(cls, paths: Mapping[str, Path]) -> Maps:
        """Of files that are there or that this command has just written."""
        there = {name: written(path) for name, path in paths.items()}
        return cls(there, raster_grid(there["dsm"]))

    def blocks(self, size: int = BLOCK) -> Iterator[tuple[slice, slice]]:
        """Rows and columns of every block, row by row."""
        for row in range(0, self.grid.height, size):
            for col in range(0, self.grid.width, size):
                yield (
                    slice(row, min(row + size, self.grid.height)),
                    slice(col, min(col + size, self.grid.width)),
                )

    def read(self, name: str, rows: slice, cols: slice) -> np.ndarray:
        """A map ``[B, h, w]`` of the cells of the DSM's grid that these rows and columns within it name."""
        path, part = self.paths[name], self.grid.part(rows, cols)
        if raster_grid(path) == self.grid:
            return read_raster(path, within=part)[0]
        return read_on(path, part)

    def picture(self, name: str, longest: int) -> np.ndarray:
        """A map ``[B, h, w]`` of no more cells along a side, each the mean of those it covers.

        Args:
            name: of the map.
            longest: cells along the longer side.
        """
        from rasterio.enums import Resampling

        with opened(self.paths[name]) as data:
            share = min(1.0, longest / max(data.height, data.width))
            shape = (data.count, max(1, round(share * data.height)), max(1, round(share * data.width)))
            return np.asarray(data.read(out_shape=shape, resampling=Resampling.average))

    def sample(self, name: str) -> np.ndarray:
        """About half a million cells ``[B, n]`` of a map, evenly from all of it."""
        step = max(1, round((self.grid.height * self.grid.width / SAMPLE) ** 0.5))
        found = [self.read(name, rows, cols)[:, ::step, ::step] for rows, cols in self.blocks()]
        return np.concatenate([block.reshape(len(block), -1) for block in found], axis=1)


__all__ = ["BLOCK", "Maps"]

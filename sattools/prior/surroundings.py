"""What stands beside an area hides parts of it and shades them, so it is matched a little beyond its border.

Where the images show nothing beyond (they end there, or were cut to the area), a wider grid would only hold guesses,
which tell what is hidden, how walls stand and how bright shadows are as if they were ground.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sattools.camera import RPC
from sattools.camera.ground import project
from sattools.scene import Grid
from sattools.scene.grid import SURROUNDINGS_M

SHOWN = 0.5  # of the images that show a place of the area must show one beyond its border, as in a scene of all of it
ACROSS, ALONG = 4, 16  # places that are looked at in a strip, and per axis in the area


def with_surroundings(grid: Grid, cameras: Sequence[RPC], shapes: Sequence[tuple[int, int]], height: float) -> Grid:
    """A grid with `SURROUNDINGS_M` more on every side beyond which the images go on.

    Args:
        grid: of the area.
        cameras: of the images.
        shapes: (rows, columns) of the images [px].
        height: at which they are laid over the ground [m].
    """
    n = round(SURROUNDINGS_M / grid.cell_size)
    rows, cols = slice(0, grid.height), slice(0, grid.width)
    least = SHOWN * _shown(grid, cameras, shapes, height, (ALONG, ALONG))
    north, south = slice(-n, 0), slice(grid.height, grid.height + n)
    west, east = slice(-n, 0), slice(grid.width, grid.width + n)

    def beyond(part_rows: slice, part_cols: slice, counts: tuple[int, int]) -> int:
        shown = n > 0 and _shown(grid.part(part_rows, part_cols), cameras, shapes, height, counts) >= least
        return n if shown else 0

    top, bottom = (beyond(side, cols, (ACROSS, ALONG)) for side in (north, south))
    left, right = (beyond(rows, side, (ALONG, ACROSS)) for side in (west, east))
    return grid.part(slice(-top, grid.height + bottom), slice(-left, grid.width + right))


def _shown(
    grid: Grid, cameras: Sequence[RPC], shapes: Sequence[tuple[int, int]], height: float, counts: tuple[int, int]
) -> float:
    """Mean number of images that show a place of a grid, of so many places down and across."""
    west, south, east, north = grid.bounds
    down, across = ((np.arange(count) + 0.5) / count for count in counts)
    x, y = np.meshgrid(west + across * (east - west), south + down * (north - south))
    shown = 0
    for camera, (rows, cols) in zip(cameras, shapes, strict=True):
        col, row = project(camera, grid.crs, x.ravel(), y.ravel(), height)
        shown += int(((col >= 0) & (col <= cols - 1) & (row >= 0) & (row <= rows - 1)).sum())
    return shown / x.size


__all__ = ["with_surroundings"]

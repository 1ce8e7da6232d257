"""What stands beside an area hides parts of it and shades them, so it is matched a little beyond its border.

Where the images show nothing beyond (they end there, or were cut to the area), a wider grid would only hold guesses,
which tell what is hidden, how walls stand and how bright shadows are as if they were ground.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sattools.camera import RPC
from sattools.camera.ground import project
from sattools.scene import Grid
from sattools.scene.grid import SURROUNDINGS_M

SHOWN = 0.5  # of the images that show a place of the area must show one beyond its border, as in a scene of all of it
ACROSS, ALONG = 4, 16  # places that are looked at in a strip, and per axis in the area


def with_surroundings(
    grid: Grid, cameras: Sequence[RPC], shapes: Sequence[tuple[int, int]], height: float, reach: float | None = None
) -> Grid:
    """A grid with more on every side beyond which the images go on.

    Args:
        grid: of the area.
        cameras: of the images.
        shapes: (rows, columns) of the images [px].
        height: at which they are laid over the ground [m].
        reach: by how much more, at most, in steps of `SURROUNDINGS_M` [m]; None = one step.
    """
    wanted = round((reach or SURROUNDINGS_M) / grid.cell_size)
    step = round(SURROUNDINGS_M / grid.cell_size)
    rows, cols = slice(0, grid.height), slice(0, grid.width)
    least = SHOWN * _shown(grid, cameras, shapes, height, (ALONG, ALONG))

    def cells(strip: Callable[[int, int], tuple[slice, slice]], counts: tuple[int, int]) -> int:
        """How far the images go on beyond a side, whose strip between two distances is given [cells]."""
        far = 0
        while step and far < wanted:
            further = min(far + step, wanted)
            if not _shown(grid.part(*strip(far, further)), cameras, shapes, height, counts) >= least:
                break
            far = further
        return far

    level, upright = (ACROSS, ALONG), (ALONG, ACROSS)
    top = cells(lambda a, b: (slice(-b, -a), cols), level)
    bottom = cells(lambda a, b: (slice(grid.height + a, grid.height + b), cols), level)
    left = cells(lambda a, b: (rows, slice(-b, -a)), upright)
    right = cells(lambda a, b: (rows, slice(grid.width + a, grid.width + b)), upright)
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

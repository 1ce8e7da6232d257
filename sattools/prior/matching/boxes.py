"""Where a pass of the matching looks: in every tile and at every height, the cells near a surface known roughly."""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import njit

TILE, TILE_COLS = 24, 96  # cells
ALONG = 8  # columns, of which boxes hold whole numbers, as processors take so many at once


def active_boxes(
    heights: np.ndarray,
    guide: np.ndarray | None,
    shape: tuple[int, int],
    reach: int,
    margin: float,
    *,
    whole: bool = False,
) -> np.ndarray:
    """Boxes of cells, one for every tile of the kernel and every plane, outside of which the plane is not looked at.

    Args:
        heights: ``[D]`` of the planes, evenly spaced [m].
        guide: ``[H, W]`` surface that is known roughly [m]; None = all planes everywhere.
        shape: (rows, columns) of the grid.
        reach: cells along either axis within which the surface counts.
        margin: distance from the surface up to which planes are looked at [m].
        whole: boxes are whole tiles, and of a tile's planes none between two that are looked at is left out.

    Returns:
        ``[h, w, D, 4]`` int32: first row, end row, first column, end column within the tile; nothing where an end is
        its first. Between a street and the roofs beside it there may be planes near neither.
    """
    tiles = math.ceil(shape[0] / TILE), math.ceil(shape[1] / TILE_COLS)
    boxes = np.zeros((*tiles, len(heights), 4), np.int32)
    boxes[..., 1] = np.minimum(TILE, shape[0] - TILE * np.arange(tiles[0]))[:, None, None]
    boxes[..., 3] = np.minimum(TILE_COLS, shape[1] - TILE_COLS * np.arange(tiles[1]))[None, :, None]
    if guide is None:
        return boxes
    step = heights[1] - heights[0]
    first = np.clip(np.floor((guide - margin - heights[0]) / step), 0, len(heights) - 1).astype(np.int32)
    end = np.clip(np.ceil((guide + margin - heights[0]) / step) + 1, 1, len(heights)).astype(np.int32)
    near = boxes.copy()
    _enclose(first, end, reach, near)
    if not whole:
        return near
    some = near[..., 1] > near[..., 0]
    between = np.logical_or.accumulate(some, -1) & np.logical_or.accumulate(some[..., ::-1], -1)[..., ::-1]
    return np.where(between[..., None], boxes, 0)


@njit(cache=True)
def _enclose(first, end, reach, boxes):
    """Shrink boxes that are their tiles to what encloses all cells within reach of one that asks for the plane."""
    rows, cols = first.shape
    down, across, depth, _ = boxes.shape
    seen = np.empty((depth, 4), np.int32)
    for i in range(down):
        for j in range(across):
            seen[:, 0], seen[:, 1], seen[:, 2], seen[:, 3] = rows, -1, cols, -1
            for r in range(max(0, i * TILE - reach), min(rows, (i + 1) * TILE + reach)):
                for c in range(max(0, j * TILE_COLS - reach), min(cols, (j + 1) * TILE_COLS + reach)):
                    for k in range(first[r, c], end[r, c]):
                        seen[k, 0], seen[k, 1] = min(seen[k, 0], r), max(seen[k, 1], r)
                        seen[k, 2], seen[k, 3] = min(seen[k, 2], c), max(seen[k, 3], c)
            for k in range(depth):
                box = boxes[i, j, k]
                if seen[k, 1] < 0:
                    box[:] = 0
                    continue
                box[0] = max(0, seen[k, 0] - reach - i * TILE)
                box[1] = max(box[0], min(box[1], seen[k, 1] + reach + 1 - i * TILE))
                box[2] = max(0, seen[k, 2] - reach - j * TILE_COLS) // ALONG * ALONG
                box[3] = max(box[2], min(box[3], -(-(seen[k, 3] + reach + 1 - j * TILE_COLS) // ALONG) * ALONG))


__all__ = ["TILE", "TILE_COLS", "active_boxes"]

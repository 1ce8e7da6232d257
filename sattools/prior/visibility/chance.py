"""What stands high, and hardly a view agrees about.

Few images of different dates do not agree at all about some places: trees without leaves, wet ground, what stands in
shadow. There matching takes any height up to the top of those searched, with what is around it, and cells about which
two views agree by chance spread it over all that does not stand by itself (see `consistency`). A roof is not like that:
however much of it is glossy, some of it stands. So what is much higher than the ground around it that stands, and of
which hardly a cell does, is taken for that ground.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt, uniform_filter

from sattools.prior.neighbours import relief

HIGHER_M = 8.0  # above the ground: lower things are left to those around them
AROUND_M = 8.0  # edge of the square in which
SHARE = 0.05  # of what is so high has to stand (three images of one date: a tenth takes roofs from towers)
BLOCK_M = 4.0  # edge of a piece of ground, whose height is the median of what stands
DENSE_M, DENSE = 5.0, 0.3  # share of the square around a cell that stands where it tells of the ground
REACH_M = 26.0  # distance within which the ground is looked for,
LOW = 0.3  # the lowest pieces of ground there, as a share of all


def without_lumps(height: np.ndarray, stands: np.ndarray, cell: float) -> np.ndarray:
    """Heights ``[H, W]`` float32 in which what stands high by chance takes that of the ground around it.

    Args:
        height: ``[H, W]`` float32 [m].
        stands: ``[H, W]`` bool cells about which the views agree.
        cell: edge of a cell [m].
    """
    sure = stands & (uniform_filter(stands.astype(np.float32), _cells(DENSE_M, cell)) > DENSE)
    if not sure.any():
        return height
    block = max(1, round(BLOCK_M / cell))
    low = _ground(np.where(sure, height, np.float32(np.inf)), block, int(REACH_M / (block * cell)))
    high = height - low > HIGHER_M * relief(cell)
    size = _cells(AROUND_M, cell)
    firm, all_of_it = (uniform_filter(part.astype(np.float32), size) for part in (high & stands, high))
    return np.where(high & (firm < SHARE * all_of_it), low, height)


def _cells(metres: float, cell: float) -> int:
    """Edge of a square, in cells: an odd number."""
    return int(metres / cell) | 1


def _ground(height: np.ndarray, block: int, reach: int) -> np.ndarray:
    """Height ``[H, W]`` of the ground around every cell, of known heights ``[H, W]``; infinity = unknown.

    Args:
        height: at least one of which is known.
        block: edge of a piece of ground [cells].
        reach: distance of those that count [pieces].
    """
    rows, cols = (-(-n // block) for n in height.shape)
    padded = np.full((rows * block, cols * block), np.inf, np.float32)
    padded[: height.shape[0], : height.shape[1]] = height
    pieces = _rank(padded.reshape(rows, block, cols, block).swapaxes(1, 2).reshape(rows, cols, -1), 0.5)
    wide = np.pad(pieces, reach, constant_values=np.inf)
    window = np.lib.stride_tricks.sliding_window_view(wide, (2 * reach + 1, 2 * reach + 1))
    low = np.stack([_rank(row.reshape(cols, -1), LOW) for row in window])
    nearest = distance_transform_edt(np.isinf(low), return_distances=False, return_indices=True)
    low = low[tuple(nearest)].repeat(block, 0).repeat(block, 1)
    return np.asarray(low[: height.shape[0], : height.shape[1]])


def _rank(values: np.ndarray, share: float) -> np.ndarray:
    """Of the known values along the last axis that which has a share of the others below it; infinity without any."""
    known = np.isfinite(values).sum(axis=-1, keepdims=True)
    at = (np.maximum(known - 1, 0) * share).astype(np.intp)
    return np.asarray(np.take_along_axis(np.sort(values, axis=-1), at, axis=-1)[..., 0])


__all__ = ["without_lumps"]

"""The last step of matching: means over neighbouring cells, except across walls whose place the images agree on."""

from __future__ import annotations

import math

import numpy as np

from sattools.scene import Grid
from sattools.scene.regrid import resize_map

STEP_M = 2.0  # height step between neighbours from which they may be two sides of a wall
# across a step up to the first a wall may become a ramp, over the second not: a ramp is wrong on both sides of a wall
# that stands upright, by the more the higher it is (a lower limit suits simulated walls, lidar with ramps none)
TALL_M = (5.0, 15.0)
PASSES = 2  # twice 1 2 1: as wide as means of cells of twice the size, interpolated
BLURRED_M = (30.0, 60.0)  # the same for cells that a wall divides
FIRM = (0.4, 0.6)  # mean likeness to one side at walls: below the first they are anywhere, from the second on in place
SHARP = (0.5, 0.6)  # that of all walls of an area from which on cells with a wall in them belong to one side
OUTSTANDING = 0.14  # of a cell of the matching by which sharp walls stand out
SCALE_M = 20.0  # distance over which it is averaged
REACH_SCALES = 4  # of its standard deviations, beyond which a cell does not count for a mean
ALL_CELLS = 300.0  # walls all over the area that count as much as those around
# the mean of 3 x 3 cells weighted 1 2 1 by 1 2 1, as pairs of opposite neighbours: rows, columns, weight of either
_PAIRS = ((0, 1, 2 / 16), (1, 0, 2 / 16), (1, 1, 1 / 16), (1, -1, 1 / 16))
_OWN = 4 / 16
FINE_CELL_M = 0.7  # widest cell for which differences of height are meant in metres


def relief(cell: float) -> float:
    """Factor of the height differences that tell a wall from a slope, for cells of this width [m].

    They are meant for cells on which a roof or a street is flat. Between the centres of wider cells a mountain side
    rises as much, and would be taken for one wall beside the other.

    Args:
        cell: edge of a cell [m].
    """
    return max(1.0, cell / FINE_CELL_M)


def doubtful_walls(likeness: np.ndarray, beside_wall: np.ndarray, cell: float) -> np.ndarray:
    """How little the images say of where the walls around every cell are.

    A single cell that looks like neither side is one every wall has, so what counts is how surely cells beside walls
    belong to one side on the average around, drawn to that of the whole area where walls are few.

    Args:
        likeness: ``[H, W]`` to the high side, -1 ... 1; 0 = unknown.
        beside_wall: ``[H, W]`` bool.
        cell: edge of a cell [m].

    Returns:
        ``[H, W]`` float32: 0 = walls are in place, 1 = they may be anywhere near; 1 also away from all walls.
    """
    doubt = np.ones(likeness.shape, np.float32)
    if not beside_wall.any():
        return doubt
    mean = mean_around(np.abs(likeness), beside_wall, SCALE_M / cell)
    doubt[beside_wall] = np.clip((FIRM[1] - mean[beside_wall]) / (FIRM[1] - FIRM[0]), 0.0, 1.0)
    return doubt


def blurred_walls(likeness: np.ndarray, beside_wall: np.ndarray) -> float:
    """Whether a cell that a wall divides is best the mean of its sides (1) or the side that has more of it (0).

    Walls whose cells surely belong to one side are steps, of which a cell has one side. Lidar makes ramps of many real
    ones, for a cell holds returns of roof and ground and of what hangs between them, and so the means are nearer to it.
    That goes by scenes, not by walls: where single walls of such a scene are sure, the means are nearer, too.

    Args:
        likeness: ``[H, W]`` to the high side, -1 ... 1; 0 = unknown.
        beside_wall: ``[H, W]`` bool.
    """
    if not beside_wall.any():
        return 1.0
    mean = float(np.abs(likeness[beside_wall]).mean())
    return min(max((SHARP[1] - mean) / (SHARP[1] - SHARP[0]), 0.0), 1.0)


def mean_around(values: np.ndarray, where: np.ndarray, scale: float) -> np.ndarray:
    """Mean of some cells around every cell, drawn to that of the whole area where they are few.

    Args:
        values: ``[H, W]``; those elsewhere do not count.
        where: ``[H, W]`` bool, at least one of them.
        scale: standard deviation of the mean [cells].

    Returns:
        ``[H, W]`` float32.
    """
    import cv2

    cells = 2 * math.pi * scale * scale
    size = 2 * math.ceil(REACH_SCALES * scale) + 1
    total, count = (
        cv2.GaussianBlur(cell.astype(np.float32), (size, size), scale, borderType=cv2.BORDER_CONSTANT) * cells
        for cell in (np.where(where, values, 0.0), where)
    )
    mean: np.ndarray = (total + np.float32(ALL_CELLS * float(values[where].mean()))) / (count + np.float32(ALL_CELLS))
    return mean


def mean_of_neighbours(height: np.ndarray, doubt: np.ndarray | None = None, step_m: float = STEP_M) -> np.ndarray:
    """Heights averaged over neighbouring cells, across a step only as far as it may as well be elsewhere.

    A wall in the wrong place costs its whole height; where nothing says on which side of it a cell lies, the mean of
    both sides is the height to expect, unless one side stands towers above the other. Opposite neighbours get the same
    weight, so that planes stay as they are, also where they end at a wall.

    Args:
        height: ``[H, W]`` [m]; NaN = none.
        doubt: ``[H, W]`` 0 ... 1, weight of a cell for one on the other side of a step; None = 0.
        step_m: height step between neighbours from which they may be two sides of a wall [m].

    Returns:
        ``[H, W]`` float32 heights [m]; NaN where there was none.
    """
    rows, cols = height.shape
    across = np.zeros(height.shape, np.float32) if doubt is None else doubt.astype(np.float32)
    around_across = np.pad(across, 1, mode="edge")
    here = height.astype(np.float32)
    for _ in range(PASSES):
        # mirrored in value, too: a slope goes on beyond the border
        around = np.pad(here, 1, mode="reflect", reflect_type="odd") if min(rows, cols) > 1 else np.pad(here, 1, "edge")
        total, weight = _OWN * here, np.full(height.shape, _OWN, np.float32)
        for down, right, share in _PAIRS:
            pair = np.full(height.shape, share, np.float32)
            both = np.zeros(height.shape, np.float32)
            for sign in (1, -1):
                there = slice(1 + sign * down, 1 + sign * down + rows), slice(1 + sign * right, 1 + sign * right + cols)
                near = around[there]
                step = np.abs(near - here)
                same = step <= step_m
                low = np.clip((TALL_M[1] - step) / (TALL_M[1] - TALL_M[0]), 0, 1)
                crossing = np.where(np.isfinite(near), np.minimum(around_across[there], across) * low, np.float32(0))
                pair = np.minimum(pair, np.float32(share) * np.where(same, np.float32(1), crossing))
                both += np.nan_to_num(near)
            total += pair * both
            weight += 2 * pair
        here = total / weight
    return here


def quarters(height: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Heights ``[2 H, 2 W]`` of the quarters of every cell: what lies beyond a wall has the heights beyond it.

    Args:
        height: ``[H, W]`` float32 [m].
        side: ``[H, W]`` > 0 on the high side of a wall, < 0 on the low one, linear between the centres of cells; NaN =
            not beside a wall.
    """
    result = height.repeat(2, axis=0).repeat(2, axis=1)
    around, heights = np.pad(side, 1, constant_values=np.nan), np.pad(height, 1)
    rows, cols = height.shape
    for down in (-1, 1):
        for right in (-1, 1):
            steps = ((down, 0), (0, right), (down, right))
            parts = [(slice(1 + i, 1 + i + rows), slice(1 + j, 1 + j + cols)) for i, j in steps]
            near = [np.where(np.isnan(around[part]), side, around[part]) for part in parts]
            there = (9 * side + 3 * near[0] + 3 * near[1] + near[2]) / 16  # at the middle of the quarter
            beyond = side * there < 0
            other = [beyond & (side * value < 0) for value in near]
            count = np.maximum(sum(part.astype(np.float32) for part in other), 1)
            mean = sum(np.where(theirs, heights[part], 0) for theirs, part in zip(other, parts, strict=True)) / count
            quarter = result[max(down, 0) :: 2, max(right, 0) :: 2]
            quarter[beyond] = mean[beyond]
    return result


def means_of_cells(
    height: np.ndarray, source: Grid, target: Grid, blur: float = 1.0, step_m: float = STEP_M, *, out: float = 0.0
) -> np.ndarray:
    """Heights on coarser cells: where a step divides a cell, the mean of the side that has more of it.

    Walls stand out a little, as windows that hold some of a roof go by the roof; so the high side needs that much more
    of a cell. Where walls are blurred, nobody knows.

    Args:
        height: ``[H, W]`` [m], without gaps.
        source: its grid.
        target: one with the same upper left corner; its cells beyond the source continue the border.
        blur: how far a divided cell is the mean of all of it instead, 0 ... 1; less for the steps of towers.
        step_m: height range of a cell from which on it is divided [m].
        out: by which sharp walls stand out, as share of a cell of the target.

    Returns:
        ``[h, w]`` float32.
    """
    means = resize_map(height, source, target)
    factor = target.cell_size / source.cell_size
    if factor <= 1:
        return means
    (rows, down), (cols, across) = (
        _covered(count, size, factor) for count, size in zip(target.shape, height.shape, strict=True)
    )
    low, high = (reduce(reduce(height[rows], axis=1)[:, cols], axis=2) for reduce in (np.min, np.max))
    divided = np.nonzero(high - low > step_m)
    row, col = divided
    size = (len(row), rows.shape[1] * cols.shape[1])
    parts = height[rows[row][:, :, None], cols[col][:, None, :]].reshape(size)
    share = (down[row][:, :, None] * across[col][:, None, :]).reshape(size)
    order = np.argsort(parts, axis=1)
    upto = np.cumsum(np.take_along_axis(share, order, axis=1), axis=1)
    needed = upto[:, -1:] * (0.5 - (1 - blur) * out)
    middle = np.take_along_axis(order, (upto >= needed).argmax(axis=1)[:, None], axis=1)
    share *= np.abs(parts - np.take_along_axis(parts, middle, axis=1)) <= step_m
    side = (parts * share).sum(axis=1) / share.sum(axis=1)
    tall = np.clip((BLURRED_M[1] - (high - low)[divided]) / (BLURRED_M[1] - BLURRED_M[0]), 0, 1)
    means[divided] = side + blur * tall * (means[divided] - side)
    return means


def _covered(count: int, size: int, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Which of ``size`` cells ``count`` cells ``factor`` times as wide cover, ``[count, n]``, and their shares."""
    first = np.arange(count)[:, None] * factor
    cells = np.floor(first + 1e-9).astype(int) + np.arange(math.ceil(factor) + 1)
    share = np.minimum(cells + 1, first + factor) - np.maximum(cells, first)
    return np.minimum(cells, size - 1), np.clip(share, 0, 1)


__all__ = [
    "OUTSTANDING",
    "STEP_M",
    "blurred_walls",
    "doubtful_walls",
    "mean_around",
    "mean_of_neighbours",
    "means_of_cells",
    "quarters",
    "relief",
]

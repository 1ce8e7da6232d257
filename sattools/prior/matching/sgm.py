"""Semi-global aggregation of a cost volume and the height of least cost, compiled."""

from __future__ import annotations

import numpy as np

from sattools.compiled import FASTMATH, njit, prange

ROW_STEPS = (0, 0, 1, -1, 1, -1, 1, -1)
COL_STEPS = (1, -1, 0, 0, 1, -1, -1, 1)


@njit(cache=True, fastmath=FASTMATH)
def _starts(rows, cols, dr, dc):
    """Cells ``[N, 2]`` on the edges where the paths of a direction enter; every cell lies on exactly one path."""
    starts = np.empty((rows + cols, 2), np.int64)
    n = 0
    if dr != 0:
        for col in range(cols):
            starts[n, 0] = 0 if dr == 1 else rows - 1
            starts[n, 1] = col
            n += 1
    if dc != 0:
        for row in range(rows):
            # the corner has been entered through its row already
            if dr != 0 and row == (0 if dr == 1 else rows - 1):
                continue
            starts[n, 0] = row
            starts[n, 1] = 0 if dc == 1 else cols - 1
            n += 1
    return starts[:n]


@njit(parallel=True, cache=True, fastmath=FASTMATH)
def aggregate(score, small, large, total):
    """Sum of the semi-global path costs of eight directions (Hirschmueller 2008, eq. 13), cost = 1 - score.

    Args:
        score: ``[H, W, D]`` float32, at most 1.
        small: penalty for a change by one plane.
        large: penalty for any larger change.
        total: ``[H, W, D]`` float32, filled.
    """
    rows, cols, depth = score.shape
    huge = np.float32(1e9)
    one = np.float32(1)
    for direction in range(8):
        dr, dc = ROW_STEPS[direction], COL_STEPS[direction]
        starts = _starts(rows, cols, dr, dc)
        for s in prange(starts.shape[0]):
            row, col = starts[s, 0], starts[s, 1]
            # one plane more on either side, never the cheapest, spares the loop its tests
            before = np.zeros(depth + 2, np.float32)
            now = np.empty(depth + 2, np.float32)
            before[0] = before[depth + 1] = now[0] = now[depth + 1] = huge
            least = np.float32(0)
            while 0 <= row < rows and 0 <= col < cols:
                here, out = score[row, col], total[row, col]
                jump = least + large
                smallest = huge
                for k in range(depth):
                    value = min(min(before[k], before[k + 2]) + small, min(before[k + 1], jump))
                    value += one - here[k] - least
                    now[k + 1] = value
                    smallest = min(smallest, value)
                if direction == 0:
                    for k in range(depth):
                        out[k] = now[k + 1]
                else:
                    for k in range(depth):
                        out[k] += now[k + 1]
                before, now = now, before
                least = smallest
                row += dr
                col += dc


@njit(parallel=True, cache=True, fastmath=FASTMATH)
def lowest(total, heights, height, index):
    """Height of least cost, refined by a parabola through its neighbours.

    Args:
        total: ``[H, W, D]`` float32 costs.
        heights: ``[D]`` float64, evenly spaced [m].
        height: ``[H, W]`` float32, filled [m].
        index: ``[H, W]`` int64, filled with the plane of least cost.
    """
    rows, cols, depth = total.shape
    step = heights[1] - heights[0]
    for row in prange(rows):
        for col in range(cols):
            k = np.argmin(total[row, col])
            index[row, col] = k
            z = heights[k]
            if 0 < k < depth - 1:
                a, b, c = total[row, col, k - 1], total[row, col, k], total[row, col, k + 1]
                bend = a - 2 * b + c
                if bend > 0:
                    z += step * 0.5 * (a - c) / bend
            height[row, col] = z


@njit(parallel=True, cache=True, fastmath=FASTMATH)
def second_best_margin(total, index, gap):
    """How much dearer the cheapest height is that is not a neighbour of the best one.

    Args:
        total: ``[H, W, D]`` float32 costs.
        index: ``[H, W]`` plane of least cost.
        gap: ``[H, W]`` float32, filled; 0 where there are too few planes.
    """
    rows, cols, depth = total.shape
    for row in prange(rows):
        for col in range(cols):
            best = index[row, col]
            least = np.float32(1e9)
            for k in range(depth):
                if k < best - 1 or k > best + 1:
                    least = min(least, total[row, col, k])
            gap[row, col] = least - total[row, col, best] if least < np.float32(1e9) else np.float32(0)


__all__ = ["aggregate", "lowest", "second_best_margin"]

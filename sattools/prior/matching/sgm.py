"""Semi-global aggregation of a cost volume and the height of least cost, compiled.

Volumes are ``[H, D, W]``, all columns of a row and plane side by side: what is done to one column is done to the others
as well, so every loop over them is vectorised, however many planes there are.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from sattools.compiled import FASTMATH, at_once, njit, spread

HUGE = np.float32(1e9)  # cost of a plane beyond the first and last, never the cheapest
ONE = np.float32(1)
ROWS_AT_ONCE = 8  # that one thread aggregates along, in the same scratch memory


@njit(cache=True, fastmath=FASTMATH)
def _along(cost, large, small, result, before, now, backwards):
    """One path along a row: ``cost`` and ``result`` are ``[W, D]``; forwards it is written, backwards added."""
    cols, depth = cost.shape
    before[:] = 0
    before[0] = before[depth + 1] = now[0] = now[depth + 1] = HUGE
    least = np.float32(0)
    for i in range(cols):
        col = cols - 1 - i if backwards else i
        here, out = cost[col], result[col]
        jump = least + large
        smallest = HUGE
        for k in range(depth):
            value = min(min(before[k], before[k + 2]) + small, min(before[k + 1], jump)) + (here[k] - least)
            now[k + 1] = value
            out[k] = value + (out[k] if backwards else np.float32(0))
            smallest = min(smallest, value)
        before, now = now, before
        least = smallest


@spread(lambda score, *_: math.ceil(len(score) / ROWS_AT_ONCE))
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def _along_rows(score, small, large, total, first_group, end_group):
    """Fill ``total`` with the costs of the two paths along the rows."""
    rows, depth, cols = score.shape
    for group in range(first_group, end_group):
        # a path goes from column to column, so here the planes lie side by side
        cost, result = np.empty((cols, depth), np.float32), np.empty((cols, depth), np.float32)
        before, now = np.empty(depth + 2, np.float32), np.empty(depth + 2, np.float32)
        for row in range(group * ROWS_AT_ONCE, min((group + 1) * ROWS_AT_ONCE, rows)):
            for k in range(depth):
                for col in range(cols):
                    cost[col, k] = ONE - score[row, k, col]
            for way in range(2):  # forwards, backwards; constants would have it compiled once for each
                _along(cost, large, small, result, before, now, way == 1)
            for k in range(depth):
                for col in range(cols):
                    total[row, k, col] = result[col, k]


@njit(cache=True, fastmath=FASTMATH)
def _plane(below, same, above, least, score, small, large, now, now_least):
    """One plane of the path costs of a row, from those of the row before."""
    for j in range(score.shape[0]):
        value = min(min(below[j], above[j]) + small, min(same[j], least[j] + large)) + (ONE - score[j] - least[j])
        now[j] = value
        now_least[j] = min(now_least[j], value)


@njit(cache=True, fastmath=FASTMATH)
def _add(out, a, b, c):
    for j in range(out.shape[0]):
        out[j] += a[j] + b[j] + c[j]


@njit(cache=True, fastmath=FASTMATH, nogil=True)
def _across_rows(score, small, large, total, first, count, step, turn, state, least):
    """Add the costs of the three paths that lead from row to row, in one direction, for some rows.

    Args:
        score: ``[H, D, W]``.
        small: penalty for a change by one plane.
        large: penalty for any larger change.
        total: ``[H, D, W]``, changed.
        first: row to begin with.
        count: number of rows.
        step: 1 = down, -1 = up.
        turn: which of the two states is that of the row before.
        state: ``[2, 3, D + 2, W + 2]`` path costs of the last rows, with a border of planes that are never the cheapest
            and of columns at which paths enter.
        least: ``[2, 3, W + 2]`` their least.

    Returns:
        Which state is that of the last row.
    """
    depth, cols = score.shape[1], score.shape[2]
    for n in range(count):
        row = first + n * step
        before, now, least_before, least_now = state[turn], state[1 - turn], least[turn], least[1 - turn]
        least_now[:, 1 : cols + 1] = HUGE
        for k in range(depth):
            for way in range(3):  # from the left, straight, from the right
                from_here = slice(way, way + cols)
                _plane(
                    before[way, k, from_here], before[way, k + 1, from_here], before[way, k + 2, from_here],
                    least_before[way, from_here], score[row, k], small, large, now[way, k + 1, 1 : cols + 1],
                    least_now[way, 1 : cols + 1],
                )  # fmt: skip
            inner = slice(1, cols + 1)
            _add(total[row, k], now[0, k + 1, inner], now[1, k + 1, inner], now[2, k + 1, inner])
        turn = 1 - turn
    return turn


def aggregate(score, small, large, total):
    """Sum of the semi-global path costs of eight directions (Hirschmueller 2008, eq. 13), cost = 1 - score.

    Args:
        score: ``[H, D, W]`` float32, at most 1.
        small: penalty for a change by one plane.
        large: penalty for any larger change.
        total: ``[H, D, W]`` float32, filled.
    """
    rows, depth, cols = score.shape
    _along_rows(score, small, large, total)
    state = np.zeros((2, 2, 3, depth + 2, cols + 2), np.float32)
    state[:, :, :, 0] = state[:, :, :, depth + 1] = HUGE
    least = np.zeros((2, 2, 3, cols + 2), np.float32)
    turn = [0, 0]
    half = rows // 2

    def go(way: int, upper: bool) -> None:
        first = (0 if upper else half) if way == 0 else (half - 1 if upper else rows - 1)
        count, step = half if upper else rows - half, 1 if way == 0 else -1
        turn[way] = _across_rows(score, small, large, total, first, count, step, turn[way], state[way], least[way])

    # one thread goes down, another up; they change halves at the same time, so that no row is added to by both at once
    for phase in range(2):
        at_once(*(functools.partial(go, way, way == phase) for way in range(2)))


@spread(lambda total, *_: len(total))
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def lowest(total, heights, height, index, first_row, end_row):
    """Height of least cost, refined by a parabola through its neighbours.

    Args:
        total: ``[H, D, W]`` float32 costs.
        heights: ``[D]`` float64, evenly spaced [m].
        height: ``[H, W]`` float32, filled [m].
        index: ``[H, W]`` int32, filled with the plane of least cost.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    depth, cols = total.shape[1:]
    step = heights[1] - heights[0]
    for row in range(first_row, end_row):
        least, best = total[row, 0].copy(), index[row]
        best[:] = 0
        for k in range(1, depth):
            here = total[row, k]
            for col in range(cols):
                best[col] = np.int32(k) if here[col] < least[col] else best[col]
                least[col] = min(here[col], least[col])
        for col in range(cols):
            k = best[col]
            z = heights[k]
            if 0 < k < depth - 1:
                a, b, c = total[row, k - 1, col], total[row, k, col], total[row, k + 1, col]
                bend = a - 2 * b + c
                if bend > 0:
                    z += step * 0.5 * (a - c) / bend
            height[row, col] = z


@spread(lambda total, *_: len(total))
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def second_best_margin(total, index, gap, first_row, end_row):
    """How much dearer the cheapest height is that is not a neighbour of the best one.

    Args:
        total: ``[H, D, W]`` float32 costs.
        index: ``[H, W]`` int32 plane of least cost.
        gap: ``[H, W]`` float32, filled; 0 where there are too few planes.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    depth, cols = total.shape[1:]
    for row in range(first_row, end_row):
        best, rival = index[row], gap[row]
        rival[:] = HUGE
        for k in range(depth):
            here = total[row, k]
            for col in range(cols):
                apart = abs(best[col] - np.int32(k)) > 1
                rival[col] = min(rival[col], here[col] if apart else HUGE)
        for col in range(cols):
            rival[col] = rival[col] - total[row, best[col], col] if rival[col] < HUGE else np.float32(0)


__all__ = ["aggregate", "lowest", "second_best_margin"]

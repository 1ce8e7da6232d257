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
ROWS_AT_ONCE = 16  # that one thread aggregates along, side by side


@njit(cache=True, fastmath=FASTMATH)
def _step(before, offset, least, look_before, look, score, small, edge, more, steep, scratch, now, now_least, total):
    """One step of a path, at all heights, side by side for n places.

    Going up or down by more than a plane costs by how much the images change over the step, *at the upper height*: a
    wall is an edge of what stands above it, there all views see it at one place. So the best height to come from is
    one of those below, which have the penalty of where the path goes, or of those above, each with its own.

    Args:
        before: ``[D + 2, n + 2]`` path costs of the places before, with a border of planes that are never the cheapest.
        offset: of the first of those places in it.
        least: ``[n + 2]`` their least.
        look_before: ``[D, n + 2]`` what the images show there.
        look: ``[D, n + 2]`` what they show here, from the second place on.
        score: ``[D, n]``.
        small: see `Penalties`, like the others.
        edge: see `Penalties`.
        more: what it costs besides where nothing changes.
        steep: 1 / contrast^2.
        scratch: ``[2 D + 2, n]``.
        now: ``[D + 2, n + 2]`` path costs here, written from the second place on.
        now_least: ``[n + 2]`` their least.
        total: ``[D, n]``, to which they are added.
    """
    depth, n = score.shape
    end = offset + n
    lowest_below = scratch[2 * depth + 1]
    scratch[depth] = HUGE
    for k in range(depth - 1, -1, -1):
        shown, shown_before, cost = look[k, 1 : n + 1], look_before[k, offset:end], before[k + 1, offset:end]
        higher, from_above, penalty = scratch[k + 1], scratch[k], scratch[depth + 1 + k]
        for j in range(n):
            change = shown[j] - shown_before[j]
            penalty[j] = edge + more / (ONE + steep * change * change)
            from_above[j] = min(higher[j], cost[j] + penalty[j])
    lowest_below[:] = HUGE
    least_before, least_now = least[offset:end], now_least[1 : n + 1]
    least_now[:] = HUGE
    for k in range(depth):
        below, same, above = before[k, offset:end], before[k + 1, offset:end], before[k + 2, offset:end]
        from_above, penalty = scratch[k + 1], scratch[depth + 1 + k]
        agreed, here, summed = score[k], now[k + 1, 1 : n + 1], total[k]
        for j in range(n):
            jump = min(lowest_below[j] + penalty[j], from_above[j])
            value = min(min(below[j], above[j]) + small, min(same[j], jump)) + (ONE - agreed[j] - least_before[j])
            lowest_below[j] = min(lowest_below[j], same[j])
            here[j] = value
            least_now[j] = min(least_now[j], value)
            summed[j] += value


@spread(lambda score, *_: math.ceil(len(score) / ROWS_AT_ONCE))
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def _along_rows(score, look, small, edge, more, steep, total, first_group, end_group):
    """Fill ``total`` with the costs of the two paths along the rows."""
    rows, depth, cols = score.shape
    # a path goes from column to column, so here rows lie side by side; made once: new pages cost as much as the paths
    most = min(ROWS_AT_ONCE, rows)
    room, scratch = np.zeros((2, cols, depth, most), np.float32), np.empty((2 * depth + 2, most), np.float32)
    shown, state = np.zeros((cols, depth, most + 2), np.float32), np.empty((2, depth + 2, most + 2), np.float32)
    least, straight = np.empty((2, most + 2), np.float32), np.int64(1)  # no constant: `_step` would be compiled twice
    for group in range(first_group, end_group):
        top = group * ROWS_AT_ONCE
        n = min(ROWS_AT_ONCE, rows - top)
        agreed, result = room[0], room[1]  # in a last, smaller group some of it is of the one before, to no effect
        result[:] = 0
        for k in range(depth):
            for i in range(n):
                for col in range(cols):
                    agreed[col, k, i] = score[top + i, k, col]
                    shown[col, k, i + 1] = look[top + i, k, col]
        for way in range(2):  # forwards, backwards
            state[:] = 0
            least[:] = 0
            state[:, 0] = state[:, depth + 1] = HUGE
            last = cols - 1 if way else 0
            for m in range(cols):
                col, now = cols - 1 - m if way else m, m % 2
                _step(
                    state[1 - now], straight, least[1 - now], shown[last], shown[col], agreed[col], small, edge, more,
                    steep, scratch, state[now], least[now], result[col],
                )  # fmt: skip
                last = col
        for k in range(depth):
            for i in range(n):
                for col in range(cols):
                    total[top + i, k, col] = result[col, k, i]


@njit(cache=True, fastmath=FASTMATH, nogil=True)
def _across_rows(score, look, small, edge, more, steep, total, first, count, step, turn, state, least, looks):
    """Add the costs of the three paths that lead from row to row, in one direction, for some rows.

    Args:
        score: ``[H, D, W]``.
        look: ``[H, D, W]``.
        small: see `Penalties`, like the others.
        edge: see `Penalties`.
        more: what it costs besides where nothing changes.
        steep: 1 / contrast^2.
        total: ``[H, D, W]``, changed.
        first: row to begin with.
        count: number of rows.
        step: 1 = down, -1 = up.
        turn: which of the two states is that of the row before.
        state: ``[2, 3, D + 2, W + 2]`` path costs of the last rows, with a border of planes that are never the cheapest
            and of columns at which paths enter.
        least: ``[2, 3, W + 2]`` their least.
        looks: ``[2, D, W + 2]`` what the images show there.

    Returns:
        Which state is that of the last row.
    """
    depth, cols = score.shape[1], score.shape[2]
    scratch = np.empty((2 * depth + 2, cols), np.float32)
    for n in range(count):
        row = first + n * step
        for k in range(depth):
            for col in range(cols):  # a row at once would take numba three seconds more to compile
                looks[1 - turn, k, col + 1] = look[row, k, col]
        for way in range(3):  # from the left, straight, from the right
            _step(
                state[turn, way], way, least[turn, way], looks[turn], looks[1 - turn], score[row], small, edge, more,
                steep, scratch, state[1 - turn, way], least[1 - turn, way], total[row],
            )  # fmt: skip
        turn = 1 - turn
    return turn


def aggregate(score, look, penalties, total):
    """Sum of the semi-global path costs of eight directions (Hirschmueller 2008, eq. 13), cost = 1 - score.

    Hirschmueller lets the larger penalty depend on the change of brightness in one image. Here there is none that the
    heights belong to, but at every height a mean of all images, whose edges are sharp where things are that high.

    Args:
        score: ``[H, D, W]`` float32, at most 1.
        look: ``[H, D, W]`` float32, what the images show there on average.
        penalties: see `Penalties`.
        total: ``[H, D, W]`` float32, filled.
    """
    rows, depth, cols = score.shape
    more, steep = penalties.plain - penalties.edge, 1 / penalties.contrast**2
    weights = tuple(np.float32(x) for x in (penalties.small, penalties.edge, more, steep))
    _along_rows(score, look, *weights, total)
    state = np.zeros((2, 2, 3, depth + 2, cols + 2), np.float32)
    state[:, :, :, 0] = state[:, :, :, depth + 1] = HUGE
    least, looks = np.zeros((2, 2, 3, cols + 2), np.float32), np.zeros((2, 2, depth, cols + 2), np.float32)
    turn = [0, 0]
    half = rows // 2

    def go(way: int, upper: bool) -> None:
        first = (0 if upper else half) if way == 0 else (half - 1 if upper else rows - 1)
        count, step = half if upper else rows - half, 1 if way == 0 else -1
        memory = turn[way], state[way], least[way], looks[way]
        turn[way] = _across_rows(score, look, *weights, total, first, count, step, *memory)

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

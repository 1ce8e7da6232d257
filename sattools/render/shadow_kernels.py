"""Compiled CPU kernels of the sun's cast shadows.

All arrays are float32 and contiguous. Positions are in cells of the height grid (column = east, row = south), heights
in metres.
"""

from __future__ import annotations

import numpy as np

from sattools.compiled import FASTMATH, njit, spread
from sattools.render.blocks import LANES

# narrowest ramp of a shadow on a slope that the sun grazes, of the ray's rise over a cell
LEAST_RAMP = 0.05
ROUNDING = 1e-5  # of a share of light
SURELY_M = 1e-3  # by which a ray clears what it need not be compared with, far more than single precision rounds
# places of a block's numbers in its workspace: height and ramp of the cells, least share of light so far, and the ramp
# and the plate (counted on the way) where that was found
_BASE, _OWN, _BEST, _WIDE, _WHERE = (np.uint64(k * LANES) for k in range(5))


@njit(fastmath=FASTMATH, inline="always")
def _limited(before, here, after):
    """Slope of a cell from its neighbours: the flatter of both, 0 where they disagree (minmod).

    So a slope stays one, and a wall stays a step between level cells.
    """
    back, ahead = here - before, after - here
    if back * ahead <= 0:
        return np.float32(0.0)
    return back if abs(back) < abs(ahead) else ahead


@spread(lambda height, *_: len(height))
@njit(cache=True, nogil=True)
def limited_slopes(height, slope_x, slope_y, first, end):
    """Rise of every cell's plate per cell along columns and rows [m], filled in; 0 across the map's edge."""
    rows, cols = height.shape
    for row in range(first, end):
        for col in range(cols):
            h = height[row, col]
            across = 0 < col < cols - 1
            slope_x[row, col] = _limited(height[row, col - 1], h, height[row, col + 1]) if across else 0.0
            along = 0 < row < rows - 1
            slope_y[row, col] = _limited(height[row - 1, col], h, height[row + 1, col]) if along else 0.0


@njit(fastmath=FASTMATH)
def _path(dx, dy, rows, cols):
    """Cells that a ray from the middle of a cell passes.

    Columns and rows from there [n], and path lengths at which it enters each [n + 1]; the ray leaves a cell where it
    enters the next one.
    """
    half, never = np.float32(0.5), np.float32(1e30)
    step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    delta_c = np.float32(1.0) / abs(dx) if abs(dx) > np.float32(1e-6) else never
    delta_r = np.float32(1.0) / abs(dy) if abs(dy) > np.float32(1e-6) else never
    aside, down = np.zeros(rows + cols, np.int64), np.zeros(rows + cols, np.int64)
    enters = np.empty(rows + cols + 1, np.float32)
    c, r = 0, 0
    next_c, next_r = half * delta_c, half * delta_r
    for k in range(rows + cols):
        enters[k] = min(next_c, next_r)
        if next_c < next_r:
            next_c += delta_c
            c += step_c
        else:
            next_r += delta_r
            r += step_r
        aside[k], down[k] = c, r
    enters[rows + cols] = min(next_c, next_r)
    return aside, down, enters


@njit(fastmath=FASTMATH)
def _start(s, height, slope_x, slope_y, at, count, dx, dy, tangent):
    """A block's cells before their rays leave.

    Returns how many are turned to the sun, the lowest of these and the widest of their ramps [m].
    """
    half, one, zero, never = np.float32(0.5), np.float32(1.0), np.float32(0.0), np.float32(1e30)
    lit, low, wide = np.int32(0), never, zero
    for j in range(count):
        # the ray's rise over the cell's own plate, from its middle to its end: below that, a part is lit
        own = half * (tangent - slope_x[at + j] * dx - slope_y[at + j] * dy)
        s[_BASE + j] = height[at + j]
        s[_WIDE + j] = own
        s[_OWN + j] = max(own, np.float32(LEAST_RAMP) * tangent)
        s[_BEST + j] = zero if own <= zero else one
        s[_WHERE + j] = -one
        lit = np.int32(lit + np.int32(own > zero))
        low = min(low, height[at + j] if own > zero else never)
        wide = max(wide, s[_OWN + j])
    return lit, low, wide


@njit(fastmath=FASTMATH)
def _meet(s, height, slope_x, slope_y, at, first, end, k, aside, down, enter, leave, dx, dy, tangent, growth, top):
    """Compare the rays of a block's cells first to end with the k-th plates on their way; returns how many go on."""
    half, zero, two = np.float32(0.5), np.float32(0.0), np.float32(2.0)
    x0, y0 = aside + dx * enter, down + dy * enter
    x1, y1 = aside + dx * leave, down + dy * leave
    here = np.float32(k)
    going = np.int32(0)
    for j in range(first, end):
        base, own, best = s[_BASE + j], s[_OWN + j], s[_BEST + j]
        ramp0, ramp1 = own + growth * (enter - half), own + growth * (leave - half)
        goes = (best > zero) & (base + enter * tangent <= top + ramp0)
        tilt_x, tilt_y, h = slope_x[at + j], slope_y[at + j], height[at + j]
        over0 = base + enter * tangent - h - tilt_x * x0 - tilt_y * y0
        over1 = base + leave * tangent - h - tilt_x * x1 - tilt_y * y1
        lit0, lit1 = half + over0 / (two * ramp0), half + over1 / (two * ramp1)
        less = goes & (lit0 < best - np.float32(ROUNDING))
        best = lit0 if less else best
        wide = ramp0 if less else s[_WIDE + j]
        again = goes & (lit1 < best - np.float32(ROUNDING))
        s[_BEST + j] = lit1 if again else best
        s[_WIDE + j] = ramp1 if again else wide
        s[_WHERE + j] = here if less | again else s[_WHERE + j]
        going = np.int32(going + np.int32(goes))
    return going


@spread(lambda *arguments: arguments[-1])
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def shadow_march(
    height, slope_x, slope_y, direction, tangent, growth, top, tops, visibility, caster, width, chunks, from_chunk,
    to_chunk,
):  # fmt: skip
    """Sun visibility of every cell, and which cell casts the shadow.

    The cells are plates with the slopes of `limited_slopes` and steps between them; the ray from a cell's middle is
    compared with every plate where it enters and where it leaves it. All rays pass the same sequence of cells, counted
    from their own, so that `LANES` neighbours go together, as in `sattools.render.kernels`. They need not meet what is
    lower than all of them, as most is soon after they have left.

    direction: (columns, rows) per cell length towards the sun, unit length; tangent: rise per cell length [m]; growth
    [m per cell]: of half the width of the penumbra with distance; top: nothing is higher [m]; tops [H, W / LANES]:
    nor in a row's blocks of `LANES` cells.
    visibility [H, W] in [0, 1]; caster [H, W]: flat index of the deciding cell, -1 where nothing is near the sun ray;
    width [H, W]: half the width of the ramp there [m].
    """
    rows, cols = height.shape
    dx, dy = direction[0], direction[1]
    aside, down, enters = _path(dx, dy, rows, cols)
    flat, flat_x, flat_y = height.reshape(-1), slope_x.reshape(-1), slope_y.reshape(-1)
    for chunk in range(from_chunk, to_chunk):
        s = np.empty(5 * LANES, np.float32)
        for row in range(chunk, rows, chunks):
            for col in range(0, cols, LANES):
                count = min(LANES, cols - col)
                going, low, wide = _start(
                    s, flat, flat_x, flat_y, np.uint64(row * cols + col), np.uint64(count), dx, dy, tangent
                )  # fmt: skip
                k = np.int64(0)  # a plain 0 is a type of its own: `_meet` would be compiled twice
                while going > 0:
                    r, c = row + down[k], col + aside[k]
                    first, end = max(0, -c), min(count, cols - c)
                    if r < 0 or r >= rows or first >= end:
                        break
                    # the lowest ray here, less what its penumbra reaches down
                    above = low + enters[k] * tangent - wide - growth * enters[k + 1] - np.float32(SURELY_M)
                    if above > max(tops[r, (c + first) // LANES], tops[r, (c + end - 1) // LANES]):
                        if above > top:
                            break
                        k += 1
                        continue
                    going = _meet(
                        s, flat, flat_x, flat_y, np.uint64(r * cols + c), np.uint64(first), np.uint64(end), k,
                        np.float32(-aside[k]), np.float32(-down[k]), enters[k], enters[k + 1], dx, dy, tangent, growth,
                        top,
                    )  # fmt: skip
                    k += 1
                for j in range(count):
                    visibility[row, col + j] = max(s[np.int64(_BEST) + j], np.float32(0.0))
                    width[row, col + j] = s[np.int64(_WIDE) + j]
                    where = int(s[np.int64(_WHERE) + j])
                    caster[row, col + j] = -1 if where < 0 else (row + down[where]) * cols + col + j + aside[where]


__all__ = ["LANES", "limited_slopes", "shadow_march"]

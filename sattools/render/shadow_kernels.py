"""Compiled CPU kernels of the sun's cast shadows.

All arrays are float32 and contiguous. Positions are in cells of the height grid (column = east, row = south), heights
in metres.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from sattools.compiled import FASTMATH

# narrowest ramp of a shadow on a slope that the sun grazes, of the ray's rise over a cell
LEAST_RAMP = 0.05
ROUNDING = 1e-5  # of a share of light


@njit(fastmath=FASTMATH, inline="always")
def _limited(before, here, after):
    """Slope of a cell from its neighbours: the flatter of both, 0 where they disagree (minmod), so that a slope stays
    one and a wall stays a step between level cells."""
    back, ahead = here - before, after - here
    if back * ahead <= 0:
        return np.float32(0.0)
    return back if abs(back) < abs(ahead) else ahead


@njit(parallel=True, cache=True, nogil=True)
def limited_slopes(height, slope_x, slope_y):
    """Rise of every cell's plate per cell along columns and rows [m], filled in; 0 across the map's edge."""
    rows, cols = height.shape
    for row in prange(rows):
        for col in range(cols):
            h = height[row, col]
            across = 0 < col < cols - 1
            slope_x[row, col] = _limited(height[row, col - 1], h, height[row, col + 1]) if across else 0.0
            along = 0 < row < rows - 1
            slope_y[row, col] = _limited(height[row - 1, col], h, height[row + 1, col]) if along else 0.0


@njit(parallel=True, fastmath=FASTMATH, cache=True, nogil=True)
def shadow_march(height, slope_x, slope_y, direction, tangent, growth, top, visibility, caster, width, chunks):
    """Sun visibility of every cell, and which cell casts the shadow.

    The cells are plates with the slopes of `limited_slopes` and steps between them; the ray from a cell's middle is
    compared with every plate where it enters and where it leaves it.

    direction: (columns, rows) per cell length towards the sun, unit length; tangent: rise per cell length [m]; growth
    [m per cell]: of half the width of the penumbra with distance; top: nothing is higher [m].
    visibility [H, W] in [0, 1]; caster [H, W]: flat index of the deciding cell, -1 where nothing is near the sun ray;
    width [H, W]: half the width of the ramp there [m].
    """
    rows, cols = height.shape
    half, never = np.float32(0.5), np.float32(1e30)
    dx, dy = direction[0], direction[1]
    step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    delta_c = np.float32(1.0) / abs(dx) if abs(dx) > np.float32(1e-6) else never
    delta_r = np.float32(1.0) / abs(dy) if abs(dy) > np.float32(1e-6) else never
    for chunk in prange(chunks):
        for row in range(chunk, rows, chunks):
            for col in range(cols):
                base = height[row, col]
                # the ray's rise over the cell's own plate, from its middle to its end: below that, a part is lit
                own = half * (tangent - slope_x[row, col] * dx - slope_y[row, col] * dy)
                best, where, wide = np.float32(1.0), -1, own
                if own <= 0:
                    best = np.float32(0.0)  # turned away from the sun
                own = max(own, np.float32(LEAST_RAMP) * tangent)
                c, r = col, row
                next_c, next_r = half * delta_c, half * delta_r
                while best > 0:
                    t = min(next_c, next_r)
                    if next_c < next_r:
                        next_c += delta_c
                        c += step_c
                    else:
                        next_r += delta_r
                        r += step_r
                    ramp = own + growth * (t - half)
                    if c < 0 or r < 0 or c >= cols or r >= rows or base + t * tangent > top + ramp:
                        break
                    for end in range(2):
                        if end == 1:
                            t = min(next_c, next_r)
                            ramp = own + growth * (t - half)
                        over = base + t * tangent - height[r, c]
                        over -= slope_x[r, c] * (np.float32(col - c) + dx * t)
                        over -= slope_y[r, c] * (np.float32(row - r) + dy * t)
                        lit = half + over / (np.float32(2.0) * ramp)
                        if lit < best - np.float32(ROUNDING):
                            best, where, wide = lit, r * cols + c, ramp
                visibility[row, col] = max(best, np.float32(0.0))
                caster[row, col] = where
                width[row, col] = wide


__all__ = ["limited_slopes", "shadow_march"]

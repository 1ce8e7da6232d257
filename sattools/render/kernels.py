"""Compiled CPU kernels of the surface renderer (see `sattools.render.reference` for the readable twin).

All arrays are float32 and contiguous. Positions are in cells of the height grid (column = east, row = south), heights
in metres.
Rays of one view are parallel: the ray of output cell (row, col) passes `(col + offset[0] + slope[0] * (z - z_ref),
row + offset[1] +
slope[1] * (z - z_ref))` at height z.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from sattools.compiled import FASTMATH

# beyond this many softness lengths the logistic density is below 1e-3 of its maximum
EMPTY = 6.0
MIN_TRANSMITTANCE = 1e-3
# radius in cells of the `ceiling` maps that let rays skip empty air without jumping over a wall
REACH = 4
# narrowest ramp of a shadow on a slope that the sun grazes, of the ray's rise over a cell
LEAST_RAMP = 0.05
ROUNDING = 1e-5  # of a share of light
# alpha and its derivative as tables over u = (surface - z) / softness: one linear read instead of two exponentials
TABLE_PER_UNIT = 64
TABLE_END = 14.0


def tables(softness: float, step: float) -> np.ndarray:
    """``[n, 2]`` float32: alpha(u) and d(sigma * step)/d(surface) for u from -EMPTY to TABLE_END."""
    u = -EMPTY + np.arange(int((EMPTY + TABLE_END) * TABLE_PER_UNIT) + 2) / TABLE_PER_UNIT
    share = 1 / (1 + np.exp(-u))
    alpha = -np.expm1(-share * step / softness)
    return np.stack([alpha, share * (1 - share) * step / softness**2], axis=1).astype(np.float32)


@njit(fastmath=FASTMATH, inline="always")
def _corner(px, py, width, height):
    """Cell index and weights of a bilinear read, clamped to the edge."""
    px = min(max(px, np.float32(0.0)), np.float32(width - 1))
    py = min(max(py, np.float32(0.0)), np.float32(height - 1))
    ix = min(int(px), width - 2)
    iy = min(int(py), height - 2)
    return ix, iy, px - np.float32(ix), py - np.float32(iy)


@njit(fastmath=FASTMATH, inline="always")
def _entry(u):
    """Index and fraction of a table read at u >= -EMPTY."""
    position = (min(u, np.float32(TABLE_END)) + np.float32(EMPTY)) * np.float32(TABLE_PER_UNIT)
    k = int(position)
    return k, position - np.float32(k)


@njit(parallel=True, fastmath=FASTMATH, cache=True, nogil=True)
def march(
    height,
    ceiling,
    colour,
    offset,
    slope,
    z_ref,
    z_top,
    z_bottom,
    softness,
    step,
    table,
    mask,
    chunks,
    rgb,
    depth,
    opacity,
):
    """Composite every ray of a view; returns the number of field samples that were evaluated.

    height [H, W], ceiling [H, W] (highest surface within REACH cells), colour [H, W, C], mask [H, W] (0 = skip);
    outputs rgb [H, W, C], depth [H, W] (sum of weight * z), opacity [H, W].
    """
    rows, cols = height.shape
    bands = colour.shape[2]
    counts = np.zeros(chunks, np.int64)
    inverse = np.float32(1.0) / softness
    one = np.float32(1.0)
    above = np.float32(EMPTY) * softness
    # the ceiling holds for REACH cells around, of which one belongs to the bilinear read
    sideways = max(abs(slope[0]), abs(slope[1]))
    largest = np.float32(REACH - 1) / max(sideways, np.float32(1e-3))
    for chunk in prange(chunks):
        count = 0
        for row in range(chunk, rows, chunks):
            for col in range(cols):
                for c in range(bands):
                    rgb[row, col, c] = 0.0
                depth[row, col] = 0.0
                opacity[row, col] = 0.0
                if mask[row, col] == 0:
                    continue
                x0 = np.float32(col) + offset[0]
                y0 = np.float32(row) + offset[1]
                z = z_top
                transmittance = one
                depth_sum = np.float32(0.0)
                while z > z_bottom and transmittance > np.float32(MIN_TRANSMITTANCE):
                    dz = z - z_ref
                    ix, iy, fx, fy = _corner(x0 + slope[0] * dz, y0 + slope[1] * dz, cols, rows)
                    free = z - above - ceiling[iy, ix]
                    if free > 0:
                        z -= step * max(one, np.float32(math.floor(min(free, largest) / step)))
                        continue
                    count += 1
                    upper = height[iy, ix] * (one - fx) + height[iy, ix + 1] * fx
                    lower = height[iy + 1, ix] * (one - fx) + height[iy + 1, ix + 1] * fx
                    surface = upper * (one - fy) + lower * fy
                    u = (surface - z) * inverse
                    if u < np.float32(-EMPTY):
                        z -= step
                        continue
                    k, f = _entry(u)
                    alpha = table[k, 0] + f * (table[k + 1, 0] - table[k, 0])
                    weight = transmittance * alpha
                    w00 = weight * (one - fx) * (one - fy)
                    w01 = weight * fx * (one - fy)
                    w10 = weight * (one - fx) * fy
                    w11 = weight * fx * fy
                    for c in range(bands):
                        rgb[row, col, c] += (
                            w00 * colour[iy, ix, c]
                            + w01 * colour[iy, ix + 1, c]
                            + w10 * colour[iy + 1, ix, c]
                            + w11 * colour[iy + 1, ix + 1, c]
                        )
                    depth_sum += weight * z
                    transmittance -= weight
                    z -= step
                depth[row, col] = depth_sum
                opacity[row, col] = one - transmittance
        counts[chunk] = count
    return counts.sum()


@njit(parallel=True, fastmath=FASTMATH, cache=True, nogil=True)
def march_backward(
    height, ceiling, colour, offset, slope, z_ref, z_top, z_bottom, softness, step, table, mask, chunks,
    rgb, depth, opacity, grad_rgb, grad_depth, grad_opacity, height_buffers, colour_buffers,
):  # fmt: skip
    """Gradients of `march` with respect to height and colour, into one buffer per chunk ([chunks, H, W], [chunks, H,
    W, C]).

    With v_k = grad . (c_k, z_k, 1): dL/d(sigma_k step) = T_{k+1} v_k - sum over later samples of w_m v_m; the later
    samples are
    the whole sum, known from the forward pass, minus those passed so far.
    """
    rows, cols = height.shape
    bands = colour.shape[2]
    inverse = np.float32(1.0) / softness
    above = np.float32(EMPTY) * softness
    sideways = max(abs(slope[0]), abs(slope[1]))
    largest = np.float32(REACH - 1) / max(sideways, np.float32(1e-3))
    one = np.float32(1.0)
    for chunk in prange(chunks):
        grad_h = height_buffers[chunk]
        grad_c = colour_buffers[chunk]
        for row in range(chunk, rows, chunks):
            for col in range(cols):
                if mask[row, col] == 0:
                    continue
                total = grad_depth[row, col] * depth[row, col] + grad_opacity[row, col] * opacity[row, col]
                size = abs(grad_depth[row, col]) + abs(grad_opacity[row, col])
                for c in range(bands):
                    total += grad_rgb[row, col, c] * rgb[row, col, c]
                    size += abs(grad_rgb[row, col, c])
                if size == 0.0:
                    continue
                x0 = np.float32(col) + offset[0]
                y0 = np.float32(row) + offset[1]
                z = z_top
                transmittance = one
                passed = np.float32(0.0)
                while z > z_bottom and transmittance > np.float32(MIN_TRANSMITTANCE):
                    dz = z - z_ref
                    ix, iy, fx, fy = _corner(x0 + slope[0] * dz, y0 + slope[1] * dz, cols, rows)
                    free = z - above - ceiling[iy, ix]
                    if free > 0:
                        z -= step * max(one, np.float32(math.floor(min(free, largest) / step)))
                        continue
                    upper = height[iy, ix] * (one - fx) + height[iy, ix + 1] * fx
                    lower = height[iy + 1, ix] * (one - fx) + height[iy + 1, ix + 1] * fx
                    surface = upper * (one - fy) + lower * fy
                    u = (surface - z) * inverse
                    if u < np.float32(-EMPTY):
                        z -= step
                        continue
                    k, f = _entry(u)
                    alpha = table[k, 0] + f * (table[k + 1, 0] - table[k, 0])
                    weight = transmittance * alpha
                    b00 = (one - fx) * (one - fy)
                    b01 = fx * (one - fy)
                    b10 = (one - fx) * fy
                    b11 = fx * fy
                    value = grad_depth[row, col] * z + grad_opacity[row, col]
                    for c in range(bands):
                        g = grad_rgb[row, col, c]
                        value += g * (
                            b00 * colour[iy, ix, c]
                            + b01 * colour[iy, ix + 1, c]
                            + b10 * colour[iy + 1, ix, c]
                            + b11 * colour[iy + 1, ix + 1, c]
                        )
                        gw = g * weight
                        grad_c[iy, ix, c] += gw * b00
                        grad_c[iy, ix + 1, c] += gw * b01
                        grad_c[iy + 1, ix, c] += gw * b10
                        grad_c[iy + 1, ix + 1, c] += gw * b11
                    passed += weight * value
                    transmittance -= weight
                    slope_sigma = table[k, 1] + f * (table[k + 1, 1] - table[k, 1])
                    g = (transmittance * value - (total - passed)) * slope_sigma
                    grad_h[iy, ix] += g * b00
                    grad_h[iy, ix + 1] += g * b01
                    grad_h[iy + 1, ix] += g * b10
                    grad_h[iy + 1, ix + 1] += g * b11
                    z -= step


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


__all__ = ["limited_slopes", "march", "march_backward", "shadow_march"]

"""Compiled CPU kernels of the surface renderer (see `sattools.render.reference` for the readable twin).

Positions are in cells of the height grid (column = east, row = south), heights in metres. Rays of one view are
parallel: the ray of output cell (row, col) passes `(col + offset_x + slope_x * (z - z_ref), row + offset_y + slope_y *
(z - z_ref))` at height z. All samples lie on common height planes, so that on one plane neighbouring rays read
neighbouring cells with the same bilinear weights. The kernels therefore march packets of `LANES` neighbouring rays of a
row in lockstep, plane by plane: every loop over lanes reads and writes contiguous numbers without a branch, and the
compiler turns it into vector instructions. `sattools.render.blocks` lays out the maps for that.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sattools.compiled import FASTMATH, njit, spread
from sattools.render.blocks import CEILING, COLOUR, DEEP, EMPTY, LANES, PAD, REACH, coefficients

MIN_TRANSMITTANCE = 1e-3
U1 = np.uint64(1)
LINE = 16  # float32 in a cache line
# the 32nd root of exp(-u)
_ROOT = coefficients(lambda u: np.exp(-u / 32), 5, (-EMPTY, DEEP))
# places of a block's numbers in its workspace: transmittance, plane of the next look, 1 = close to the surface,
# weight, and what else a ray sums up
_T, _NEXT, _NEAR, _W, _DEPTH, _RGB = (np.uint64(k * LANES) for k in range(6))
# the same for the gradients; there is a 0 before the weights and before the rises (of sigma * step with the height)
_VALUE, _LEFT, _BEHIND, _GRAD_DEPTH, _GRAD_OPACITY = (np.uint64(k * LANES) for k in range(1, 6))
_WEIGHT, _RISE, _GRAD_RGB = (np.uint64(k * LANES) for k in (7, 9, 10))


@njit
def _workspace(places):
    """Room for so many numbers of every ray of a block, at the beginning of a cache line (a few percent faster)."""
    room = np.empty(places * LANES + LINE, np.float32)
    begin = (-(room.ctypes.data // 4)) % LINE
    return room[begin : begin + places * LANES]


@njit(fastmath=FASTMATH, inline="always")
def _plane(v, k, row, rows, col, cols):
    """Height of plane k, and where the block that begins at (row, col) reads it.

    That is both rows, first packed column, and the fractions of the bilinear read; clamped to the edge.
    """
    z = v.z_top - np.float32(k) * v.step
    x = v.offset_x + v.slope_x * (z - v.z_ref)
    y = np.float32(row) + (v.offset_y + v.slope_y * (z - v.z_ref))
    y = min(max(y, np.float32(0.0)), np.float32(rows - 1))
    upper = max(0, min(int(y), rows - 2))
    whole = math.floor(x)
    first = PAD + min(max(col + int(whole), -PAD), cols)
    return z, upper, min(upper + 1, rows - 1), first, x - np.float32(whole), y - np.float32(upper)


@njit(fastmath=FASTMATH, inline="always")
def _density(u):
    """Logistic function of u = (surface - z) / softness >= -EMPTY, to a relative 5e-6."""
    u = min(max(u, np.float32(-EMPTY)), np.float32(DEEP))
    e = _ROOT[5] * u + _ROOT[4]
    e = e * u + _ROOT[3]
    e = e * u + _ROOT[2]
    e = e * u + _ROOT[1]
    e = e * u + _ROOT[0]
    e *= e
    e *= e
    e *= e
    e *= e
    return np.float32(1.0) / (np.float32(1.0) + e * e)


@njit(fastmath=FASTMATH, inline="always")
def _alpha(p, a):
    """Share of the light that a sample of density p keeps; a: of `absorption`."""
    q = p + p - np.float32(1.0)
    x = a[6] * q + a[5]
    x = x * q + a[4]
    x = x * q + a[3]
    x = x * q + a[2]
    x = x * q + a[1]
    x = x * q + a[0]
    return p * x


@njit(fastmath=FASTMATH)
def _skip_empty_space(s, maps, at, k, z, v, largest):
    """Mark the rays that are close to the surface on plane k; returns their number.

    The others are sent to where they must look again.
    """
    limit = z - np.float32(EMPTY) * v.softness
    here, one, zero = np.float32(k), np.float32(1.0), np.float32(0.0)
    close = np.int32(0)
    for j in range(np.uint64(LANES)):
        looks = (s[_T + j] > np.float32(MIN_TRANSMITTANCE)) & (s[_NEXT + j] <= here)
        free = limit - maps[at + j]
        ahead = max(one, np.float32(np.int32(min(free, largest) / v.step)))
        s[_NEXT + j] = here + ahead if looks & (free > zero) else s[_NEXT + j]
        near = looks & (free <= zero)
        s[_NEAR + j] = one if near else zero
        close = np.int32(close + np.int32(near))
    return close


@njit(fastmath=FASTMATH)
def _next(s, planes):
    """The plane on which the first ray must look again; `planes` where no light is left."""
    plane = np.float32(planes)
    for j in range(np.uint64(LANES)):
        mine = s[_NEXT + j] if s[_T + j] > np.float32(MIN_TRANSMITTANCE) else np.float32(planes)
        plane = mine if mine < plane else plane
    return int(plane)


@njit(fastmath=FASTMATH)
def _weigh(s, maps, upper, lower, z, fx, fy, softness, absorb):
    """Weights of the samples of one plane; returns how many are not 0."""
    one, zero = np.float32(1.0), np.float32(0.0)
    inverse = one / softness
    hits = np.int32(0)
    for j in range(np.uint64(LANES)):
        a = maps[upper + j] * (one - fx) + maps[upper + j + U1] * fx
        b = maps[lower + j] * (one - fx) + maps[lower + j + U1] * fx
        u = (a * (one - fy) + b * fy - z) * inverse
        weight = s[_T + j] * _alpha(_density(u), absorb)
        weight = weight if (s[_NEAR + j] > zero) & (u >= np.float32(-EMPTY)) else zero
        s[_W + j] = weight
        s[_T + j] -= weight
        s[_DEPTH + j] += weight * z
        hits = np.int32(hits + np.int32(weight > zero))
    return hits


@njit(fastmath=FASTMATH)
def _accumulate_colour(s, maps, upper, lower, fx, fy, weight, to):
    """Add one colour of the samples of a plane, times what is at `weight`, to what is at `to`."""
    one = np.float32(1.0)
    w00, w01, w10, w11 = (one - fx) * (one - fy), fx * (one - fy), (one - fx) * fy, fx * fy
    for j in range(np.uint64(LANES)):
        colour = maps[upper + j] * w00 + maps[upper + j + U1] * w01 + maps[lower + j] * w10 + maps[lower + j + U1] * w11
        s[to + j] += s[weight + j] * colour


@spread(lambda *arguments: arguments[-1])
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def _march(maps, v, absorb, mask, rgb, depth, opacity, spans, counts, chunks, from_chunk, to_chunk):
    """Composite every ray of a view; counts [chunks] are the numbers of field samples that were evaluated.

    maps: of `pack`; v, absorb: `Sampling`, `absorption`; mask [H, W] (0 = skip); chunks: pieces of work, each of
    consecutive rows; outputs rgb [H, W, C], depth [H, W] (sum of weight * z), opacity [H, W], spans [H, blocks, 2]
    int32: first plane on which a ray of the block meets the surface, and the one after the last.
    """
    rows, cols, bands = rgb.shape
    width = maps.shape[2]
    flat = maps.reshape(-1)
    one = np.float32(1.0)
    # the ceiling holds for REACH cells around, of which one belongs to the bilinear read
    largest = np.float32(REACH - 1) / max(abs(v.slope_x), abs(v.slope_y), np.float32(1e-3))
    for chunk in range(from_chunk, to_chunk):
        count = 0
        s = _workspace(5 + bands)
        for row in range(rows * chunk // chunks, rows * (chunk + 1) // chunks):
            for block in range(spans.shape[1]):
                col = block * LANES
                inside = min(LANES, cols - col)
                s[:] = 0.0
                for j in range(inside):
                    s[j] = one if mask[row, col + j] else np.float32(0.0)
                first, last = v.planes, 0
                k: Any = np.int64(0)  # a plain 0 is a type of its own: everything would be compiled twice
                while k < v.planes:
                    z, r0, r1, x, fx, fy = _plane(v, k, row, rows, col, cols)
                    upper = np.uint64(r0 * maps.shape[1] * width + x)
                    lower = np.uint64(r1 * maps.shape[1] * width + x)
                    close = _skip_empty_space(s, flat, upper + np.uint64(CEILING * width), k, z, v, largest)
                    count += close
                    if close == 0:
                        k = _next(s, v.planes)
                        continue
                    if _weigh(s, flat, upper, lower, z, fx, fy, v.softness, absorb) > 0:
                        first, last = min(first, k), k + 1
                        for c in range(bands):
                            channel = np.uint64((COLOUR + c) * width)
                            _accumulate_colour(
                                s, flat, upper + channel, lower + channel, fx, fy, _W, _RGB + np.uint64(c * LANES)
                            )
                    k += 1
                spans[row, block, 0], spans[row, block, 1] = first, last
                for j in range(inside):
                    opacity[row, col + j] = one - s[j] if mask[row, col + j] else np.float32(0.0)
                    depth[row, col + j] = s[4 * LANES + j]
                    for c in range(bands):
                        rgb[row, col + j, c] = s[(5 + c) * LANES + j]
        counts[chunk] = count


def march(maps, v, absorb, mask, chunks, rgb, depth, opacity, spans):
    """Composite every ray of a view (see `_march`); returns the number of field samples that were evaluated."""
    counts = np.zeros(chunks, np.int64)
    _march(maps, v, absorb, mask, rgb, depth, opacity, spans, counts, chunks)
    return int(counts.sum())


@njit(fastmath=FASTMATH)
def _weigh_back(s, maps, upper, lower, z, fx, fy, softness, thickness, absorb):
    """Weights of the samples of one plane, for the gradient; returns how many are not 0.

    Their v so far, and the change of sigma * step with the height, are left as well.
    """
    one, zero = np.float32(1.0), np.float32(0.0)
    inverse = one / softness
    steepness = thickness * inverse
    hits = np.int32(0)
    for j in range(np.uint64(LANES)):
        a = maps[upper + j] * (one - fx) + maps[upper + j + U1] * fx
        b = maps[lower + j] * (one - fx) + maps[lower + j + U1] * fx
        u = (a * (one - fy) + b * fy - z) * inverse
        p = _density(u)
        meets = (s[_T + j] > np.float32(MIN_TRANSMITTANCE)) & (u >= np.float32(-EMPTY))
        s[_WEIGHT + j] = s[_T + j] * _alpha(p, absorb) if meets else zero
        s[_RISE + j] = p * (one - p) * steepness if meets else zero
        s[_VALUE + j] = s[_GRAD_DEPTH + j] * z + s[_GRAD_OPACITY + j]
        hits = np.int32(hits + np.int32(meets))
    return hits


@njit(fastmath=FASTMATH)
def _transmit(s):
    """Lead the rays through a plane; leaves what a sample changes behind it, per sigma * step, at _BEHIND."""
    for j in range(np.uint64(LANES)):
        left = s[_LEFT + j] - s[_WEIGHT + j] * s[_VALUE + j]
        transmittance = s[_T + j] - s[_WEIGHT + j]
        s[_BEHIND + j] = transmittance * s[_VALUE + j] - left
        s[_LEFT + j] = left
        s[_T + j] = transmittance


@njit(fastmath=FASTMATH)
def _scatter(s, grads, to, fx, share, a, b):
    """Hand a share of the product of what is at a and b to the cells of one row that every sample was read from.

    There is a 0 before a. Both rows in one loop would take twice as long: the compiler cannot know that they differ.
    """
    one = np.float32(1.0)
    for j in range(np.uint64(LANES)):
        grads[to + j] += (s[a + j] * s[b + j] * (one - fx) + s[a - U1 + j] * s[b - U1 + j] * fx) * share
    end = np.uint64(LANES)
    grads[to + end] += s[a + end - U1] * s[b + end - U1] * fx * share


@njit(fastmath=FASTMATH)
def _reach(v, spans, first, end, rows):
    """The rows of the map, from and to, that the rays of a chunk's rows read."""
    low, high = rows, 0
    for row in range(first, end):
        start, stop = v.planes, 0
        for block in range(spans.shape[1]):
            start, stop = min(start, spans[row, block, 0]), max(stop, spans[row, block, 1])
        if start < stop:
            for k in (start, stop - 1):
                _, upper, lower, _, _, _ = _plane(v, k, row, rows, 0, 1)
                low, high = min(low, upper), max(high, lower + 1)
    return min(low, high), high


@njit(fastmath=FASTMATH, cache=True, nogil=True)
def _places(v, chunks, rows, spans, own):
    """Which rows of the map the rays of each chunk read, from and to, and where its gradients begin: ``[chunks, 3]``.

    In the row after the last, all of their number.
    """
    reach = np.zeros((chunks + 1, 3), np.int64)
    for chunk in range(chunks):
        low, high = _reach(v, spans, rows * chunk // chunks, rows * (chunk + 1) // chunks, rows)
        reach[chunk, 0], reach[chunk, 1] = low, high
        reach[chunk + 1, 2] = reach[chunk, 2] + (high - low) * own
    return reach


@spread(lambda *arguments: arguments[-1])
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def _march_back(
    maps, v, absorb, mask, rgb, depth, opacity, spans, grad_rgb, grad_depth, grad_opacity, reach, grads, chunks,
    from_chunk, to_chunk,
):  # fmt: skip
    """Gradients of `march`, summed up by every chunk for itself.

    With v_k = grad . (c_k, z_k, 1): dL/d(sigma_k step) = T_{k+1} v_k - sum over later samples of w_m v_m; the later
    samples are the whole sum, known from the forward pass, minus those passed so far. The gradients of a chunk are
    those of the rows that its rays read.
    """
    rows, cols, bands = rgb.shape
    width = maps.shape[2]
    flat = maps.reshape(-1)
    line, own = maps.shape[1] * width, (1 + bands) * width  # numbers per row of the maps and of the gradients
    one, thickness = np.float32(1.0), v.step / v.softness
    for chunk in range(from_chunk, to_chunk):
        begin = reach[chunk, 2] - reach[chunk, 0] * own
        grads[reach[chunk, 2] : reach[chunk, 2] + (reach[chunk, 1] - reach[chunk, 0]) * own] = 0.0
        s = _workspace(10 + bands)
        for row in range(rows * chunk // chunks, rows * (chunk + 1) // chunks):
            for block in range(spans.shape[1]):
                if spans[row, block, 0] >= spans[row, block, 1]:
                    continue
                col = block * LANES
                s[:] = 0.0
                size = np.float32(0.0)
                for j in range(min(LANES, cols - col)):
                    c = col + j
                    if mask[row, c] == 0:
                        continue
                    s[np.int64(_T) + j] = 1.0
                    s[np.int64(_GRAD_DEPTH) + j] = grad_depth[row, c]
                    s[np.int64(_GRAD_OPACITY) + j] = grad_opacity[row, c]
                    left = grad_depth[row, c] * depth[row, c] + grad_opacity[row, c] * opacity[row, c]
                    size += abs(grad_depth[row, c]) + abs(grad_opacity[row, c])
                    for b in range(bands):
                        s[np.int64(_GRAD_RGB) + b * LANES + j] = grad_rgb[row, c, b]
                        left += grad_rgb[row, c, b] * rgb[row, c, b]
                        size += abs(grad_rgb[row, c, b])
                    s[np.int64(_LEFT) + j] = left
                if size == 0.0:
                    continue
                for k in range(spans[row, block, 0], spans[row, block, 1]):
                    z, r0, r1, x, fx, fy = _plane(v, k, row, rows, col, cols)
                    upper, lower = np.uint64(r0 * line + x), np.uint64(r1 * line + x)
                    if _weigh_back(s, flat, upper, lower, z, fx, fy, v.softness, thickness, absorb) == 0:
                        continue
                    to_upper, to_lower = np.uint64(begin + r0 * own + x), np.uint64(begin + r1 * own + x)
                    for b in range(bands):
                        channel, grad = np.uint64((COLOUR + b) * width), _GRAD_RGB + np.uint64(b * LANES)
                        _accumulate_colour(s, flat, upper + channel, lower + channel, fx, fy, grad, _VALUE)
                    _transmit(s)
                    for b in range(bands):
                        to, grad = np.uint64((1 + b) * width), _GRAD_RGB + np.uint64(b * LANES)
                        _scatter(s, grads, to_upper + to, fx, one - fy, _WEIGHT, grad)
                        _scatter(s, grads, to_lower + to, fx, fy, _WEIGHT, grad)
                    _scatter(s, grads, to_upper, fx, one - fy, _RISE, _BEHIND)
                    _scatter(s, grads, to_lower, fx, fy, _RISE, _BEHIND)


@spread(lambda reach, grads, width, grad_height, grad_colour: len(grad_height))
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def _add_up(reach, grads, width, grad_height, grad_colour, first, end):
    """Add the gradients of all chunks, in their order, for some rows of the map."""
    cols, bands = grad_colour.shape[1:]
    chunks, own = len(reach) - 1, (1 + bands) * width
    for row in range(first, end):
        sums = np.zeros((1 + bands, width), np.float32)
        for chunk in range(chunks):
            if reach[chunk, 0] <= row < reach[chunk, 1]:
                at = reach[chunk, 2] + (row - reach[chunk, 0]) * own
                sums += grads[at : at + own].reshape(1 + bands, width)
        for b in range(1 + bands):
            # what was read beyond the edge is the edge
            for x in range(PAD):
                sums[b, PAD] += sums[b, x]
            for x in range(PAD + cols, width):
                sums[b, PAD + cols - 1] += sums[b, x]
        for col in range(cols):
            grad_height[row, col] = sums[0, PAD + col]
            for b in range(bands):
                grad_colour[row, col, b] = sums[1 + b, PAD + col]


def march_backward(
    maps, v, absorb, mask, chunks, rgb, depth, opacity, spans, grad_rgb, grad_depth, grad_opacity, grad_height,
    grad_colour,
):  # fmt: skip
    """Gradients of `march` with respect to height and colour, filled in."""
    width = maps.shape[2]
    reach = _places(v, chunks, len(rgb), spans, (1 + rgb.shape[2]) * width)
    grads = np.empty(reach[-1, 2], np.float32)
    _march_back(
        maps, v, absorb, mask, rgb, depth, opacity, spans, grad_rgb, grad_depth, grad_opacity, reach, grads, chunks
    )
    _add_up(reach, grads, width, grad_height, grad_colour)


__all__ = ["march", "march_backward"]

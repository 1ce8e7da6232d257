"""Compiled kernels of the multi-view matching: plane-sweep correlation and semi-global aggregation."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange


@njit(cache=True, fastmath=True)
def _shift(image, dx, dy, out):
    """out(row, col) = image(row + dy, col + dx), bilinear; outside is clamped."""
    rows, cols = image.shape
    ix, iy = int(math.floor(dx)), int(math.floor(dy))
    fx, fy = np.float32(dx - ix), np.float32(dy - iy)
    gx, gy = np.float32(1) - fx, np.float32(1) - fy
    for row in range(rows):
        r0 = min(max(row + iy, 0), rows - 1)
        r1 = min(max(row + iy + 1, 0), rows - 1)
        for col in range(cols):
            c0 = min(max(col + ix, 0), cols - 1)
            c1 = min(max(col + ix + 1, 0), cols - 1)
            out[row, col] = gy * (gx * image[r0, c0] + fx * image[r0, c1]) + fy * (
                gx * image[r1, c0] + fx * image[r1, c1]
            )


@njit(cache=True, fastmath=True)
def _box(image, radius, scratch, out):
    """Mean over (2 radius + 1)^2 cells, edges clamped."""
    rows, cols = image.shape
    norm = np.float32(1.0 / (2 * radius + 1))
    for row in range(rows):
        total = np.float32(0)
        for k in range(-radius, radius + 1):
            total += image[row, min(max(k, 0), cols - 1)]
        scratch[row, 0] = total * norm
        for col in range(1, cols):
            total += image[row, min(col + radius, cols - 1)] - image[row, max(col - radius - 1, 0)]
            scratch[row, col] = total * norm
    for col in range(cols):
        total = np.float32(0)
        for k in range(-radius, radius + 1):
            total += scratch[min(max(k, 0), rows - 1), col]
        out[0, col] = total
    for row in range(1, rows):
        enter, leave = min(row + radius, rows - 1), max(row - radius - 1, 0)
        for col in range(cols):
            out[row, col] = out[row - 1, col] + scratch[enter, col] - scratch[leave, col]
    for row in range(rows):
        for col in range(cols):
            out[row, col] *= norm


@njit(parallel=True, cache=True, fastmath=True)
def first_hits(height, slopes, z_ref, z_top, z_bottom, step, hits):
    """Height at which every ray of every view first meets the surface; hits [V, H, W] on the reference plane."""
    views = slopes.shape[0]
    rows, cols = height.shape
    for v in range(views):
        for row in prange(rows):
            for col in range(cols):
                z = z_top
                while z > z_bottom:
                    dz = z - z_ref
                    x = int(round(col + slopes[v, 0] * dz))
                    y = int(round(row + slopes[v, 1] * dz))
                    if 0 <= x < cols and 0 <= y < rows and height[y, x] >= z:
                        break
                    z -= step
                hits[v, row, col] = z


@njit(parallel=True, cache=True, fastmath=True)
def correlate(
    images,
    masks,
    slopes,
    heights,
    z_ref,
    hits,
    tolerance,
    pairs,
    weights,
    radius,
    noise,
    best,
    colours,
    scale,
    share,
    volume,
):
    """Robust multi-view correlation of every (cell, height).

    images [V, H, W] on the reference plane z_ref; masks [V, H, W] (1 = valid); slopes [V, 2] in cells (column, row) per metre;
    heights [D]; pairs [P, 2]; weights [P]; radius of the window in cells; noise: radiance below which contrast is not trusted;
    best: share of the valid pairs that count (the best ones: the others may be occluded). volume [D, H, W]: mean zero-mean normalised
    cross-correlation of the best pairs, in [-1, 1]; -1 where fewer than one pair sees the cell.
    """
    views, rows, cols = images.shape
    count = pairs.shape[0]
    for k in prange(heights.shape[0]):
        dz = heights[k] - z_ref
        moved = np.empty((views, rows, cols), np.float32)
        mean = np.empty((views, rows, cols), np.float32)
        inverse = np.empty((views, rows, cols), np.float32)
        valid = np.empty((views, rows, cols), np.float32)
        scratch = np.empty((rows, cols), np.float32)
        product = np.empty((rows, cols), np.float32)
        found = np.empty((rows, cols), np.float32)
        for v in range(views):
            dx, dy = -slopes[v, 0] * dz, -slopes[v, 1] * dz
            _shift(images[v], dx, dy, moved[v])
            _shift(masks[v], dx, dy, valid[v])
            _box(moved[v], radius, scratch, mean[v])
            for row in range(rows):
                for col in range(cols):
                    product[row, col] = moved[v, row, col] * moved[v, row, col]
                    # cells whose ray left the image
                    c, r = col + dx, row + dy
                    if c < 0 or r < 0 or c > cols - 1 or r > rows - 1:
                        valid[v, row, col] = 0.0
                    elif heights[k] < hits[v, int(round(r)), int(round(c))] - tolerance:
                        valid[v, row, col] = 0.0
            _box(product, radius, scratch, found)
            for row in range(rows):
                for col in range(cols):
                    variance = found[row, col] - mean[v, row, col] * mean[v, row, col]
                    inverse[v, row, col] = np.float32(1.0) / math.sqrt(max(variance, np.float32(0)) + noise * noise)
        scores = np.full((rows, cols, count), np.float32(-2))
        for p in range(count):
            a, b = pairs[p, 0], pairs[p, 1]
            for row in range(rows):
                for col in range(cols):
                    product[row, col] = moved[a, row, col] * moved[b, row, col]
            _box(product, radius, scratch, found)
            for row in range(rows):
                for col in range(cols):
                    if valid[a, row, col] > 0.99 and valid[b, row, col] > 0.99:
                        scores[row, col, p] = (
                            (found[row, col] - mean[a, row, col] * mean[b, row, col])
                            * inverse[a, row, col]
                            * inverse[b, row, col]
                        )
        for row in range(rows):
            for col in range(cols):
                volume[k, row, col] = _best_mean(scores[row, col], weights, best)
        if share > 0:
            for v in range(views):
                _shift(colours[v], -slopes[v, 0] * dz, -slopes[v, 1] * dz, moved[v])
            for row in range(rows):
                for col in range(cols):
                    n = np.float32(0)
                    m = np.float32(0)
                    for v in range(views):
                        if valid[v, row, col] > 0.99:
                            n += 1
                            m += moved[v, row, col]
                    if n >= 2:
                        m /= n
                        for _ in range(2):
                            sw = np.float32(1e-6)
                            sm = np.float32(0)
                            for v in range(views):
                                if valid[v, row, col] > 0.99:
                                    d = (moved[v, row, col] - m) / scale
                                    w = np.float32(1) / (1 + d * d)
                                    sw += w
                                    sm += w * moved[v, row, col]
                            m = sm / sw
                        volume[k, row, col] += share * (sw / n)


@njit(cache=True, fastmath=True)
def _best_mean(scores, weights, best):
    """Weighted mean of the best share of the valid scores (> -2)."""
    n = 0
    for p in range(scores.shape[0]):
        if scores[p] > np.float32(-1.5):
            n += 1
    if n == 0:
        return np.float32(-1)
    keep = max(1, int(math.ceil(best * n)))
    order = np.argsort(-scores)
    total = np.float32(0)
    weight = np.float32(0)
    for i in range(keep):
        p = order[i]
        total += weights[p] * scores[p]
        weight += weights[p]
    return total / weight


@njit(parallel=True, cache=True, fastmath=True)
def aggregate(cost, p1, p2, total):
    """Semi-global aggregation (Hirschmueller 2008) along eight paths; cost and total are [H, W, D], total is summed up."""
    rows, cols, depth = cost.shape
    total[:] = 0
    for direction in range(8):
        dr = (0, 0, 1, -1, 1, -1, 1, -1)[direction]
        dc = (1, -1, 0, 0, 1, -1, -1, 1)[direction]
        # every path starts on the edge where it enters; paths of one direction touch disjoint cells
        starts = np.empty((rows + cols, 2), np.int64)
        n = 0
        for row in range(rows):
            for col in range(cols):
                if (
                    (dr == 1 and row == 0)
                    or (dr == -1 and row == rows - 1)
                    or (dc == 1 and col == 0)
                    or (dc == -1 and col == cols - 1)
                ):
                    starts[n, 0] = row
                    starts[n, 1] = col
                    n += 1
        for s in prange(n):
            row, col = starts[s, 0], starts[s, 1]
            before = np.zeros(depth, np.float32)
            now = np.empty(depth, np.float32)
            least = np.float32(0)
            while row >= 0 and row < rows and col >= 0 and col < cols:
                smallest = np.float32(1e30)
                for k in range(depth):
                    value = before[k]
                    if k > 0:
                        value = min(value, before[k - 1] + p1)
                    if k + 1 < depth:
                        value = min(value, before[k + 1] + p1)
                    value = min(value, least + p2)
                    value = cost[row, col, k] + value - least
                    now[k] = value
                    total[row, col, k] += value
                    smallest = min(smallest, value)
                for k in range(depth):
                    before[k] = now[k]
                least = smallest
                row += dr
                col += dc


@njit(parallel=True, cache=True, fastmath=True)
def lowest(total, heights, height, index):
    """Height of least cost with a parabola through its neighbours; height [H, W], index [H, W]."""
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
                    z += step * np.float32(0.5) * (a - c) / bend
            height[row, col] = z


__all__ = ["aggregate", "correlate", "lowest"]

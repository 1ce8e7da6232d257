"""Compiled kernel of the multi-view matching: plane-sweep correlation.

All views lie on one frame: the ground grid plus a margin on every side, resampled at one reference height. A point of
cell (row, col) at height z is seen by view v at frame position (margin + row + slope_v * dz, margin + col + ...), dz =
z - z_ref, so warping a view to another height plane is a translation. The margin must exceed the largest translation
plus the window, which spares the inner loops every test of bounds.
"""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import FASTMATH, njit, spread

GUARD = np.float32(0.9)  # an unseen height counts at most this share of the best agreement seen in its cell
SIXTH = np.float32(1 / 6)
TILE, TILE_COLS = 24, 96  # cells


@njit(cache=True, fastmath=FASTMATH)
def _translate(image, row0, col0, row_shift, col_shift, out):
    """out(i, j) = image(row0 + i + row_shift, col0 + j + col_shift), bilinear."""
    rows, cols = out.shape
    iy, ix = math.floor(row_shift), math.floor(col_shift)
    fy, fx = np.float32(row_shift - iy), np.float32(col_shift - ix)
    gy, gx = np.float32(1) - fy, np.float32(1) - fx
    a, b, c, d = gy * gx, gy * fx, fy * gx, fy * fx
    for i in range(rows):
        upper = image[row0 + iy + i, col0 + ix : col0 + ix + cols + 1]
        lower = image[row0 + iy + i + 1, col0 + ix : col0 + ix + cols + 1]
        target = out[i]
        for j in range(cols):
            target[j] = a * upper[j] + b * upper[j + 1] + c * lower[j] + d * lower[j + 1]


@njit(cache=True, fastmath=FASTMATH)
def _follow(image, surface, row0, col0, parallax, dz, out):
    """out(i, j) = image(row0 + i + parallax[0] z, col0 + j + parallax[1] z), bilinear, at z = surface(i, j) + dz."""
    rows, cols = out.shape
    for i in range(rows):
        for j in range(cols):
            z = surface[i, j] + dz
            r, c = row0 + i + parallax[0] * z, col0 + j + parallax[1] * z
            iy, ix = math.floor(r), math.floor(c)
            fy, fx = np.float32(r - iy), np.float32(c - ix)
            upper = image[iy, ix] + fx * (image[iy, ix + 1] - image[iy, ix])
            lower = image[iy + 1, ix] + fx * (image[iy + 1, ix + 1] - image[iy + 1, ix])
            out[i, j] = upper + fy * (lower - upper)


@njit(cache=True, fastmath=FASTMATH)
def _window_sum(columns, radius, out):
    """out(j) = sum of columns(j .. j + 2 radius); the shorter array sets the length."""
    cols = out.shape[0]
    if radius == 1:  # the default, in one pass instead of three
        for j in range(cols):
            out[j] = columns[j] + columns[j + 1] + columns[j + 2]
        return
    for j in range(cols):
        out[j] = columns[j]
    for k in range(1, 2 * radius + 1):
        for j in range(cols):
            out[j] += columns[j + k]


@njit(cache=True, fastmath=FASTMATH)
def _moments(moved, radius, mean, variance, sums, squares, line):
    """Mean and variance of every window."""
    rows, cols = mean.shape
    norm = np.float32(1.0 / (2 * radius + 1) ** 2)
    sums[:] = 0
    squares[:] = 0
    for i in range(2 * radius):
        for j in range(sums.shape[0]):
            sums[j] += moved[i, j]
            squares[j] += moved[i, j] * moved[i, j]
    for i in range(rows):
        enter = moved[i + 2 * radius]
        for j in range(sums.shape[0]):
            sums[j] += enter[j]
            squares[j] += enter[j] * enter[j]
        _window_sum(sums, radius, mean[i])
        _window_sum(squares, radius, line)
        leave = moved[i]
        for j in range(cols):
            m = mean[i, j] * norm
            mean[i, j] = m
            variance[i, j] = max(line[j] * norm - m * m, np.float32(0))
        for j in range(sums.shape[0]):
            sums[j] -= leave[j]
            squares[j] -= leave[j] * leave[j]


@njit(cache=True, fastmath=FASTMATH)
def _take_row(a, b, radius, products, sums):
    """Take a row's products, summed over the windows' columns, into the sums over their rows, for those held so far."""
    for j in range(sums.shape[0]):
        sums[j] -= products[j]
        products[j] = a[j] * b[j]
    for k in range(1, 2 * radius + 1):
        for j in range(sums.shape[0]):
            products[j] += a[j + k] * b[j + k]
    for j in range(sums.shape[0]):
        sums[j] += products[j]


@njit(inline="always")
def _agreed(product, ma, mb, va, vb, dark, veil, lit_floor, dark_floor, steep, power):
    """A power of the agreement of two windows, from the mean of their product and their moments; see `correlate`."""
    # every constant in single precision: one in double makes the whole line double
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    floor = dark_floor if dark else lit_floor
    shared = max(two * (product - ma * mb) + floor, zero)
    apart = ma - mb - (veil if dark else zero)
    score = shared / ((va + vb + floor) * (one + apart * apart * steep))
    square = score * score
    return square if power == 1 else square * square * square


@njit(cache=True, fastmath=FASTMATH)
def _add_pair(
    a, b, mean_a, mean_b, variance_a, variance_b, seen_a, seen_b, dark_a, dark_b,
    radius, noise, shadow_noise, brightness, power, mixed, products, sums, total, weight,
):  # fmt: skip
    """Add a power of a pair's agreement to ``total`` and the pair's weight to ``weight``.

    seen_a, seen_b: weight of the view there, negative in shadow: 1 = seen, 0 = beyond the image. A pair has the product
    of its views' weights, times ``mixed`` where one shows the point in the sun and the other in shadow. ``power``: 1 =
    second, 3 = sixth. Where both are in shadow and as dark as
    shadows (dark_a, dark_b) are, brightness counts from there, and structure only above the noise of the dark.
    products: ``[2 radius + 1, columns]`` of the last rows, see `_take_row`; sums: over the windows.
    """
    rows, cols = total.shape
    size = 2 * radius + 1
    norm = np.float32(1.0 / size**2)
    lit_floor, dark_floor = np.float32(noise * noise), np.float32(shadow_noise * shadow_noise)
    darkest_a, darkest_b = dark_a + np.float32(brightness), dark_b + np.float32(brightness)
    veil = dark_a - dark_b
    steep = np.float32(1.0 / (brightness * brightness))
    sums[:] = 0
    products[:] = 0
    for i in range(size - 1):
        _take_row(a[i], b[i], radius, products[i], sums)
    for i in range(rows):
        xa, xb, oldest = a[i + size - 1], b[i + size - 1], products[(i + size - 1) % size]
        ma, mb, va, vb = mean_a[i], mean_b[i], variance_a[i], variance_b[i]
        sa, sb, ti, wi = seen_a[i], seen_b[i], total[i], weight[i]
        _take_row(xa, xb, radius, oldest, sums)
        for j in range(cols):
            both = sa[j] * sb[j]
            both = max(both, -mixed * both)
            dark = (sa[j] < 0) & (sb[j] < 0) & (ma[j] < darkest_a) & (mb[j] < darkest_b)
            ti[j] += both * _agreed(
                sums[j] * norm, ma[j], mb[j], va[j], vb[j], dark, veil, lit_floor, dark_floor, steep, power
            )  # fmt: skip
            wi[j] += both


@njit(cache=True, fastmath=FASTMATH)
def _add_pair_3x3(
    a, b, mean_a, mean_b, variance_a, variance_b, seen_a, seen_b, dark_a, dark_b,
    noise, shadow_noise, brightness, power, mixed, products, sums, total, weight,
):  # fmt: skip
    """The same as `_add_pair` for windows of 3 x 3, the default: in one loop it takes three quarters of the time."""
    rows, cols = total.shape
    norm = np.float32(1.0 / 9.0)
    lit_floor, dark_floor = np.float32(noise * noise), np.float32(shadow_noise * shadow_noise)
    darkest_a, darkest_b = dark_a + np.float32(brightness), dark_b + np.float32(brightness)
    veil = dark_a - dark_b
    steep = np.float32(1.0 / (brightness * brightness))
    sums[:] = 0
    products[:] = 0
    for i in range(2):
        _take_row(a[i], b[i], 1, products[i], sums)
    for i in range(rows):
        xa, xb, oldest = a[i + 2], b[i + 2], products[(i + 2) % 3]
        ma, mb, va, vb = mean_a[i], mean_b[i], variance_a[i], variance_b[i]
        sa, sb, ti, wi = seen_a[i], seen_b[i], total[i], weight[i]
        for j in range(cols):
            product = xa[j] * xb[j] + xa[j + 1] * xb[j + 1] + xa[j + 2] * xb[j + 2]
            inside = sums[j] + (product - oldest[j])
            sums[j] = inside
            oldest[j] = product
            both = sa[j] * sb[j]
            both = max(both, -mixed * both)
            dark = (sa[j] < 0) & (sb[j] < 0) & (ma[j] < darkest_a) & (mb[j] < darkest_b)
            ti[j] += both * _agreed(
                inside * norm, ma[j], mb[j], va[j], vb[j], dark, veil, lit_floor, dark_floor, steep, power
            )  # fmt: skip
            wi[j] += both


@njit(cache=True, fastmath=FASTMATH)
def _mean_over_pairs(total, weight, power, agreement):
    """Power mean of a row's pairs; -1 where no pair sees the place."""
    for j in range(agreement.shape[0]):
        mean = total[j] / weight[j] if weight[j] > 0 else np.float32(-1)
        if weight[j] > 0:
            mean = math.sqrt(mean) if power == 1 else mean**SIXTH
        agreement[j] = mean


@njit(cache=True, fastmath=FASTMATH)
def _fill_unseen(row, unseen, best):
    """Replace the negative scores of a row of cells ``[D, W]`` (heights that no pair sees).

    A hidden height must stay possible, but not beat what is seen to agree, however poorly.
    """
    best[:] = 0
    for k in range(row.shape[0]):
        for j in range(row.shape[1]):
            best[j] = max(best[j], row[k, j])
    for k in range(row.shape[0]):
        for j in range(row.shape[1]):
            row[k, j] = min(unseen, GUARD * best[j]) if row[k, j] < 0 else row[k, j]


@njit(cache=True, fastmath=FASTMATH)
def _look(
    image, mask, parallax, z, base, z_ref, hit_height, shadow_height, tolerance, radius, margin, weak, r0, c0,
    moved, seen,
):  # fmt: skip
    """What a view shows of a tile at a height (or a height above a surface), and how well it sees it."""
    rows, cols = seen.shape
    dz = z - z_ref
    if len(base):
        part = base[r0 : r0 + rows + 2 * radius, c0 : c0 + cols + 2 * radius]
        _follow(image, part, margin + r0 - radius, margin + c0 - radius, parallax, dz, moved)
        for i in range(rows):
            for j in range(cols):
                there = part[i + radius, j + radius] + z
                nr = margin + r0 + i + round(parallax[0] * (there - z_ref))
                nc = margin + c0 + j + round(parallax[1] * (there - z_ref))
                lit = np.float32(1) if there >= shadow_height[r0 + i, c0 + j] else np.float32(-1)
                near = hit_height[nr, nc] <= there + tolerance
                seen[i, j] = lit * np.float32(mask[nr, nc]) * (np.float32(1) if near else weak)
        return
    dr, dc = parallax[0] * dz, parallax[1] * dz
    _translate(image, margin + r0 - radius, margin + c0 - radius, dr, dc, moved)
    lowest_hit = np.float32(z + tolerance)
    nr, nc = margin + r0 + round(dr), margin + c0 + round(dc)
    for i in range(rows):
        valid, hit = mask[nr + i, nc : nc + cols], hit_height[nr + i, nc : nc + cols]
        shadow, target = shadow_height[r0 + i, c0 : c0 + cols], seen[i]
        for j in range(cols):
            lit = np.float32(1) if z >= shadow[j] else np.float32(-1)
            target[j] = lit * np.float32(valid[j]) * (np.float32(1) if hit[j] <= lowest_hit else weak)


@njit(inline="always", fastmath=FASTMATH)
def _correlate_tile(
    images, masks, parallax, heights, base, z_ref, hit_heights, shadow_heights, dark, tolerance,
    pairs, radius, noise, shadow_noise, brightness, margin, unseen, power, weak, mixed, active, r0, c0,
    volume,
):  # fmt: skip
    """The part of `correlate` whose first cell is (r0, c0): ``volume`` is ``[rows, D, columns]``."""
    views = images.shape[0]
    rows, depth, cols = volume.shape
    moved = np.empty((views, rows + 2 * radius, cols + 2 * radius), np.float32)
    seen = np.empty((views, rows, cols), np.float32)
    mean = np.empty((views, rows, cols), np.float32)
    variance = np.empty((views, rows, cols), np.float32)
    sums = np.empty(cols + 2 * radius, np.float32)
    squares = np.empty(cols + 2 * radius, np.float32)
    line = np.empty(cols, np.float32)
    products = np.empty((2 * radius + 1, cols), np.float32)
    total = np.empty((rows, cols), np.float32)
    weight = np.empty((rows, cols), np.float32)
    for k in range(depth):
        if not active[k]:
            volume[:, k] = 0
            continue
        for v in range(views):
            _look(
                images[v], masks[v], parallax[v], heights[k], base, z_ref, hit_heights[v], shadow_heights[v], tolerance,
                radius, margin, weak, r0, c0, moved[v], seen[v],
            )  # fmt: skip
            _moments(moved[v], radius, mean[v], variance[v], sums, squares, line)
        total[:] = 0
        weight[:] = 0
        for p in range(pairs.shape[0]):
            a, b = pairs[p, 0], pairs[p, 1]
            if radius == 1:
                _add_pair_3x3(
                    moved[a], moved[b], mean[a], mean[b], variance[a], variance[b], seen[a], seen[b], dark[a], dark[b],
                    noise, shadow_noise, brightness, power, mixed, products, line, total, weight,
                )  # fmt: skip
            else:
                _add_pair(
                    moved[a], moved[b], mean[a], mean[b], variance[a], variance[b], seen[a], seen[b], dark[a], dark[b],
                    radius, noise, shadow_noise, brightness, power, mixed, products, line, total, weight,
                )  # fmt: skip
        for i in range(rows):
            _mean_over_pairs(total[i], weight[i], power, volume[i, k])
    for i in range(rows):
        _fill_unseen(volume[i], unseen, line)


@spread(lambda *arguments: arguments[-2].shape[0] * arguments[-2].shape[1])
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def correlate(
    images,
    masks,
    parallax,
    heights,
    base,
    z_ref,
    hit_heights,
    shadow_heights,
    dark,
    tolerance,
    pairs,
    radius,
    noise,
    shadow_noise,
    brightness,
    margin,
    unseen,
    power,
    weak,
    mixed,
    active,
    volume,
    first_tile,
    end_tile,
):
    """Agreement of the views at every (cell, height).

    It is a power mean over the pairs, weighted by whether both see the place, either both in the sun or both in shadow.

    A pair agrees by structure, (2 cov + noise^2) / (var_a + var_b + noise^2), times brightness,
    1 / (1 + (difference of means / brightness)^2): the two factors of SSIM (Wang et al. 2004) in a robust form.
    Correlation alone divides contrast out, so that next to a bright roof the roof's edge decides for its whole
    neighbourhood, and in shadow noise correlates; here a plain or dark place must at least be equally bright. The power
    mean lets the pairs that agree dominate those that are disturbed by change, without sorting them.

    Args:
        images: ``[V, Hf, Wf]`` float32 on the frame, mean near zero (single precision cancels otherwise).
        masks: ``[V, Hf, Wf]`` uint8, 1 = valid with its whole window.
        parallax: ``[V, 2]`` float64 (row, column) cells per metre of height.
        heights: ``[D]`` float64 [m].
        base: ``[H + 2 radius, W + 2 radius]`` float32 surface, with a border as wide as the window, above which the
            heights are meant [m]: planes become parallels of it, and windows follow it; ``[0, 0]`` for planes.
        z_ref: reference height of the frame [m].
        hit_heights: ``[V, Hf, Wf]`` float32 height at which the ray first meets the surface; very low = unknown.
        shadow_heights: ``[V, H, W]`` float32 height below which a point over a cell lies in shadow; very low = unknown.
        dark: ``[V]`` float32 radiance of shadows; very low = unknown.
        tolerance: depth below it that still counts as seen [m].
        pairs: ``[P, 2]`` int64.
        radius: half width of the window in cells.
        noise: contrast below which structure is not asked for (colour-matched radiance).
        shadow_noise: the same for windows in shadow.
        brightness: difference of two windows' means at which their agreement is halved.
        margin: cells between the border of the frame and that of the grid.
        unseen: score where no pair sees the point, but never above the best one that is seen in the cell.
        power: half the exponent of the mean over the pairs, 1 or 3.
        weak: weight of a view from which the surface hides the point; above 0, a place that no image can contradict
            is worth what the images show there, not a constant.
        mixed: factor of the weight of pairs in different light.
        active: ``[h, w, D]`` bool, planes that are looked at in every tile of `TILE` x `TILE_COLS` cells; on the others
            nothing agrees.
        volume: ``[H, D, W]`` float32, filled with agreements in [0, 1].
        first_tile: first tile, from `spread`.
        end_tile: the one after the last.
    """
    height, width = volume.shape[0], volume.shape[2]
    across = active.shape[1]
    for t in range(first_tile, end_tile):
        r0, c0 = TILE * (t // across), TILE_COLS * (t % across)
        rows, cols = slice(r0, min(r0 + TILE, height)), slice(c0, min(c0 + TILE_COLS, width))
        _correlate_tile(
            images, masks, parallax, heights, base, z_ref, hit_heights, shadow_heights, dark, tolerance,
            pairs, radius, noise, shadow_noise, brightness, margin, unseen, power, weak, mixed,
            active[t // across, t % across], r0, c0, volume[rows, :, cols],
        )  # fmt: skip


__all__ = ["TILE", "TILE_COLS", "correlate"]

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
ABOVE = np.float32(0.6)  # share that is left of the agreement of an unseen height above all that the images show there
HIDDEN, BEYOND = np.float32(-1), np.float32(-2)  # scores that say why no pair sees a place
TILE, TILE_COLS = 24, 96  # cells


@njit(cache=True, fastmath=FASTMATH)
def _translate(image, row0, col0, row_shift, col_shift, scale, out):
    """out(i, j) = scale image(row0 + i + row_shift, col0 + j + col_shift), bilinear."""
    rows, cols = out.shape
    iy, ix = math.floor(row_shift), math.floor(col_shift)
    fy, fx = np.float32(row_shift - iy), np.float32(col_shift - ix)
    gy, gx = scale * (np.float32(1) - fy), np.float32(1) - fx
    fy *= scale
    a, b, c, d = gy * gx, gy * fx, fy * gx, fy * fx
    for i in range(rows):
        upper = image[row0 + iy + i, col0 + ix : col0 + ix + cols + 1]
        lower = image[row0 + iy + i + 1, col0 + ix : col0 + ix + cols + 1]
        target = out[i]
        for j in range(cols):
            target[j] = a * upper[j] + b * upper[j + 1] + c * lower[j] + d * lower[j + 1]


@njit(cache=True, fastmath=FASTMATH)
def _follow(image, surface, row0, col0, parallax, dz, scale, out):
    """out(i, j) = scale image(row0 + i + parallax[0] z, col0 + j + parallax[1] z), bilinear, z = surface(i, j) + dz."""
    rows, cols = out.shape
    for i in range(rows):
        for j in range(cols):
            z = surface[i, j] + dz
            r, c = row0 + i + parallax[0] * z, col0 + j + parallax[1] * z
            iy, ix = math.floor(r), math.floor(c)
            fy, fx = np.float32(r - iy), np.float32(c - ix)
            upper = image[iy, ix] + fx * (image[iy, ix + 1] - image[iy, ix])
            lower = image[iy + 1, ix] + fx * (image[iy + 1, ix + 1] - image[iy + 1, ix])
            out[i, j] = scale * (upper + fy * (lower - upper))


# A tile's maps lie in memory as one line, its rows one after the other, each with the columns by which windows reach
# beyond it: what is done to a row is done to all of them in one loop, without a beginning and an end for every row.
# What the last columns of a row hold in the results is of no use, and nothing is seen there.


@njit(cache=True, fastmath=FASTMATH)
def _sums_downward(line, radius, stride, out):
    """Sums of 2 radius + 1 values, each a row below the one before."""
    count = len(out) - 2 * radius
    if radius == 1:  # the default, in one pass instead of three
        second, third = line[stride:], line[2 * stride :]
        for n in range(count):
            out[n] = line[n] + second[n] + third[n]
        return
    out[:count] = 0
    for k in range(2 * radius + 1):
        below = line[k * stride :]
        for n in range(count):
            out[n] += below[n]


@njit(cache=True, fastmath=FASTMATH)
def _window_sums(values, radius, stride, line, out):
    """Sums over all windows: out(i, j) = sum of values(i .. i + 2 radius, j .. j + 2 radius); ``line``: scratch."""
    wide = len(values) - 2 * radius
    if radius == 1:
        for n in range(wide):
            line[n] = values[n] + values[n + 1] + values[n + 2]
    else:
        line[:wide] = 0
        for k in range(2 * radius + 1):
            for n in range(wide):
                line[n] += values[n + k]
    _sums_downward(line, radius, stride, out)


@njit(cache=True, fastmath=FASTMATH)
def _product_sums(a, b, radius, stride, line, out):
    """The same of the products of two tiles."""
    wide = len(a) - 2 * radius
    if radius == 1:
        for n in range(wide):
            line[n] = a[n] * b[n] + a[n + 1] * b[n + 1] + a[n + 2] * b[n + 2]
    else:
        line[:wide] = 0
        for k in range(2 * radius + 1):
            for n in range(wide):
                line[n] += a[n + k] * b[n + k]
    _sums_downward(line, radius, stride, out)


@njit(cache=True, fastmath=FASTMATH)
def _moments(moved, seen, darkest, radius, stride, noise, squares, line, mean, variance, gloom):
    """Of every window sqrt(2) times the mean, the variance and half of noise^2, and whether it is as dark as shadows.

    moved: as scaled by `_scale`; seen: negative in shadow; darkest: brightness up to which it may be a shadow's;
    squares, line: scratch.
    """
    norm, half = np.float32(1.0 / (2 * radius + 1)), np.float32(0.5)
    floor = np.float32(0.5 * noise * noise)
    limit = np.float32(math.sqrt(2.0) * darkest)
    for n in range(len(moved)):
        squares[n] = moved[n] * moved[n]
    _window_sums(moved, radius, stride, line, mean)
    _window_sums(squares, radius, stride, line, variance)
    for n in range(len(mean) - 2 * radius):
        m = mean[n] * norm
        mean[n] = m
        variance[n] = max(variance[n] - m * m, np.float32(0)) * half + floor
        gloom[n] = np.float32(1) if (seen[n] < 0) & (m < limit) else np.float32(0)


@njit(inline="always")
def _scale(radius):
    """Factor of the images with which a window's sum of products is twice the mean product."""
    return np.float32(math.sqrt(2.0) / (2 * radius + 1))


@njit(cache=True, fastmath=FASTMATH)
def _add_pair(
    product, mean_a, mean_b, variance_a, variance_b, seen_a, seen_b, gloom_a, gloom_b,
    share, lit_floor, dark_floor, veil, steep, power, mixed, total, weight,
):  # fmt: skip
    """Add a power of a pair's agreement to ``total`` and the pair's weight to ``weight``.

    product: twice the windows' mean products; the other maps see `_moments`. seen_a, seen_b: weight of the view there,
    negative in shadow: 1 = seen, 0 = beyond the image. A pair has the product of its views' weights and its own
    ``share``, times ``mixed`` where one shows the point in the sun and the other in shadow. Where both are in shadow
    and as dark as shadows are (gloom_a, gloom_b), brightness counts from there (``veil``, the difference of their
    shadows), and structure only above the noise of the dark, ``dark_floor`` more than ``lit_floor``. power: 1 = second,
    3 = sixth.
    """
    # every constant in single precision: one in double makes the whole line double
    zero, one = np.float32(0), np.float32(1)
    for n in range(len(total)):
        both = share * seen_a[n] * seen_b[n]
        both = max(both, -mixed * both)
        dark = gloom_a[n] * gloom_b[n]
        more = dark * dark_floor
        shared = max(product[n] - mean_a[n] * mean_b[n] + (more + lit_floor), zero)
        apart = mean_a[n] - mean_b[n] - dark * veil
        score = shared / ((variance_a[n] + variance_b[n] + more) * (one + apart * apart * steep))
        square = score * score
        total[n] += both * (square if power == 1 else square * square * square)
        weight[n] += both


@njit(cache=True, fastmath=FASTMATH)
def _cube_roots(values, guess):
    """Cube roots of a row in place, to single precision; 0 below 1e-30.

    A first ``guess`` from a third of the exponent is within 4 %, and every step of Halley's cubes what it is off. The
    library's power function, which takes one number at a time, took a tenth of the matching's time.
    """
    third, magic, least = np.float32(1 / 3), np.int32(709958130), np.float32(1e-30)
    bits, first = values.view(np.int32), guess.view(np.int32)
    for j in range(values.shape[0]):
        first[j] = np.int32(np.float32(bits[j]) * third) + magic
    for j in range(values.shape[0]):
        x, y = values[j], guess[j]
        cube = y * y * y
        y *= (cube + x + x) / (cube + cube + x)
        cube = y * y * y
        y *= (cube + x + x) / (cube + cube + x)
        values[j] = y if x > least else np.float32(0)


@njit(cache=True, fastmath=FASTMATH)
def _mean_over_pairs(total, weight, power, best, line):
    """Turn a row's sums over the pairs into their power mean, `HIDDEN` where no pair sees the place; note the ``best``.

    Returns: whether there is such a place.
    """
    hidden = False
    for j in range(total.shape[0]):
        total[j] = math.sqrt(total[j] / weight[j]) if weight[j] > 0 else np.float32(0)
    if power == 3:
        _cube_roots(total, line)
    for j in range(total.shape[0]):
        best[j] = max(best[j], total[j])
        total[j] = total[j] if weight[j] > 0 else HIDDEN
        hidden |= not weight[j] > 0
    return hidden


@njit(cache=True)
def _mark_beyond(row, masks, parallax, dz, frame_row, frame_col):
    """Of a row at one height, tell what is hidden from what fewer than two images show at all."""
    shown = np.zeros(row.shape[0], np.int64)
    for v in range(masks.shape[0]):
        nr, nc = frame_row + round(parallax[v, 0] * dz), frame_col + round(parallax[v, 1] * dz)
        for j in range(row.shape[0]):
            shown[j] += np.int64(masks[v, nr, nc + j])
    for j in range(row.shape[0]):
        if row[j] < 0 and shown[j] < 2:
            row[j] = BEYOND


@njit(cache=True, fastmath=FASTMATH)
def _fill_unseen(row, unseen, best):
    """Replace the negative scores of a row of cells ``[D, W]``: heights that no pair sees.

    A hidden height must stay possible, but not beat what is seen to agree, however poorly. One above all that is shown
    of a cell is worth less, as lines of sight leave an image upwards, too: up there a level surface would beat ground
    on which images agree weakly. Below what is shown, ground is likelier than what agrees by chance above it.
    """
    above = np.ones(row.shape[1], np.bool_)
    for k in range(row.shape[0] - 1, -1, -1):
        for j in range(row.shape[1]):
            above[j] &= (row[k, j] == BEYOND) | (row[k, j] == 0)  # 0: not looked at
            if row[k, j] < 0:
                row[k, j] = min(unseen * (ABOVE if above[j] else np.float32(1)), GUARD * best[j])


@njit(cache=True, fastmath=FASTMATH)
def _look(
    image, mask, weight, parallax, z, base, z_ref, hit_height, shadow_height, tolerance, radius, margin, weak, r0, c0,
    moved, seen,
):  # fmt: skip
    """What a view shows of a tile at a height (or a height above a surface), and how well it sees it.

    weight, weak: of the view where it sees a point, and where the surface hides it; moved: ``[rows + 2 radius, cols +
    2 radius]``; seen: ``[rows, cols + 2 radius]``, whose last columns are left alone.
    """
    rows, cols = len(seen), seen.shape[1] - 2 * radius
    dz, scale = z - z_ref, _scale(radius)
    if len(base):
        part = base[r0 : r0 + rows + 2 * radius, c0 : c0 + cols + 2 * radius]
        _follow(image, part, margin + r0 - radius, margin + c0 - radius, parallax, dz, scale, moved)
        for i in range(rows):
            for j in range(cols):
                there = part[i + radius, j + radius] + z
                nr = margin + r0 + i + round(parallax[0] * (there - z_ref))
                nc = margin + c0 + j + round(parallax[1] * (there - z_ref))
                lit = np.float32(1) if there >= shadow_height[r0 + i, c0 + j] else np.float32(-1)
                near = hit_height[nr, nc] <= there + tolerance
                seen[i, j] = lit * np.float32(mask[nr, nc]) * (weight if near else weak)
        return
    dr, dc = parallax[0] * dz, parallax[1] * dz
    _translate(image, margin + r0 - radius, margin + c0 - radius, dr, dc, scale, moved)
    lowest_hit, lowest_lit = np.float32(z + tolerance), np.float32(z)
    nr, nc = margin + r0 + round(dr), margin + c0 + round(dc)
    for i in range(rows):
        valid, hit = mask[nr + i, nc : nc + cols], hit_height[nr + i, nc : nc + cols]
        shadow, target = shadow_height[r0 + i, c0 : c0 + cols], seen[i]
        for j in range(cols):
            lit = np.float32(1) if lowest_lit >= shadow[j] else np.float32(-1)
            target[j] = lit * np.float32(valid[j]) * (weight if hit[j] <= lowest_hit else weak)


@njit(inline="always", fastmath=FASTMATH)
def _correlate_tile(
    images, masks, view_weights, parallax, heights, base, z_ref, hit_heights, shadow_heights, dark, tolerance,
    pairs, pair_shares, radius, noise, shadow_noise, brightness, margin, unseen, power, weak, mixed, active, r0, c0,
    volume,
):  # fmt: skip
    """The part of `correlate` whose first cell is (r0, c0): ``volume`` is ``[rows, D, columns]``."""
    views = images.shape[0]
    rows, depth, cols = volume.shape
    stride = cols + 2 * radius
    moved = np.empty((views, (rows + 2 * radius) * stride), np.float32)
    mean, variance = np.zeros((views, rows * stride), np.float32), np.ones((views, rows * stride), np.float32)
    seen, gloom = np.zeros((views, rows * stride), np.float32), np.zeros((views, rows * stride), np.float32)
    squares, line = np.empty(moved.shape[1], np.float32), np.empty(moved.shape[1], np.float32)
    product = np.zeros(rows * stride, np.float32)
    total, weight = np.empty(rows * stride, np.float32), np.empty(rows * stride, np.float32)
    totals, weights = total.reshape(rows, stride), weight.reshape(rows, stride)
    best, hidden = np.zeros((rows, cols), np.float32), np.zeros(rows, np.bool_)
    lit_floor = np.float32(noise * noise)
    dark_floor = np.float32(shadow_noise * shadow_noise) - lit_floor
    steep = np.float32(0.5 / (brightness * brightness))
    for k in range(depth):
        if not active[k]:
            volume[:, k] = 0
            continue
        for v in range(views):
            _look(
                images[v], masks[v], view_weights[v], parallax[v], heights[k], base, z_ref, hit_heights[v],
                shadow_heights[v], tolerance, radius, margin, weak * view_weights[v], r0, c0,
                moved[v].reshape(rows + 2 * radius, stride), seen[v].reshape(rows, stride),
            )  # fmt: skip
            _moments(
                moved[v], seen[v], dark[v] + brightness, radius, stride, noise, squares, line, mean[v], variance[v],
                gloom[v],
            )  # fmt: skip
        total[:] = 0
        weight[:] = 0
        for p in range(pairs.shape[0]):
            a, b = pairs[p, 0], pairs[p, 1]
            veil = np.float32(math.sqrt(2.0)) * (dark[a] - dark[b])
            _product_sums(moved[a], moved[b], radius, stride, line, product)
            _add_pair(
                product, mean[a], mean[b], variance[a], variance[b], seen[a], seen[b], gloom[a], gloom[b],
                pair_shares[p], lit_floor, dark_floor, veil, steep, power, mixed, total, weight,
            )  # fmt: skip
        for i in range(rows):
            row = totals[i, :cols]
            if _mean_over_pairs(row, weights[i, :cols], power, best[i], line[:cols]):
                hidden[i] = True
                if not len(base) and len(pairs) > 2:  # two images have no third to ask
                    _mark_beyond(row, masks, parallax, heights[k] - z_ref, margin + r0 + i, margin + c0)
            for j in range(cols):  # a row at once would take numba three seconds more to compile
                volume[i, k, j] = row[j]
    for i in range(rows):
        if hidden[i]:
            _fill_unseen(volume[i], unseen, best[i])


@spread(lambda *arguments: arguments[-2].shape[0] * arguments[-2].shape[1])
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def correlate(
    images, masks, view_weights, parallax, heights, base, z_ref, hit_heights, shadow_heights, dark, tolerance,
    pairs, pair_shares, radius, noise, shadow_noise, brightness, margin, unseen, power, weak, mixed, active, volume,
    first_tile, end_tile,
):  # fmt: skip
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
        view_weights: ``[V]`` float32, how much each view counts.
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
        pair_shares: ``[P]`` float32, how much each pair counts.
        radius: half width of the window in cells.
        noise: contrast below which structure is not asked for (colour-matched radiance).
        shadow_noise: the same for windows in shadow.
        brightness: difference of two windows' means at which their agreement is halved.
        margin: cells between the border of the frame and that of the grid.
        unseen: score where no pair sees the point, at most the best one seen in the cell; less above all that is shown.
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
            images, masks, view_weights, parallax, heights, base, z_ref, hit_heights, shadow_heights, dark, tolerance,
            pairs, pair_shares, radius, noise, shadow_noise, brightness, margin, unseen, power, weak, mixed,
            active[t // across, t % across], r0, c0, volume[rows, :, cols],
        )  # fmt: skip


__all__ = ["TILE", "TILE_COLS", "correlate"]

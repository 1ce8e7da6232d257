"""Compiled CPU kernels that follow rays through the columns of the neural field; `sattools.render.columns` calls them.

A ray is followed from sample to sample, and on from where it ends towards the sun, without anything being written but
what its gradients will need: one record for every sample in which something is. Most samples are above the columns, and
a ray ends where nothing more of its colour could be seen. Gradients go back through the records, which then hold what
each sample adds to the tensors; every tensor is summed by one thread, in the order of the records, so that sums do not
depend on the number of threads. Arrays as in `sattools.field.kernels`; bands come as a tuple of as many zeros, whose
length is known when a kernel is compiled, so that its loops have no ends to look for.
"""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import FASTMATH, njit, spread
from sattools.field.kernels import (
    CHUNKS,
    EMPTY,
    LEAST,
    ONE,
    corner_weight,
    place,
    place_within,
    read_map,
    sigmoid,
    slice_of,
)
from sattools.render.volume import LOW_SUN

HIDDEN = 1e-3  # transmittance at which a ray ends: there `NeuralField.shown` asks for no colour
DARK = 1e-4  # transmittance at which a ray to the sun ends: nobody sees so little light
BLOCK = 64  # values of a gradient that are marked together
# columns of a record: place [m], metres of height, transmittance behind, weight, the three heights' sigmoids, the two
# shares; then colours, and the logits of colours by height
X, Y, Z, LENGTH, BEHIND, WEIGHT, LOW, P, Q, COLOUR = 0, 1, 2, 3, 4, 5, 6, 9, 10, 11
SUN_RECORD = COLOUR  # columns of a ray to the sun's


@njit(fastmath=FASTMATH)
def _merged(free, near, t):
    """All shares of a ray in ascending order; `free` is so already."""
    count = len(free)
    for k in range(count):
        t[k] = free[k]
    for k in range(len(near)):
        value, i = near[k], count + k
        while i > 0 and t[i - 1] > value:
            t[i] = t[i - 1]
            i -= 1
        t[i] = value


@njit(fastmath=FASTMATH)
def _optical_depth(point, length, columns, record):
    """Optical depth of a sample, and its columns' cells and weights; the record gets what its gradient will need."""
    maps, frame, softness = columns
    inverse = ONE / softness
    at, weights = place(point, frame, maps)
    z, high = point[2], read_map(maps, 2, at, weights)
    if z > high + np.float32(EMPTY) * softness:
        return np.float32(0.0), at, weights
    p, q = sigmoid(read_map(maps, 3, at, weights)), sigmoid(read_map(maps, 4, at, weights))
    low = sigmoid((read_map(maps, 0, at, weights) - z) * inverse)
    own = sigmoid((read_map(maps, 1, at, weights) - z) * inverse)
    top = sigmoid((high - z) * inverse)
    record[X], record[Y], record[Z], record[LENGTH] = point[0], point[1], z, length
    record[LOW], record[LOW + 1], record[LOW + 2], record[P], record[Q] = low, own, top, p, q
    return _total(low, own, top, p, q) * inverse * length, at, weights


@njit(fastmath=FASTMATH)
def _total(low, own, top, p, q):
    """Density of the three heights together, per softness."""
    return low * (ONE - p) + own * (p - p * q) + top * (p * q)


@njit(fastmath=FASTMATH)
def _opacity(optical):
    """1 - exp(-optical), by its series where the difference would have no digits."""
    if optical < np.float32(0.01):
        return optical * (ONE - optical * (np.float32(0.5) - optical * np.float32(1 / 6)))
    return ONE - np.float32(math.exp(-optical))


@njit(fastmath=FASTMATH)
def _add_colour(record, at, weights, shades, bands):
    """Put a sample's colours into its record."""
    colours, _, volumes, frames = shades
    low, own, top, p, q = record[LOW], record[LOW + 1], record[LOW + 2], record[P], record[Q]
    share = ONE / max(_total(low, own, top, p, q), np.float32(LEAST))
    parts = (low * (ONE - p) * share, own * (p - p * q) * share, top * (p * q) * share)
    top_row, bottom_row, left, right = at
    wa, wb, wc, wd = weights
    a, b = colours[top_row, left], colours[top_row, right]
    c, d = colours[bottom_row, left], colours[bottom_row, right]
    first = COLOUR + len(bands)
    for j in range(3 * len(bands)):
        record[first + j] = (a[j] * wa + b[j] * wb) + (c[j] * wc + d[j] * wd)
    for i in range(len(bands)):
        record[COLOUR + i] = (
            record[first + i] * parts[0]
            + record[first + len(bands) + i] * parts[1]
            + record[first + 2 * len(bands) + i] * parts[2]
        )
    for v in range(len(volumes)):
        volume = volumes[v]
        depth, row, col, way = place_within((record[X], record[Y], record[Z]), frames[v], volume)
        for layer in range(2):
            wz = way[0] if layer else ONE - way[0]
            above, below = volume[depth[layer], row[0]], volume[depth[layer], row[1]]
            e, f, g, h = above[col[0]], above[col[1]], below[col[0]], below[col[1]]
            wf, wh = wz * (ONE - way[1]) * way[2], wz * way[1] * way[2]
            we, wg = wz * (ONE - way[1]) - wf, wz * way[1] - wh
            for i in range(len(bands)):
                record[COLOUR + i] += (e[i] * we + f[i] * wf) + (g[i] * wg + h[i] * wh)
    for i in range(len(bands)):
        record[COLOUR + i] = sigmoid(record[COLOUR + i])


@njit(fastmath=FASTMATH)
def _view_ray(start, path, t, columns, shades, records, mean, bands):
    """Colours seen along a ray, added to `mean`; the share of the path at which it ends, and how many records."""
    half, count, begin = np.float32(0.5), 0, np.float32(0.0)
    transmittance, depth = ONE, np.float32(0.0)
    rise = abs(path[2])
    for i in range(len(t)):
        end = (t[i] + t[i + 1]) * half if i + 1 < len(t) else ONE
        length, begin = (end - begin) * rise, end
        point = (start[0] + t[i] * path[0], start[1] + t[i] * path[1], start[2] + t[i] * path[2])
        record = records[count]
        optical, at, weights = _optical_depth(point, length, columns, record)
        if not optical > 0:
            continue
        count += 1
        _add_colour(record, at, weights, shades, bands)
        weight = transmittance * _opacity(optical)
        transmittance *= np.float32(math.exp(-optical))
        record[BEHIND], record[WEIGHT] = transmittance, weight
        depth += weight * t[i]
        for c in range(len(bands)):
            mean[c] += weight * record[COLOUR + c]
        if transmittance <= np.float32(HIDDEN):
            return depth + transmittance * end, count
    return depth + transmittance, count


@njit(fastmath=FASTMATH)
def _sun_ray(start, path, t, columns, records):
    """Transmittance of a ray to the sun, and how many records; none where it is dark."""
    half, count, begin = np.float32(0.5), 0, np.float32(0.0)
    total, rise = np.float32(0.0), abs(path[2])
    dark = np.float32(-math.log(DARK))
    for i in range(len(t)):
        end = (t[i] + t[i + 1]) * half if i + 1 < len(t) else ONE
        length, begin = (end - begin) * rise, end
        point = (start[0] + t[i] * path[0], start[1] + t[i] * path[1], start[2] + t[i] * path[2])
        optical, _, _ = _optical_depth(point, length, columns, records[count])
        if optical > 0:
            count += 1
            total += optical
            if total > dark:
                return np.float32(0.0), 0
    return np.float32(math.exp(-total)), count


@njit(fastmath=FASTMATH)
def _towards_sun(surface, sun, top, skip):
    """Start and path of the ray from a surface point to the sun, as `sattools.render.volume.towards_sun` has it."""
    away = skip / max(sun[2], np.float32(LOW_SUN))
    start = (surface[0] + sun[0] * away, surface[1] + sun[1] * away, surface[2] + sun[2] * away)
    climb = max(top - start[2], np.float32(0.01)) / max(sun[2], np.float32(0.05))
    return start, (sun[0] * climb, sun[1] * climb, sun[2] * climb)


@spread(lambda *_: CHUNKS)
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def follow(rays, shares, columns, shades, seen, records, counts, bands, first_chunk, end_chunk):
    """Colours and sunlight of rays, filled in.

    rays: places [R, 2], paths [R, 3], suns [R, 3] (not above the horizon: all is lit), top and skip [m]. shares: free and near ones of
    the path [R, S], those to the sun [R, S]. columns: maps of heights and logits, frame, softness. shades: maps and
    volumes of logits of colours with their frames. seen: colours [R, C] and visibility of the sun [R]. records: of
    views and suns [R S, K], each chunk's from where its first ray's begin; counts [R, 2] how many a ray has.
    """
    places, paths, suns, top, skip = rays
    free, near, up = shares
    samples = free.shape[1] + near.shape[1]
    t = np.empty(samples, np.float32)
    for chunk in range(first_chunk, end_chunk):
        part = slice_of(chunk, len(places))
        at, at_sun = part.start * samples, part.start * up.shape[1]
        for r in range(part.start, part.stop):
            _merged(free[r], near[r], t)
            start, path, mean = (places[r, 0], places[r, 1], top), paths[r], seen[0][r]
            mean[:] = 0
            depth, counts[r, 0] = _view_ray(start, path, t, columns, shades, records[0][at:], mean, bands)
            at += counts[r, 0]
            seen[1][r], counts[r, 1] = ONE, 0
            if up.shape[1] > 0 and suns[r, 2] > 0:
                surface = (start[0] + depth * path[0], start[1] + depth * path[1], start[2] + depth * path[2])
                above, climb = _towards_sun(surface, suns[r], top, skip)
                seen[1][r], counts[r, 1] = _sun_ray(above, climb, up[r], columns, records[1][at_sun:])
                at_sun += counts[r, 1]


@njit(fastmath=FASTMATH)
def _logit_gradients(record, of_total, parts, of_parts):
    """Gradients of a sample's two shares' logits, from those of its density and parts, into their place."""
    low, own, top, p, q = record[LOW], record[LOW + 1], record[LOW + 2], record[P], record[Q]
    total = _total(low, own, top, p, q)
    share = ONE / max(total, np.float32(LEAST))
    mean = np.float32(0.0)
    if total > np.float32(LEAST):
        mean = of_parts[0] * parts[0] + of_parts[1] * parts[1] + of_parts[2] * parts[2]
    common = of_total - mean * share
    p0, p1, p2 = common + of_parts[0] * share, common + of_parts[1] * share, common + of_parts[2] * share
    record[P] = (own * (ONE - q) * p1 + top * q * p2 - low * p0) * p * (ONE - p)
    record[Q] = (top * p2 - own * p1) * p * q * (ONE - q)


@njit(fastmath=FASTMATH)
def _view_gradients(records, of_colour, inverse, bands):
    """Turn the records of a ray into gradients: of shares' logits, colours' logits; and the parts, for the maps."""
    behind, none = np.float32(0.0), np.float32(0.0)
    for i in range(len(records) - 1, -1, -1):
        record = records[i]
        low, own, top, p, q = record[LOW], record[LOW + 1], record[LOW + 2], record[P], record[Q]
        share = ONE / max(_total(low, own, top, p, q), np.float32(LEAST))
        parts = (low * (ONE - p) * share, own * (p - p * q) * share, top * (p * q) * share)
        weight, towards, g0, g1, g2 = record[WEIGHT], none, none, none, none
        first = COLOUR + len(bands)
        for c in range(len(bands)):
            colour = record[COLOUR + c]
            towards += of_colour[c] * colour
            raw = weight * of_colour[c] * colour * (ONE - colour)
            g0 += raw * record[first + c]
            g1 += raw * record[first + len(bands) + c]
            g2 += raw * record[first + 2 * len(bands) + c]
            record[COLOUR + c] = raw
        of_optical = towards * record[BEHIND] - behind
        behind += weight * towards
        _logit_gradients(record, of_optical * record[LENGTH] * inverse, parts, (g0, g1, g2))
        record[LOW], record[LOW + 1], record[LOW + 2] = parts


@spread(lambda *_: CHUNKS)
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def go_back(of_seen, visible, softness, records, counts, shape, bands, first_chunk, end_chunk):
    """Turn the records of `follow` into gradients, from those of colours and visibility; shape: samples of a ray."""
    none = np.float32(0.0)
    inverse = ONE / softness
    for chunk in range(first_chunk, end_chunk):
        part = slice_of(chunk, len(counts))
        at, at_sun = part.start * shape[0], part.start * shape[1]
        for r in range(part.start, part.stop):
            _view_gradients(records[0][at : at + counts[r, 0]], of_seen[0][r], inverse, bands)
            at += counts[r, 0]
            of_optical = -of_seen[1][r] * visible[r]
            for n in range(at_sun, at_sun + counts[r, 1]):
                record = records[1][n]
                of_total = of_optical * record[LENGTH] * inverse
                _logit_gradients(record, of_total, (none, none, none), (none, none, none))
            at_sun += counts[r, 1]


@njit(fastmath=FASTMATH, cache=True, nogil=True)
def add_shares(records, ends, frame, grad):
    """Add what records say of the logits of shares to their gradient [H, W, 2]; ends: of the chunks' records."""
    for chunk in range(len(ends)):
        for n in range(ends[chunk, 0], ends[chunk, 1]):
            record = records[n]
            at, weights = place(record, frame, grad)
            for corner in range(4):
                cell = grad[at[corner // 2], at[2 + corner % 2]]
                cell[0] += record[P] * weights[corner]
                cell[1] += record[Q] * weights[corner]


@njit(fastmath=FASTMATH, cache=True, nogil=True)
def add_colours(records, ends, frame, grad, touched, bands):
    """Add what records say of the colours of columns to their gradient [H, W, 3 C], and mark its blocks."""
    width = 3 * len(bands)
    for chunk in range(len(ends)):
        for n in range(ends[chunk, 0], ends[chunk, 1]):
            record = records[n]
            at, weights = place(record, frame, grad)
            for corner in range(4):
                row, col = at[corner // 2], at[2 + corner % 2]
                first = (row * grad.shape[1] + col) * width
                touched[first // BLOCK] = touched[(first + width - 1) // BLOCK] = 1
                cell = grad[row, col]
                for k in range(3):
                    part = record[LOW + k] * weights[corner]
                    for c in range(len(bands)):
                        cell[k * len(bands) + c] += part * record[COLOUR + c]


@njit(fastmath=FASTMATH, cache=True, nogil=True)
def add_volume(records, ends, frame, grad, touched, bands):
    """Add what records say of a volume of colours to its gradient [D, H, W, C], and mark its blocks."""
    width = len(bands)
    for chunk in range(len(ends)):
        for n in range(ends[chunk, 0], ends[chunk, 1]):
            record = records[n]
            depth, row, col, share = place_within(record, frame, grad)
            for corner in range(8):
                k, i, j = depth[corner >> 2], row[(corner >> 1) & 1], col[corner & 1]
                first = ((k * grad.shape[1] + i) * grad.shape[2] + j) * width
                touched[first // BLOCK] = touched[(first + width - 1) // BLOCK] = 1
                cell, w = grad[k, i, j], corner_weight(corner, share)
                for c in range(len(bands)):
                    cell[c] += w * record[COLOUR + c]


__all__ = ["BLOCK", "COLOUR", "SUN_RECORD", "add_colours", "add_shares", "add_volume", "follow", "go_back"]

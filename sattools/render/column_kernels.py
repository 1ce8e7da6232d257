"""Compiled CPU kernels that follow rays through the columns of the neural field; `sattools.render.columns` calls them.

A ray is followed from sample to sample, and on from where it ends towards the sun, without anything being written but
what its gradients will need: one record for every sample in which something is. Most samples are above the columns, and
a ray ends where nothing more of its colour could be seen. Gradients go back through the records, which then hold what
each sample adds to the tensors; every tensor is summed by one thread, in the order of the records, so that sums do not
depend on the number of threads. Maps and volumes as in `sattools.field.kernels`, but flat, with their sizes beside
them: where values lie is then found by a few sums of unsigned numbers, none of which numba asks whether it counts from
the end. Bands come as a tuple of as many zeros, whose length is known when a kernel is compiled.
"""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import FASTMATH, njit, spread
from sattools.field.kernels import CHUNKS, EMPTY, LEAST, ONE, between, sigmoid, slice_of
from sattools.render.volume import LOW_SUN

HIDDEN = 1e-3  # transmittance at which a ray ends: there `NeuralField.shown` asks for no colour
DARK = 1e-4  # transmittance at which a ray to the sun ends: nobody sees so little light
BLOCK = 64  # values of a gradient that are marked together
# columns of a record: place [m], metres of height, transmittance behind, weight, the three heights' sigmoids, the two
# shares; then colours, and the logits of colours by height
X, Y, Z, LENGTH, BEHIND, WEIGHT, LOW, OWN, TOP, P, Q, COLOUR = range(12)
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


@njit(fastmath=FASTMATH, forceinline=True)
def _cell(point, frame, sizes):
    """Number of the first value of the cell that a point lies in, steps to the next ones, and the corners' weights.

    frame: as of `sattools.field.kernels.frame_of`; sizes: rows, columns and values of a cell.
    """
    rows, cols, width = sizes[0], sizes[1], np.uintp(sizes[2])
    half = np.float32(0.5)
    left, right, fx = between((point[0] - frame[0]) * frame[1] - half, cols)
    top, bottom, fy = between((frame[2] - point[1]) * frame[3] - half, rows)
    row = np.uintp(cols) * width
    steps = (np.uintp(bottom - top) * row, np.uintp(right - left) * width)
    weights = ((ONE - fx) * (ONE - fy), fx * (ONE - fy), (ONE - fx) * fy, fx * fy)
    return np.uintp(top) * row + np.uintp(left) * width, steps, weights


@njit(fastmath=FASTMATH, forceinline=True)
def _read(values, at, steps, weights):
    """Bilinear value of what lies at `at` in the first corner."""
    a, b, c, d = weights
    below = at + steps[0]
    return (values[at] * a + values[at + steps[1]] * b) + (values[below] * c + values[below + steps[1]] * d)


@njit(fastmath=FASTMATH, forceinline=True)
def _cell_within(point, frame, sizes):
    """The same for a volume; frame as of `frame_within`; sizes: layers, rows, columns and values of a cell."""
    rows, cols, width = np.uintp(sizes[1]), np.uintp(sizes[2]), np.uintp(sizes[3])
    left, right, fx = between((point[0] - frame[0]) * frame[1], sizes[2])
    top, bottom, fy = between((frame[2] - point[1]) * frame[3], sizes[1])
    lower, upper, fz = between((point[2] - frame[4]) * frame[5], sizes[0])
    row = cols * width
    steps = (np.uintp(upper - lower) * (rows * row), np.uintp(bottom - top) * row, np.uintp(right - left) * width)
    a, b, c, d = (ONE - fx) * (ONE - fy), fx * (ONE - fy), (ONE - fx) * fy, fx * fy
    below = ONE - fz
    weights = (a * below, b * below, c * below, d * below, a * fz, b * fz, c * fz, d * fz)
    return (np.uintp(lower) * rows + np.uintp(top)) * row + np.uintp(left) * width, steps, weights


@njit(fastmath=FASTMATH, forceinline=True)
def _read_within(values, at, steps, weights):
    """Trilinear value of what lies at `at` in the first corner."""
    a, b, c, d, e, f, g, h = weights
    above, dy, dx = at + steps[0], steps[1], steps[2]
    low = (values[at] * a + values[at + dx] * b) + (values[at + dy] * c + values[at + dy + dx] * d)
    return low + ((values[above] * e + values[above + dx] * f) + (values[above + dy] * g + values[above + dy + dx] * h))


@njit(fastmath=FASTMATH)
def _optical_depth(point, length, columns, records, n):
    """Optical depth of a sample; record n gets what its gradient will need."""
    maps, frame, sizes, softness = columns
    inverse = ONE / softness
    at, steps, weights = _cell(point, frame, sizes)
    z, high = point[2], _read(maps, at + np.uintp(2), steps, weights)
    if z > high + np.float32(EMPTY) * softness:
        return np.float32(0.0)
    p = sigmoid(_read(maps, at + np.uintp(3), steps, weights))
    q = sigmoid(_read(maps, at + np.uintp(4), steps, weights))
    low = sigmoid((_read(maps, at, steps, weights) - z) * inverse)
    own = sigmoid((_read(maps, at + np.uintp(1), steps, weights) - z) * inverse)
    top = sigmoid((high - z) * inverse)
    records[n, X], records[n, Y], records[n, Z], records[n, LENGTH] = point[0], point[1], z, length
    records[n, LOW], records[n, OWN], records[n, TOP] = low, own, top
    records[n, P], records[n, Q] = p, q
    return _total(low, own, top, p, q) * inverse * length


@njit(fastmath=FASTMATH, forceinline=True)
def _total(low, own, top, p, q):
    """Density of the three heights together, per softness."""
    return low * (ONE - p) + own * (p - p * q) + top * (p * q)


@njit(fastmath=FASTMATH, forceinline=True)
def _opacity(optical):
    """1 - exp(-optical), by its series where the difference would have no digits."""
    if optical < np.float32(0.01):
        return optical * (ONE - optical * (np.float32(0.5) - optical * np.float32(1 / 6)))
    return ONE - np.float32(math.exp(-optical))


@njit(fastmath=FASTMATH, forceinline=True)
def _parts(records, n):
    """Parts of the three heights in a sample's density, and the factor that made them of their densities."""
    low, own, top, p, q = records[n, LOW], records[n, OWN], records[n, TOP], records[n, P], records[n, Q]
    share = ONE / max(_total(low, own, top, p, q), np.float32(LEAST))
    return (low * (ONE - p) * share, own * (p - p * q) * share, top * (p * q) * share), share


@njit(fastmath=FASTMATH)
def _begin_colours(records, first, end, maps, frame, sizes, bands):
    """Put the logits of colours by height into records, and their means by the parts."""
    count = len(bands)
    for n in range(first, end):
        (low, own, top), _ = _parts(records, n)
        at, steps, weights = _cell((records[n, X], records[n, Y]), frame, sizes)
        for c in range(count):
            k = at + np.uintp(c)
            u = _read(maps, k, steps, weights)
            v = _read(maps, k + np.uintp(count), steps, weights)
            w = _read(maps, k + np.uintp(2 * count), steps, weights)
            i = COLOUR + count + c
            records[n, i], records[n, i + count], records[n, i + 2 * count] = u, v, w
            records[n, COLOUR + c] = u * low + v * own + w * top


@njit(fastmath=FASTMATH)
def _go_on_with_colours(records, first, end, values, frame, sizes, bands):
    """Add a volume's logits to the colours of records."""
    for n in range(first, end):
        at, steps, weights = _cell_within((records[n, X], records[n, Y], records[n, Z]), frame, sizes)
        for c in range(len(bands)):
            records[n, COLOUR + c] += _read_within(values, at + np.uintp(c), steps, weights)


@njit(fastmath=FASTMATH, forceinline=True)
def _length(t, i, rise, begin):
    """Where the part of the path that sample i stands for ends, and how many metres of height it has."""
    end = (t[i] + t[i + 1]) * np.float32(0.5) if i + 1 < len(t) else ONE
    return end, (end - begin) * rise


@njit(fastmath=FASTMATH)
def _view_ray(start, path, t, columns, records, first):
    """Weights of a ray's samples; the share of the path at which it ends, and its records' end."""
    n, begin, transmittance, depth = first, np.float32(0.0), ONE, np.float32(0.0)
    rise = abs(path[2])
    for i in range(len(t)):
        end, length = _length(t, i, rise, begin)
        begin = end
        point = (start[0] + t[i] * path[0], start[1] + t[i] * path[1], start[2] + t[i] * path[2])
        optical = _optical_depth(point, length, columns, records, n)
        if not optical > 0:
            continue
        weight = transmittance * _opacity(optical)
        transmittance *= np.float32(math.exp(-optical))
        records[n, BEHIND], records[n, WEIGHT] = transmittance, weight
        depth += weight * t[i]
        n += 1
        if transmittance <= np.float32(HIDDEN):
            return depth + transmittance * end, n
    return depth + transmittance, n


@njit(fastmath=FASTMATH)
def _colours(records, first, end, shades, mean, bands):
    """Colours of a ray's samples, and their mean by weight: grid by grid, so that there is less to keep at hand."""
    maps, volumes, frames, sizes, volume_sizes = shades
    _begin_colours(records, first, end, maps, frames[0], sizes, bands)
    for v in range(len(volumes)):
        _go_on_with_colours(records, first, end, volumes[v], frames[1 + v], volume_sizes[v], bands)
    mean[:] = 0
    for n in range(first, end):
        for c in range(len(bands)):
            colour = sigmoid(records[n, COLOUR + c])
            records[n, COLOUR + c] = colour
            mean[c] += records[n, WEIGHT] * colour


@njit(fastmath=FASTMATH)
def _sun_ray(start, path, t, columns, records, first):
    """Transmittance of a ray to the sun, and its records' end; it has none where it is dark."""
    n, begin, total = first, np.float32(0.0), np.float32(0.0)
    rise, dark = abs(path[2]), np.float32(-math.log(DARK))
    for i in range(len(t)):
        end, length = _length(t, i, rise, begin)
        begin = end
        point = (start[0] + t[i] * path[0], start[1] + t[i] * path[1], start[2] + t[i] * path[2])
        optical = _optical_depth(point, length, columns, records, n)
        if optical > 0:
            n += 1
            total += optical
            if total > dark:
                return np.float32(0.0), first
    return np.float32(math.exp(-total)), n


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

    rays: places [R, 2], paths [R, 3], suns [R, 3] (not above the horizon: all is lit), top and skip [m]. shares: free
    and near ones of the path [R, S], those to the sun [R, S]. columns: maps of heights and logits, their frame and
    sizes, softness. shades: maps and volumes of logits of colours, the frames and sizes of both. seen: colours [R, C]
    and visibility of the sun [R]. records: of views and suns [R S + 1, K], each chunk's from where its first ray's
    begin; counts [R, 2] how many a ray has.
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
            start, path = (places[r, 0], places[r, 1], top), (paths[r, 0], paths[r, 1], paths[r, 2])
            depth, end = _view_ray(start, path, t, columns, records[0], at)
            _colours(records[0], at, end, shades, seen[0][r], bands)
            counts[r, 0], at = end - at, end
            seen[1][r], counts[r, 1] = ONE, 0
            if up.shape[1] > 0 and suns[r, 2] > 0:
                surface = (start[0] + depth * path[0], start[1] + depth * path[1], start[2] + depth * path[2])
                above, climb = _towards_sun(surface, suns[r], top, skip)
                seen[1][r], end = _sun_ray(above, climb, up[r], columns, records[1], at_sun)
                counts[r, 1], at_sun = end - at_sun, end


@njit(fastmath=FASTMATH)
def _logit_gradients(records, n, of_total, of_parts):
    """Gradients of a sample's two shares' logits, from those of its density and parts, into their place."""
    low, own, top, p, q = records[n, LOW], records[n, OWN], records[n, TOP], records[n, P], records[n, Q]
    parts, share = _parts(records, n)
    mean = np.float32(0.0)
    if share * np.float32(LEAST) < ONE:
        mean = of_parts[0] * parts[0] + of_parts[1] * parts[1] + of_parts[2] * parts[2]
    common = of_total - mean * share
    p0, p1, p2 = common + of_parts[0] * share, common + of_parts[1] * share, common + of_parts[2] * share
    records[n, P] = (own * (ONE - q) * p1 + top * q * p2 - low * p0) * p * (ONE - p)
    records[n, Q] = (top * p2 - own * p1) * p * q * (ONE - q)


@njit(fastmath=FASTMATH)
def _view_gradients(records, first, end, of_colour, inverse, bands):
    """Turn the records of a ray into gradients: of shares' logits, colours' logits; and the parts, for the maps."""
    behind, none, count = np.float32(0.0), np.float32(0.0), len(bands)
    for n in range(end - 1, first - 1, -1):
        weight, towards, g0, g1, g2 = records[n, WEIGHT], none, none, none, none
        for c in range(count):
            colour, at = records[n, COLOUR + c], COLOUR + count + c
            towards += of_colour[c] * colour
            raw = weight * of_colour[c] * colour * (ONE - colour)
            g0 += raw * records[n, at]
            g1 += raw * records[n, at + count]
            g2 += raw * records[n, at + 2 * count]
            records[n, COLOUR + c] = raw
        of_optical = towards * records[n, BEHIND] - behind
        behind += weight * towards
        parts, _ = _parts(records, n)
        _logit_gradients(records, n, of_optical * records[n, LENGTH] * inverse, (g0, g1, g2))
        records[n, LOW], records[n, OWN], records[n, TOP] = parts


@spread(lambda *_: CHUNKS)
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def go_back(of_seen, visible, softness, records, counts, samples, bands, first_chunk, end_chunk):
    """Turn the records of `follow` into gradients, from those of colours and visibility; samples: of either ray."""
    none, inverse = np.float32(0.0), ONE / softness
    for chunk in range(first_chunk, end_chunk):
        part = slice_of(chunk, len(counts))
        at, at_sun = part.start * samples[0], part.start * samples[1]
        for r in range(part.start, part.stop):
            _view_gradients(records[0], at, at + counts[r, 0], of_seen[0][r], inverse, bands)
            at += counts[r, 0]
            of_optical = -of_seen[1][r] * visible[r] * inverse
            for n in range(at_sun, at_sun + counts[r, 1]):
                _logit_gradients(records[1], n, of_optical * records[1][n, LENGTH], (none, none, none))
            at_sun += counts[r, 1]


@njit(fastmath=FASTMATH, cache=True, nogil=True)
def add_shares(records, ends, frame, sizes, grad):
    """Add what records say of the logits of shares to their gradient [H W 2]; ends: of the chunks' records."""
    for chunk in range(len(ends)):
        for n in range(ends[chunk, 0], ends[chunk, 1]):
            at, steps, weights = _cell((records[n, X], records[n, Y]), frame, sizes)
            for corner in range(4):
                k = at + (steps[0] if corner & 2 else np.uintp(0)) + (steps[1] if corner & 1 else np.uintp(0))
                grad[k] += records[n, P] * weights[corner]
                grad[k + np.uintp(1)] += records[n, Q] * weights[corner]


@njit(fastmath=FASTMATH, forceinline=True)
def _mark(touched, first, width):
    """Mark the blocks of so many values from `first` on."""
    touched[first // np.uintp(BLOCK)] = touched[(first + np.uintp(width - 1)) // np.uintp(BLOCK)] = 1


@njit(fastmath=FASTMATH, cache=True, nogil=True)
def add_colours(records, ends, frame, sizes, grad, touched, bands):
    """Add what records say of the colours of columns to their gradient [H W 3 C], and mark its blocks."""
    count, none = np.uintp(len(bands)), np.uintp(0)
    for chunk in range(len(ends)):
        for n in range(ends[chunk, 0], ends[chunk, 1]):
            at, steps, weights = _cell((records[n, X], records[n, Y]), frame, sizes)
            for corner in range(4):
                k = at + (steps[0] if corner & 2 else none) + (steps[1] if corner & 1 else none)
                _mark(touched, k, 3 * len(bands))
                w = weights[corner]
                low, own, top = records[n, LOW] * w, records[n, OWN] * w, records[n, TOP] * w
                for c in range(len(bands)):
                    raw, i = records[n, COLOUR + c], k + np.uintp(c)
                    grad[i] += low * raw
                    grad[i + count] += own * raw
                    grad[i + count + count] += top * raw


@njit(fastmath=FASTMATH, cache=True, nogil=True)
def add_volume(records, ends, frame, sizes, grad, touched, bands):
    """Add what records say of a volume of colours to its gradient [D H W C], and mark its blocks."""
    none = np.uintp(0)
    for chunk in range(len(ends)):
        for n in range(ends[chunk, 0], ends[chunk, 1]):
            at, steps, weights = _cell_within((records[n, X], records[n, Y], records[n, Z]), frame, sizes)
            for corner in range(8):
                k = at + (steps[0] if corner & 4 else none) + (steps[1] if corner & 2 else none)
                k += steps[2] if corner & 1 else none
                _mark(touched, k, len(bands))
                for c in range(len(bands)):
                    grad[k + np.uintp(c)] += weights[corner] * records[n, COLOUR + c]


@njit(cache=True, nogil=True)
def clear(values, touched):
    """Zeros in all blocks that are marked."""
    for block in range(len(touched)):
        if touched[block]:
            values[block * BLOCK : (block + 1) * BLOCK] = 0


__all__ = ["BLOCK", "COLOUR", "SUN_RECORD", "add_colours", "add_shares", "add_volume", "clear", "follow", "go_back"]

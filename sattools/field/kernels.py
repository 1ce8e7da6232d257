"""Compiled CPU kernels of the neural field (`sattools.field.neural` holds the readable twin).

Maps lie with their values side by side, ``[H, W, K]``, volumes ``[D, H, W, K]``, so that a point reads whole lines.
Points are in metres, a frame takes them to cells: western edge, columns per metre, northern edge, rows per metre, and
for volumes lowest height, layers per metre. Where a column can have nothing at a height nothing is computed there: most
samples of a ray are in empty space. Gradients are summed in `CHUNKS` parts, whatever the number of threads, so that
they are the same each time; in one where a volume is so large that zeros and sums would cost more than points.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sattools.compiled import FASTMATH, njit, spread
from sattools.field.protocol import Box

EMPTY = (
    9.0  # softness lengths above its high height from which a column is empty: exp(-9) of its optical depth is there
)
FAR = 30.0  # argument beyond which a logistic function is at its end
LARGE = 4_000_000  # values of a volume, above which one part has to do
CHUNKS = 4  # parts of the points, each with gradients of its own
LEAST = 1e-12  # density at which parts still have a meaning
ONE = np.float32(1.0)


def runs_here(points: Tensor, *others: Tensor) -> bool:
    """Whether the kernels can take these: single precision on the CPU, points that no gradient is asked of."""
    mine = all(t.dtype == torch.float32 and t.device.type == "cpu" for t in (points, *others))
    return mine and not points.requires_grad


def frame_of(box: Box, rows: int, cols: int) -> np.ndarray:
    """What `place` needs: western edge [m], columns per metre, northern edge [m], rows per metre."""
    (west, south, _), (east, north, _) = box.low, box.high
    return np.array([west, cols / (east - west), north, rows / (north - south)], np.float32)


def frame_within(box: Box, shape: tuple[int, ...]) -> np.ndarray:
    """The same for volumes ``[D, H, W]`` whose outermost values lie on the box, and of the lowest height."""
    (west, south, bottom), (east, north, top) = box.low, box.high
    steps = [max(n - 1, 0) for n in shape]
    scale = [steps[2] / (east - west), steps[1] / (north - south), steps[0] / (top - bottom)]
    return np.array([west, scale[0], north, scale[1], bottom, scale[2]], np.float32)


@njit
def slice_of(chunk, count, chunks=CHUNKS):
    """Which of `count` points a chunk has."""
    return slice(chunk * count // chunks, (chunk + 1) * count // chunks)


@njit(fastmath=FASTMATH)
def between(x, count):
    """Lower and upper of the two places that x lies between, and its share of the way; clamped to the ends."""
    x = min(max(x, np.float32(0.0)), np.float32(count - 1))
    low = min(int(x), max(count - 2, 0))
    return low, min(low + 1, count - 1), x - np.float32(low)


@njit(fastmath=FASTMATH)
def sigmoid(x):
    """Logistic function; its ends are cut off, where numbers would become too small to compute fast with."""
    x = min(max(x, np.float32(-FAR)), np.float32(FAR))
    return ONE / (ONE + np.float32(math.exp(-x)))


@njit(fastmath=FASTMATH)
def read_map(maps, k, at, weights):
    """Bilinear value of map k."""
    top, bottom, left, right = at
    a, b, c, d = weights
    return maps[top, left, k] * a + maps[top, right, k] * b + maps[bottom, left, k] * c + maps[bottom, right, k] * d


@njit(fastmath=FASTMATH)
def place(point, frame, maps):
    """Cells of maps that a point lies between, and their weights."""
    rows, cols = maps.shape[0], maps.shape[1]
    half = np.float32(0.5)
    left, right, fx = between((point[0] - frame[0]) * frame[1] - half, cols)
    top, bottom, fy = between((frame[2] - point[1]) * frame[3] - half, rows)
    weights = ((ONE - fx) * (ONE - fy), fx * (ONE - fy), (ONE - fx) * fy, fx * fy)
    return (top, bottom, left, right), weights


@njit(fastmath=FASTMATH)
def _density_part(points, maps, frame, softness, sigma, parts):
    inverse, limit = ONE / softness, np.float32(EMPTY) * softness
    for n in range(points.shape[0]):
        at, weights = place(points[n], frame, maps)
        z, high = points[n, 2], read_map(maps, 2, at, weights)
        if z > high + limit:
            sigma[n] = parts[n, 0] = parts[n, 1] = parts[n, 2] = np.float32(0.0)
            continue
        a, b = sigmoid(read_map(maps, 3, at, weights)), sigmoid(read_map(maps, 4, at, weights))
        low = sigmoid((read_map(maps, 0, at, weights) - z) * inverse) * (ONE - a)
        own = sigmoid((read_map(maps, 1, at, weights) - z) * inverse) * (a - a * b)
        top = sigmoid((high - z) * inverse) * (a * b)
        total = low + own + top
        share = ONE / max(total, np.float32(LEAST))
        sigma[n] = total * inverse
        parts[n, 0], parts[n, 1], parts[n, 2] = low * share, own * share, top * share


@spread(lambda *_: CHUNKS)
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def density_at(points, maps, frame, softness, sigma, parts, first_chunk, end_chunk):
    """Density [1/m] and parts of the three heights, filled in; maps: three heights [m], two logits of shares."""
    for chunk in range(first_chunk, end_chunk):
        i = slice_of(chunk, len(points))
        _density_part(points[i], maps, frame, softness, sigma[i], parts[i])


@njit(fastmath=FASTMATH)
def _density_gradients_part(points, maps, frame, softness, grad_sigma, grad_parts, mine):
    inverse, limit = ONE / softness, np.float32(EMPTY) * softness
    for n in range(points.shape[0]):
        g0, g1, g2 = grad_parts[n, 0], grad_parts[n, 1], grad_parts[n, 2]
        if grad_sigma[n] == 0 and g0 == 0 and g1 == 0 and g2 == 0:
            continue
        at, weights = place(points[n], frame, maps)
        z, high = points[n, 2], read_map(maps, 2, at, weights)
        if z > high + limit:
            continue
        a, b = sigmoid(read_map(maps, 3, at, weights)), sigmoid(read_map(maps, 4, at, weights))
        low = sigmoid((read_map(maps, 0, at, weights) - z) * inverse)
        own = sigmoid((read_map(maps, 1, at, weights) - z) * inverse)
        top = sigmoid((high - z) * inverse)
        total = low * (ONE - a) + own * (a - a * b) + top * (a * b)
        share = ONE / max(total, np.float32(LEAST))
        mean = np.float32(0.0)
        if total > np.float32(LEAST):
            mean = (g0 * low * (ONE - a) + g1 * own * (a - a * b) + g2 * top * (a * b)) * share
        common = grad_sigma[n] * inverse - mean * share
        p0, p1, p2 = common + g0 * share, common + g1 * share, common + g2 * share
        first = (own * (ONE - b) * p1 + top * b * p2 - low * p0) * a * (ONE - a)
        second = (top * p2 - own * p1) * a * b * (ONE - b)
        for corner in range(4):
            cell = mine[at[corner // 2], at[2 + corner % 2]]
            cell[0] += first * weights[corner]
            cell[1] += second * weights[corner]


@spread(lambda *_: CHUNKS)
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def density_gradients(points, maps, frame, softness, grad_sigma, grad_parts, grads, first_chunk, end_chunk):
    """Gradients of the two logits, added to `grads` [CHUNKS, H, W, 2]."""
    for chunk in range(first_chunk, end_chunk):
        i = slice_of(chunk, len(points))
        _density_gradients_part(points[i], maps, frame, softness, grad_sigma[i], grad_parts[i], grads[chunk])


@njit(fastmath=FASTMATH)
def place_within(point, frame, volume):
    """Cells of a volume that a point lies between, and its shares of the way."""
    depth, rows, cols = volume.shape[0], volume.shape[1], volume.shape[2]
    left, right, fx = between((point[0] - frame[0]) * frame[1], cols)
    top, bottom, fy = between((frame[2] - point[1]) * frame[3], rows)
    lower, upper, fz = between((point[2] - frame[4]) * frame[5], depth)
    return (lower, upper), (top, bottom), (left, right), (fz, fy, fx)


@njit(fastmath=FASTMATH)
def corner_weight(corner, share):
    """Weight of one of the eight corners (bits: depth, row, column)."""
    fz, fy, fx = share
    wz = fz if corner & 4 else ONE - fz
    wy = fy if corner & 2 else ONE - fy
    return wz * wy * (fx if corner & 1 else ONE - fx)


@njit(fastmath=FASTMATH)
def _add_maps(raw, features, at, weights, maps):
    """Add the logits of the three heights by their parts."""
    top, bottom, left, right = at
    a, b, c, d = maps[top, left], maps[top, right], maps[bottom, left], maps[bottom, right]
    bands = len(raw)
    for k in range(3):
        part = features[3 + k]
        wa, wb, wc, wd = weights[0] * part, weights[1] * part, weights[2] * part, weights[3] * part
        for i in range(bands):
            j = k * bands + i
            raw[i] += (a[j] * wa + b[j] * wb) + (c[j] * wc + d[j] * wd)


@njit(fastmath=FASTMATH)
def _add_volume(raw, depth, row, col, share, volume):
    """Add a volume's trilinear values."""
    for layer in range(2):
        wz = share[0] if layer else ONE - share[0]
        above, below = volume[depth[layer], row[0]], volume[depth[layer], row[1]]
        a, b, c, d = above[col[0]], above[col[1]], below[col[0]], below[col[1]]
        wb, wd = wz * (ONE - share[1]) * share[2], wz * share[1] * share[2]
        wa, wc = wz * (ONE - share[1]) - wb, wz * share[1] - wd
        for i in range(len(raw)):
            raw[i] += (a[i] * wa + b[i] * wb) + (c[i] * wc + d[i] * wd)


@njit(fastmath=FASTMATH)
def _colours_part(features, maps, frame, volumes, frames, colour):
    bands = colour.shape[1]
    raw = np.empty(bands, np.float32)
    for n in range(features.shape[0]):
        if features[n, 3] + features[n, 4] + features[n, 5] == 0:
            colour[n] = 0
            continue
        raw[:] = 0
        _add_maps(raw, features[n], *place(features[n], frame, maps), maps)
        for v in range(len(volumes)):
            _add_volume(raw, *place_within(features[n], frames[v], volumes[v]), volumes[v])
        for c in range(bands):
            colour[n, c] = sigmoid(raw[c])


@spread(lambda *_: CHUNKS)
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def colours_at(features, maps, frame, volumes, frames, colour, first_chunk, end_chunk):
    """Colours [N, C], filled in; 0 where features [N, 6] have no parts. Maps: logits of three heights, C each."""
    for chunk in range(first_chunk, end_chunk):
        i = slice_of(chunk, len(features))
        _colours_part(features[i], maps, frame, volumes, frames, colour[i])


@njit(fastmath=FASTMATH)
def _colour_gradients_part(features, maps, frame, colour, grad, mine, grad_features):
    bands = colour.shape[1]
    for n in range(features.shape[0]):
        if features[n, 3] + features[n, 4] + features[n, 5] == 0:
            grad[n] = 0
            continue
        some = np.float32(0.0)
        for c in range(bands):
            grad[n, c] *= colour[n, c] * (ONE - colour[n, c])
            some += abs(grad[n, c])
        if some == 0:
            continue
        at, weights = place(features[n], frame, maps)
        for corner in range(4):
            row, col, w = at[corner // 2], at[2 + corner % 2], weights[corner]
            cell, own = maps[row, col], mine[row, col]
            for k in range(3):
                part, total = features[n, 3 + k] * w, np.float32(0.0)
                for c in range(bands):
                    own[k * bands + c] += part * grad[n, c]
                    total += cell[k * bands + c] * grad[n, c]
                grad_features[n, 3 + k] += total * w


@spread(lambda *_: CHUNKS)
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def colour_gradients(features, maps, frame, colour, grad, grads, grad_features, first_chunk, end_chunk):
    """Gradients of maps (to `grads` [CHUNKS, H, W, 3 C]) and of parts; `grad` becomes that of the logits."""
    for chunk in range(first_chunk, end_chunk):
        i = slice_of(chunk, len(features))
        _colour_gradients_part(features[i], maps, frame, colour[i], grad[i], grads[chunk], grad_features[i])


@njit(fastmath=FASTMATH)
def _volume_gradients_part(features, grad, frame, mine):
    bands = grad.shape[1]
    for n in range(features.shape[0]):
        some = np.float32(0.0)
        for c in range(bands):
            some += abs(grad[n, c])
        if some == 0:
            continue
        depth, row, col, share = place_within(features[n], frame, mine)
        for corner in range(8):
            cell = mine[depth[corner >> 2], row[(corner >> 1) & 1], col[corner & 1]]
            w = corner_weight(corner, share)
            for c in range(bands):
                cell[c] += w * grad[n, c]


@spread(lambda features, grad, frame, grads: len(grads))
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def volume_gradients(features, grad, frame, grads, first_chunk, end_chunk):
    """Gradients of a volume, added to `grads` [parts, D, H, W, C]; `grad` [N, C] is that of the logits."""
    for chunk in range(first_chunk, end_chunk):
        i = slice_of(chunk, len(features), len(grads))
        _volume_gradients_part(features[i], grad[i], frame, grads[chunk])


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy())


def packed(maps: Tensor) -> np.ndarray:
    """Values ``[K, ...]`` side by side, ``[..., K]``."""
    return _array(maps.detach().movedim(0, -1).contiguous())


def _summed(grads: np.ndarray) -> Tensor:
    """Gradients ``[CHUNKS, ..., K]`` -> ``[K, ...]``."""
    return torch.from_numpy(grads.sum(axis=0) if len(grads) > 1 else grads[0]).movedim(-1, 0)


class Density(torch.autograd.Function):
    """Density and parts of points; gradients reach the logits of the shares ``[2, H, W]``."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor, heights: Tensor, points: Tensor, box: Box, softness: float) -> Any:
        """See `NeuralField.density`, with all of its units."""
        at, maps = _array(points), packed(torch.cat([heights, logits.detach()]))
        frame = frame_of(box, *logits.shape[1:])
        sigma, parts = np.empty(len(at), np.float32), np.empty((len(at), 3), np.float32)
        density_at(at, maps, frame, np.float32(softness), sigma, parts)
        ctx.kept = at, maps, frame, np.float32(softness)
        return torch.from_numpy(sigma), torch.from_numpy(parts)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        """Gradients of the logits, unitless."""
        at, maps, frame, softness = ctx.kept
        found = np.zeros((CHUNKS, *maps.shape[:2], 2), np.float32)
        density_gradients(at, maps, frame, softness, _array(grads[0]), _array(grads[1]), found)
        return _summed(found), None, None, None, None


class Colours(torch.autograd.Function):
    """Colours of points; gradients reach the parts among the features, and all that colours are kept in."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, colour: Tensor, box: Box, *volumes: Tensor) -> Any:
        """See `NeuralField.look`, unitless."""
        at, maps = _array(features), packed(colour)
        grids = tuple(packed(volume) for volume in volumes)
        frame, frames = frame_of(box, *colour.shape[1:]), tuple(frame_within(box, v.shape[:3]) for v in grids)
        shown = np.empty((len(at), volumes[0].shape[0]), np.float32)
        colours_at(at, maps, frame, grids, frames, shown)
        ctx.kept = at, maps, frame, shown, frames, [v.shape for v in grids]
        return torch.from_numpy(shown)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        """Gradients of features, colours and volumes, unitless."""
        at, maps, frame, shown, frames, shapes = ctx.kept
        grad, found = _array(grads[0]).copy(), np.zeros((CHUNKS, *maps.shape), np.float32)
        of_features = np.zeros_like(at)
        colour_gradients(at, maps, frame, shown, grad, found, of_features)
        of_volumes = []
        for shape, frame_v in zip(shapes, frames, strict=True):
            of_volume = np.zeros((1 if math.prod(shape) > LARGE else CHUNKS, *shape), np.float32)
            volume_gradients(at, grad, frame_v, of_volume)
            of_volumes.append(_summed(of_volume))
        return torch.from_numpy(of_features), _summed(found), None, *of_volumes


__all__ = [
    "CHUNKS",
    "EMPTY",
    "LEAST",
    "ONE",
    "Colours",
    "Density",
    "between",
    "frame_of",
    "frame_within",
    "packed",
    "runs_here",
    "sigmoid",
    "slice_of",
]

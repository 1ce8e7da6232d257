"""What the images show on average at every cell and height, compiled."""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import FASTMATH, njit, spread
from sattools.prior.matching.kernels import TILE, TILE_COLS


@njit(cache=True, fastmath=FASTMATH)
def _add_view(image, mask, clear, parallax, dz, row, col, hits, lowest_hit, hidden, total, weight):
    """Add what a view shows of a row of places, and how well it sees them (``clear``, or ``hidden``)."""
    n = total.shape[0]
    dr, dc = parallax[0] * dz, parallax[1] * dz
    iy, ix = math.floor(dr), math.floor(dc)
    fy, fx = np.float32(dr - iy), np.float32(dc - ix)
    gy, gx = np.float32(1) - fy, np.float32(1) - fx
    a, b, c, d = gy * gx, gy * fx, fy * gx, fy * fx
    upper = image[row + iy, col + ix : col + ix + n + 1]
    lower = image[row + iy + 1, col + ix : col + ix + n + 1]
    nr, nc = row + round(dr), col + round(dc)
    valid, hit = mask[nr, nc : nc + n], hits[nr, nc : nc + n]
    for j in range(n):
        seen = np.float32(valid[j]) * (clear if hit[j] <= lowest_hit else hidden)
        total[j] += seen * (a * upper[j] + b * upper[j + 1] + c * lower[j] + d * lower[j + 1])
        weight[j] += seen


@spread(lambda *arguments: arguments[-2].shape[0] * arguments[-2].shape[1])
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def mean_look(
    images, masks, view_weights, parallax, heights, z_ref, hit_heights, tolerance, hidden, margin, active, look,
    first_tile, end_tile,
):  # fmt: skip
    """Mean of what the views show of every place, each with the weight with which it sees the place.

    Args:
        images: ``[V, Hf, Wf]`` float32 on the frame.
        masks: ``[V, Hf, Wf]`` uint8, 1 = valid.
        view_weights: ``[V]`` float32, how much each view counts.
        parallax: ``[V, 2]`` float64 (row, column) cells per metre of height.
        heights: ``[D]`` float64 [m].
        z_ref: reference height of the frame [m].
        hit_heights: ``[V, Hf, Wf]`` float32 height at which the ray first meets the surface [m].
        tolerance: depth below it that still counts as seen [m].
        hidden: weight of a view from which the surface hides the place.
        margin: cells between the border of the frame and that of the grid.
        active: ``[h, w, D]`` bool, planes that are looked at in every tile of `TILE` x `TILE_COLS` cells.
        look: ``[H, D, W]`` float32, filled; 0 where no image shows the place, or nothing is looked at.
        first_tile: first tile, from `spread`.
        end_tile: the one after the last.
    """
    rows, depth, cols = look.shape
    weight = np.empty(TILE_COLS, np.float32)
    for t in range(first_tile, end_tile):
        i, j = t // active.shape[1], t % active.shape[1]
        left, right = j * TILE_COLS, min((j + 1) * TILE_COLS, cols)
        for row in range(i * TILE, min((i + 1) * TILE, rows)):
            for k in range(depth):
                mean, seen = look[row, k, left:right], weight[: right - left]
                mean[:] = 0
                if not active[i, j, k]:
                    continue
                seen[:] = 0
                for v in range(images.shape[0]):
                    _add_view(
                        images[v], masks[v], view_weights[v], parallax[v], heights[k] - z_ref, margin + row,
                        margin + left, hit_heights[v], np.float32(heights[k] + tolerance), hidden * view_weights[v],
                        mean, seen,
                    )  # fmt: skip
                for n in range(right - left):
                    mean[n] = mean[n] / seen[n] if seen[n] > 0 else np.float32(0)


__all__ = ["mean_look"]

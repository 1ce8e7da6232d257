"""The last fraction of a plane: where the images agree best just above and below the surface that has been found.

The semi-global aggregation draws heights towards its planes: to be on its neighbours' plane costs nothing, the next one
costs a jump, so the parabola through the aggregated costs has its minimum too near to the plane (the pixel locking of
Shimizu and Okutomi 2001). Here the agreement itself decides, on parallels of the surface instead of planes.
"""

from __future__ import annotations

import numpy as np

from sattools.compiled import njit, spread
from sattools.prior.matching.sweep import MatchTask, agreement
from sattools.prior.neighbours import relief
from sattools.prior.visibility.occlusion import Visibility

PARTS = 2  # of a plane's distance
REACH = 6  # cells around, of the same surface, whose agreement counts: single cells are noisy
SAME_M = 1.0  # heights this near belong to the same surface


def refine_subplane(task: MatchTask, visibility: Visibility, surface: np.ndarray) -> np.ndarray:
    """Smooth the surface's stairs and move every cell by up to one plane to where the images agree best.

    Args:
        task: what is matched; the frame's margin must allow for heights one and a half planes beyond the surface.
        visibility: what is occluded and shaded.
        surface: ``[H, W]`` heights [m].

    Returns:
        ``[H, W]`` float32 heights [m].
    """
    step, window = task.step, task.options.window
    smooth = np.empty(surface.shape, np.float32)
    same_m = SAME_M * relief(task.frame.cell)
    local_planes(surface, same_m, smooth)
    np.clip(smooth, surface - step / 2, surface + step / 2, out=smooth)  # stairs are no higher, and the margin ends
    offsets = np.arange(-PARTS, PARTS + 1) * (step / PARTS)
    base = np.pad(smooth, window, mode="edge")
    volume = agreement(task, visibility, offsets, base)
    refined = np.empty_like(smooth)
    best_nearby(volume, smooth, offsets, same_m, refined)
    return refined


@njit(inline="always")
def _overlap(cols, right):
    """First and last (exclusive) column whose neighbour so far to the right is on the grid."""
    return max(0, -right), min(cols, cols - right)


@njit(cache=True)
def _add_neighbours(here, there, down, right, same_m, sums):
    """Add neighbours on the same surface to the nine sums of a row's least-squares planes ``[9, W]``."""
    y, x = np.float64(down), np.float64(right)
    n, sx, sy, sz, sxx, sxy, syy, sxz, syz = sums
    for col in range(here.shape[0]):
        z = there[col] - here[col]
        same = 1.0 if abs(z) <= same_m else 0.0
        n[col] += same
        sx[col] += same * x
        sy[col] += same * y
        sz[col] += same * z
        sxx[col] += same * (x * x)
        sxy[col] += same * (x * y)
        syy[col] += same * (y * y)
        sxz[col] += same * (x * z)
        syz[col] += same * (y * z)


@spread(lambda surface, *_: len(surface))
@njit(cache=True, nogil=True)
def local_planes(surface, same_m, smooth, first_row, end_row):
    """Height of the least-squares plane through the neighbours on the same surface, so that stairs become slopes.

    Args:
        surface: ``[H, W]`` float32 heights [m].
        same_m: heights this near belong to the same surface [m].
        smooth: the same, filled.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    rows, cols = surface.shape
    for row in range(first_row, end_row):
        sums = np.zeros((9, cols))
        for i in range(max(0, row - REACH), min(rows, row + REACH + 1)):
            for right in range(-REACH, REACH + 1):
                first, last = _overlap(cols, right)
                if first < last:
                    here, there = surface[row, first:last], surface[i, first + right : last + right]
                    _add_neighbours(here, there, i - row, right, same_m, sums[:, first:last])
        for col in range(cols):
            n, sx, sy, sz, sxx, sxy, syy, sxz, syz = sums[:, col]
            # Cramer's rule for the constant term; on a line of cells no plane is determined
            minor_c = sxx * syy - sxy * sxy
            minor_x = sx * syy - sxy * sy
            minor_y = sx * sxy - sxx * sy
            det = n * minor_c - sx * minor_x + sy * minor_y
            flat = det > 1e-6 * n * n * n
            offset = (sz * minor_c - sxz * minor_x + syz * minor_y) / det if flat else 0.0
            smooth[row, col] = surface[row, col] + offset


@njit(cache=True)
def _add_votes(here, there, agreement, same_m, same, votes):
    """Add the agreement ``[D, W]`` of neighbours on the same surface to the votes ``[D, W]`` of a row.

    same: ``[W]`` scratch, filled with 1 where they are, else 0.
    """
    for col in range(same.shape[0]):
        same[col] = np.float32(1) if abs(there[col] - here[col]) <= same_m else np.float32(0)
    for k in range(votes.shape[0]):
        row, sums = agreement[k], votes[k]
        for col in range(same.shape[0]):
            sums[col] += row[col] * same[col]


@spread(lambda volume, *_: len(volume))
@njit(cache=True, nogil=True)
def best_nearby(volume, surface, offsets, same_m, refined, first_row, end_row):
    """Height of the best agreement summed over the neighbours on the same surface, refined by a parabola.

    Args:
        volume: ``[H, D, W]`` float32 agreements.
        surface: ``[H, W]`` float32 heights [m].
        offsets: ``[D]`` float64 from the surface, evenly spaced, the middle one 0 [m].
        same_m: heights this near belong to the same surface [m].
        refined: ``[H, W]`` float32 heights, filled [m].
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    rows, depth, cols = volume.shape
    step = offsets[1] - offsets[0]
    for row in range(first_row, end_row):
        votes, same = np.zeros((depth, cols), np.float32), np.empty(cols, np.float32)
        for i in range(max(0, row - REACH), min(rows, row + REACH + 1)):
            for right in range(-REACH, REACH + 1):
                first, last = _overlap(cols, right)
                if first < last:
                    there = slice(first + right, last + right)
                    _add_votes(
                        surface[row, first:last], surface[i, there], volume[i, :, there], same_m, same[first:last],
                        votes[:, first:last],
                    )  # fmt: skip
        for col in range(cols):
            best = depth // 2  # stays where nothing speaks for another height
            for k in range(depth):
                if votes[k, col] > votes[best, col]:
                    best = k
            z = surface[row, col] + offsets[best]
            if 0 < best < depth - 1:
                bend = 2 * votes[best, col] - votes[best - 1, col] - votes[best + 1, col]
                if bend > 0:
                    z += step * 0.5 * (votes[best + 1, col] - votes[best - 1, col]) / bend
            refined[row, col] = z


__all__ = ["best_nearby", "local_planes", "refine_subplane"]

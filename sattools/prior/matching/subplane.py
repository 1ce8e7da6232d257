"""The last fraction of a plane: where the images agree best just above and below the surface that has been found.

The semi-global aggregation draws heights towards its planes: to be on its neighbours' plane costs nothing, the next one
costs a jump, so the parabola through the aggregated costs has its minimum too near to the plane (the pixel locking of
Shimizu and Okutomi 2001). Here the agreement itself decides, on parallels of the surface instead of planes.
"""

from __future__ import annotations

import numpy as np

from sattools.compiled import njit, prange
from sattools.prior.matching.sweep import MatchTask, agreement
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
    local_planes(surface, smooth)
    np.clip(smooth, surface - step / 2, surface + step / 2, out=smooth)  # stairs are no higher, and the margin ends
    offsets = np.arange(-PARTS, PARTS + 1) * (step / PARTS)
    base = np.pad(smooth, window, mode="edge")
    volume = agreement(task, visibility, offsets, base)
    refined = np.empty_like(smooth)
    best_nearby(volume, smooth, offsets, refined)
    return refined


@njit(parallel=True, cache=True)
def local_planes(surface, smooth):
    """Height of the least-squares plane through the neighbours on the same surface, so that stairs become slopes.

    Args:
        surface: ``[H, W]`` float32 heights [m].
        smooth: the same, filled.
    """
    rows, cols = surface.shape
    for row in prange(rows):
        for col in range(cols):
            here = surface[row, col]
            n = sx = sy = sz = sxx = sxy = syy = sxz = syz = 0.0
            for i in range(max(0, row - REACH), min(rows, row + REACH + 1)):
                for j in range(max(0, col - REACH), min(cols, col + REACH + 1)):
                    z = surface[i, j] - here
                    if abs(z) <= SAME_M:
                        y, x = i - row, j - col
                        n += 1
                        sx += x
                        sy += y
                        sz += z
                        sxx += x * x
                        sxy += x * y
                        syy += y * y
                        sxz += x * z
                        syz += y * z
            # Cramer's rule for the constant term; on a line of cells no plane is determined
            minor_c = sxx * syy - sxy * sxy
            minor_x = sx * syy - sxy * sy
            minor_y = sx * sxy - sxx * sy
            det = n * minor_c - sx * minor_x + sy * minor_y
            flat = det > 1e-6 * n * n * n
            smooth[row, col] = here + ((sz * minor_c - sxz * minor_x + syz * minor_y) / det if flat else 0.0)


@njit(parallel=True, cache=True)
def best_nearby(volume, surface, offsets, refined):
    """Height of the best agreement summed over the neighbours on the same surface, refined by a parabola.

    Args:
        volume: ``[H, W, D]`` float32 agreements.
        surface: ``[H, W]`` float32 heights [m].
        offsets: ``[D]`` float64 from the surface, evenly spaced, the middle one 0 [m].
        refined: ``[H, W]`` float32 heights, filled [m].
    """
    rows, cols, depth = volume.shape
    step = offsets[1] - offsets[0]
    for row in prange(rows):
        votes = np.empty(depth)
        for col in range(cols):
            here = surface[row, col]
            votes[:] = 0
            for i in range(max(0, row - REACH), min(rows, row + REACH + 1)):
                for j in range(max(0, col - REACH), min(cols, col + REACH + 1)):
                    if abs(surface[i, j] - here) <= SAME_M:
                        for k in range(depth):
                            votes[k] += volume[i, j, k]
            best = depth // 2  # stays where nothing speaks for another height
            for k in range(depth):
                if votes[k] > votes[best]:
                    best = k
            z = here + offsets[best]
            if 0 < best < depth - 1:
                bend = 2 * votes[best] - votes[best - 1] - votes[best + 1]
                if bend > 0:
                    z += step * 0.5 * (votes[best + 1] - votes[best - 1]) / bend
            refined[row, col] = z


__all__ = ["best_nearby", "local_planes", "refine_subplane"]

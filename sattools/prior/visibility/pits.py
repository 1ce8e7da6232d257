"""Pits in roofs that are none: where the roof would go on as well as it is.

Glare lies across a roof as a band, at another place in every view, and along the band all is alike: a hole below it,
which fewer views see, agrees better than the roof does. The places are found by their shape, a pit that what stands
around it nearly closes, and closed where the views agree about the roof across it nearly as well as about the roof
around. In a courtyard or a street they would not, and what they show there is dark (see `courtyards`).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening, find_objects, label

from sattools.prior.matching.sweep import MatchTask, agreement
from sattools.prior.visibility.occlusion import Visibility, at_surface, erode

REACH_M = 4.0  # pits up to twice as wide are looked at
DEPTH_M = 4.0  # and that deep, at least
LEVEL_M = 2.0  # below the roof that is still of it
AROUND = 2  # cells of the ring around a pit
CLOSED = 0.5  # of that ring is roof
WORSE = 0.09  # by how much the views may agree less about the roof across the pit
DARK = 0.2  # of the views that show it as dark as shadow, at most
NEAR_M = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])  # from the roof as it is drawn across, where it may be in truth
ANY = np.ones((3, 3), bool)


def close_pits(task: MatchTask, visibility: Visibility, height: np.ndarray) -> np.ndarray:
    """The heights ``[H, W]`` [m] with the roof where it goes on across a pit.

    Args:
        task: what is matched.
        visibility: what is occluded and shaded.
        height: ``[H, W]`` [m].
    """
    frame, options = task.frame, task.options
    radius = round(REACH_M / frame.cell)
    closed = erode(-erode(-height, radius), radius)
    pits, count = label(binary_opening(closed - height > DEPTH_M, ANY))
    if not count:
        return height
    around = np.pad(closed, options.window, mode="edge")
    across = agreement(task, visibility, NEAR_M, around, _planes_at(pits > 0)).max(axis=1)
    value, seen = at_surface(frame, visibility.first_hit_height, closed, options.tolerance)
    dark = seen & (value < visibility.dark[:, None, None] + options.brightness / 2)
    dark_share = dark.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    result = height.copy()
    for number, found in enumerate(find_objects(pits), 1):
        box = tuple(slice(max(0, part.start - AROUND), part.stop + AROUND) for part in found)
        pit = pits[box] == number
        ring = binary_dilation(pit, ANY, AROUND) & ~pit
        roof = ring & (height[box] > np.median(closed[box][pit]) - LEVEL_M)
        goes_on = roof.sum() >= CLOSED * ring.sum() and dark_share[box][pit].mean() <= DARK
        if goes_on and across[box][pit].mean() >= across[box][roof].mean() - WORSE:
            result[box][pit] = closed[box][pit]
    return result


def _planes_at(pits: np.ndarray) -> np.ndarray:
    """Whether heights are looked at, ``[h, w, D]`` bool: in tiles of the kernel that hold a pit or what is around."""
    from sattools.prior.matching.kernels import TILE, TILE_COLS

    rows, cols = pits.shape
    tiles = -(-rows // TILE), -(-cols // TILE_COLS)
    whole = np.zeros((tiles[0] * TILE, tiles[1] * TILE_COLS), bool)
    whole[:rows, :cols] = binary_dilation(pits, ANY, AROUND)
    some = np.asarray(whole.reshape(tiles[0], TILE, tiles[1], TILE_COLS).any(axis=(1, 3)))
    return np.repeat(some[..., None], len(NEAR_M), axis=-1)


__all__ = ["close_pits"]

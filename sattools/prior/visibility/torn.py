"""Pieces of roofs that too few views agree about, and that go on at the height of the roof around them.

A glossy or plain roof looks different in every view, or like what lies below it. So in parts of it, as wide as rooms,
less than half of the views have their best place there (see `consistency`), and were these filled from the ground
around, a tower would lose a piece as deep as it is high; one of terraces, narrow and torn all over, most of what it is.
What smears a roof over the ground beside it goes on at the roof's height, too, but hangs on it along one side, and
hardly any view agrees about that.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening, find_objects, label

LOWER_M = 5.0  # by which filling a piece would lower it, at least
LEVEL_M = 2.0  # heights that differ by less are one roof,
ROUGH_M = 1.0  # unless their standard deviation is as large as that
SHARE = 0.25  # of the views that see a piece, in the mean over its cells, have their best place there
AROUND_M = 0.7  # width of the ring around a piece where its roof is looked for
ROOF = 0.2  # of that ring has the piece's height, whether it stands or not
FEWEST_CELLS = 9  # narrower and smaller pieces are rims
ANY = np.ones((3, 3), bool)


def pieces_of_roofs(height: np.ndarray, lowered: np.ndarray, share: np.ndarray, cell: float) -> np.ndarray:
    """Cells ``[H, W]`` bool that do not stand by themselves, but with the roof that they belong to.

    Args:
        height: ``[H, W]`` float32 as it was matched [m].
        lowered: ``[H, W]`` float32 the same, filled where it does not stand [m].
        share: ``[H, W]`` of the views that see a cell those that have their best place there.
        cell: edge of a cell [m].
    """
    result = np.zeros(height.shape, bool)
    fallen = height - lowered > LOWER_M
    pieces, _ = label(binary_opening(fallen, ANY))
    width = max(1, round(AROUND_M / cell))
    for number, found in enumerate(find_objects(pieces), 1):
        box = tuple(slice(max(0, part.start - width), part.stop + width) for part in found)
        piece = pieces[box] == number
        near = np.abs(height[box] - np.median(height[box][piece])) < LEVEL_M
        ring = binary_dilation(piece, ANY, width) & ~piece
        piece &= near
        if piece.sum() < FEWEST_CELLS or share[box][piece].mean() < SHARE or height[box][piece].std() >= ROUGH_M:
            continue
        if (ring & near).sum() >= ROOF * ring.sum():
            result[box] |= binary_dilation(piece, ANY) & near & fallen[box]
    return result


__all__ = ["pieces_of_roofs"]

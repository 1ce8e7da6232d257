"""Surface normals of a height map."""

from __future__ import annotations

import numpy as np

LEAST_ROWS = 16
STRIP_CELLS = 500_000  # at a time: intermediate results take thirty times the memory of the heights


def normals(height: np.ndarray, cell: float) -> np.ndarray:
    """Mean of the normals of the four triangles that a cell forms with its four neighbours, weighted by their area.

    The cross product of two edges of a triangle is its normal times twice its area, so the plain sum weights by area.
    A triangle with an unknown corner is left out.

    Args:
        height: ``[H, W]`` metres, row 0 = north; NaN = unknown.
        cell: edge of a cell [m].

    Returns:
        ``[3, H, W]`` float32 unit vectors (east, north, up); NaN where no triangle is known.
    """
    maps = np.empty((3, *height.shape), np.float32)
    strip = max(LEAST_ROWS, STRIP_CELLS // max(1, height.shape[1]))
    for row in range(0, len(height), strip):
        first, last = max(0, row - 1), min(len(height), row + strip + 1)
        maps[:, row : row + strip] = _normals(height[first:last], cell)[:, row - first : row - first + strip]
    return maps


def _normals(height: np.ndarray, cell: float) -> np.ndarray:
    wide = np.pad(height.astype(np.float64), 1, constant_values=np.nan)
    centre = wide[1:-1, 1:-1]
    around = {  # (east, north) -> rise towards that neighbour
        (1, 0): wide[1:-1, 2:] - centre,
        (0, 1): wide[:-2, 1:-1] - centre,
        (-1, 0): wide[1:-1, :-2] - centre,
        (0, -1): wide[2:, 1:-1] - centre,
    }
    corners = list(around.items())
    total = np.zeros((3, *height.shape))
    for ((e1, n1), rise1), ((e2, n2), rise2) in zip(corners, corners[1:] + corners[:1], strict=True):
        # edges (e1, n1, rise1) and (e2, n2, rise2), counterclockwise: their cross product points up
        cross = np.stack(
            [
                cell * (n1 * rise2 - n2 * rise1),
                cell * (e2 * rise1 - e1 * rise2),
                np.full(height.shape, cell * cell * (e1 * n2 - e2 * n1)),
            ]
        )
        total += np.where(np.isfinite(rise1 + rise2), cross, 0.0)
    length = np.linalg.norm(total, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(length > 0, total / length, np.nan).astype(np.float32)


__all__ = ["normals"]

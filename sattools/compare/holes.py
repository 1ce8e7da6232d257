"""Holes of a surface, filled with the nearest height."""

from __future__ import annotations

import numpy as np

from sattools.errors import InputError
from sattools.scene.stored import StoredMap, map_like, pieces

_BLOCK = 64  # columns that are passed over at once where none of them can be nearer
_HOLES = 1 << 14  # cells that are filled at a time


def fill_holes(predicted: np.ndarray) -> np.ndarray:
    """`predicted` [H, W] [m] with each NaN replaced by the nearest finite height; InputError if there is none."""
    if isinstance(predicted, StoredMap):
        return _fill_stored(predicted)
    holes = ~np.isfinite(predicted)
    if not holes.any():
        return predicted
    if holes.all():
        raise InputError("prediction: found no height at all, expected at least one")
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(holes, return_distances=False, return_indices=True)
    filled = predicted.copy()
    filled[holes] = predicted[rows[holes], columns[holes]]
    return filled


def _fill_stored(predicted: np.ndarray) -> np.ndarray:
    """`fill_holes` of a map of which some rows are held at a time.

    The nearest height within every column is known after looking down and up; the nearest of these is then looked for
    along the rows, from a hole outwards and as far as one could still be nearer.

    Args:
        predicted: ``[H, W]`` [m]; NaN = none.

    Raises:
        InputError: as `fill_holes`.
    """
    shape = (predicted.shape[0], predicted.shape[1])
    strips = list(pieces(shape))
    if all(np.isfinite(predicted[rows]).all() for rows in strips):
        return predicted
    above, way_up = map_like(predicted, shape, np.float32), map_like(predicted, shape, np.float32)
    value, way = np.full(shape[1], np.nan, np.float32), np.full(shape[1], np.inf, np.float32)
    for rows in strips:
        above[rows], way_up[rows] = _look_down(predicted[rows], value, way)
    if np.isinf(way).all():
        raise InputError("prediction: found no height at all, expected at least one")
    value, way = np.full(shape[1], np.nan, np.float32), np.full(shape[1], np.inf, np.float32)
    filled = map_like(predicted, shape, np.float32)
    for rows in reversed(strips):
        heights = predicted[rows].copy()
        below, way_down = (found[::-1] for found in _look_down(heights[::-1], value, way))
        nearer = way_down < way_up[rows]
        _along_rows(heights, np.where(nearer, below, above[rows]), np.where(nearer, way_down, way_up[rows]))
        filled[rows] = heights
    return filled


def _look_down(heights: np.ndarray, value: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest height at or above every cell, and the rows to it, which is infinite where there is none.

    Args:
        heights: ``[h, W]`` [m]; NaN = none.
        value: ``[W]`` of the row before, changed to that of the last one.
        way: ``[W]`` likewise.
    """
    nearest, rows = np.empty(heights.shape, np.float32), np.empty(heights.shape, np.float32)
    for row, own in enumerate(heights):
        known = np.isfinite(own)
        np.copyto(value, own, where=known)
        way += 1
        way[known] = 0
        nearest[row], rows[row] = value, way
    return nearest, rows


def _along_rows(heights: np.ndarray, nearest: np.ndarray, way: np.ndarray) -> None:
    """Fill holes of ``[h, W]`` heights with the nearest of their columns' nearest heights, ``way`` rows away."""
    width = heights.shape[1]
    count = -(-width // _BLOCK)
    square = np.full((len(heights), count * _BLOCK), np.inf)
    square[:, :width] = way.astype(np.float64) ** 2
    square = square.reshape(len(heights), count, _BLOCK)
    least = square.min(axis=2)
    rows, cols = np.nonzero(~np.isfinite(heights))
    for first in range(0, len(rows), _HOLES):
        row, col = rows[first : first + _HOLES], cols[first : first + _HOLES]
        heights[row, col] = nearest[row, _nearest_column(row, col, square, least)]


def _nearest_column(row: np.ndarray, col: np.ndarray, square: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Column ``[N]`` of the nearest height of every hole.

    Args:
        row: ``[N]`` of the holes.
        col: ``[N]`` of the holes.
        square: ``[h, B, 64]`` squared distance of every column's nearest height [cells].
        least: ``[h, B]`` the least of every block of columns.
    """
    best = np.full(len(row), np.inf)
    found = np.zeros(len(row), np.intp)
    own, within = np.divmod(col, _BLOCK)
    for away in range(least.shape[1]):
        reach = max(0, (away - 1) * _BLOCK + 1)
        if away and reach**2 > best.max():
            break
        for side in (-1, 1) if away else (0,):
            block = own + side * away
            gap = _gap(away, side, within)
            some = np.flatnonzero((block >= 0) & (block < least.shape[1]))
            bound = least[row[some], block[some]] + gap[some] ** 2
            # of equally near ones scipy takes the leftmost, and of these the uppermost
            closer = np.less if side > 0 else np.less_equal
            some = some[closer(bound, best[some])]
            if not some.size:
                continue
            there = block[some, None] * _BLOCK + np.arange(_BLOCK)
            squares = square[row[some], block[some]] + (there - col[some, None]) ** 2
            nearest = squares.argmin(axis=1)
            distance = squares[np.arange(len(some)), nearest]
            better = closer(distance, best[some])
            best[some[better]] = distance[better]
            found[some[better]] = there[np.arange(len(some)), nearest][better]
    return found


def _gap(away: int, side: int, within: np.ndarray) -> np.ndarray:
    """Columns ``[N]`` from a place in its block to the nearest one of the block so many to the left (-1) or right."""
    if not away:
        return np.zeros_like(within)
    return away * _BLOCK - within if side > 0 else within + 1 + (away - 1) * _BLOCK


__all__ = ["fill_holes"]

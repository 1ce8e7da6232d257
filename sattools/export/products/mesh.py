"""The surface as a mesh: few large faces where it is even, upright walls where it steps.

Every corner of a cell has one height for each group of cells around it that belong together: cells that differ by more
than a step are apart, and what stands between them is a wall. Squares of cells are joined as long as a plane through
their corners fits, and every face knows the corners of its neighbours along its edges, so that no crack is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sattools.compiled import njit

_STEP_M = 1.0  # height between neighbours from which it is a wall, and as much as 1.5 cells
_LEVELS = 8  # of joining: up to 256 cells along a side


@dataclass(frozen=True)
class Mesh:
    """Triangles over a grid.

    Attributes:
        vertices: ``[N, 3]`` float64: columns and rows of the grid's corner lattice, height [m].
        faces: ``[M, 3]`` int64, counter-clockwise seen from outside.
        walls: how many of the faces, the last ones, are walls.
    """

    vertices: np.ndarray
    faces: np.ndarray
    walls: int


def mesh_of(height: np.ndarray, cell: float, tolerance: float) -> Mesh:
    """The mesh of a height map.

    Args:
        height: ``[H, W]`` [m]; NaN = no surface.
        cell: edge of a cell [m].
        tolerance: by which faces may miss the corners of cells [m].
    """
    rows, cols = height.shape
    step = max(_STEP_M, 1.5 * cell)
    corners = _corner_heights(height.astype(np.float64), step)
    size = squares(corners, np.isfinite(height), tolerance)
    used, owner = np.zeros((rows + 1, cols + 1), np.bool_), np.full((rows, cols), -1, np.int64)
    _mark(size, used, owner)
    flat, walls = _faces(corners, size, used), _walls(corners, owner, used)
    points = np.concatenate([flat, walls])
    vertices, index = np.unique(np.round(points, 4).reshape(-1, 3), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Mesh(vertices, faces[proper], int(proper[len(flat) :].sum()))


@njit(cache=True)
def _corner_heights(height, step):
    """Heights ``[H, W, 4]`` [m] of every cell's corners: north-west, north-east, south-east, south-west."""
    rows, cols = height.shape
    corners = np.full((rows, cols, 4), np.nan)
    around = np.empty(4)
    group = np.empty(4, np.int64)
    for r in range(rows + 1):
        for c in range(cols + 1):
            # cells around the corner, clockwise from the north-west; neighbours in this order are neighbours
            for k in range(4):
                i, j = r - 1 + (1 if k >= 2 else 0), c - 1 + (1 if k in (1, 2) else 0)
                inside = 0 <= i < rows and 0 <= j < cols
                around[k] = height[i, j] if inside else np.nan
                group[k] = k
            for _ in range(2):
                for k in range(4):
                    n = (k + 1) % 4
                    if abs(around[k] - around[n]) < step:
                        low = min(group[k], group[n])
                        group[k], group[n] = low, low
            for k in range(4):
                if np.isnan(around[k]):
                    continue
                total, count = 0.0, 0
                for n in range(4):
                    if group[n] == group[k] and not np.isnan(around[n]):
                        total += around[n]
                        count += 1
                i, j = r - 1 + (1 if k >= 2 else 0), c - 1 + (1 if k in (1, 2) else 0)
                # the corner seen from the cell: south-east of the north-west one, and so on
                corners[i, j, (k + 2) % 4] = total / count
    return corners


def squares(corners: np.ndarray, known: np.ndarray, tolerance: float) -> np.ndarray:
    """Edge ``[H, W]`` in cells of the square that begins at a cell, 0 where none does.

    Args:
        corners: ``[H, W, 4]`` heights of the cells' corners [m].
        known: ``[H, W]`` bool, cells with a surface.
        tolerance: see `mesh_of` [m].
    """
    size = known.astype(np.int64)
    for level in range(1, _LEVELS + 1):
        if not _join(corners, size, 2**level, tolerance):
            break
    return size


@njit(cache=True)
def _join(corners, size, edge, tolerance):
    """Join squares of half the edge to squares of the edge [cells] where that fits; how many."""
    rows, cols = size.shape
    half = edge // 2
    joined = 0
    for r in range(0, rows - edge + 1, edge):
        for c in range(0, cols - edge + 1, edge):
            whole = size[r, c] == half and size[r + half, c] == half
            if not (whole and size[r, c + half] == half and size[r + half, c + half] == half):
                continue
            last = edge - 1
            nw, ne = corners[r, c, 0], corners[r, c + last, 1]
            se, sw = corners[r + last, c + last, 2], corners[r + last, c, 3]
            bend = abs(nw + se - ne - sw) / 4  # by which two triangles miss the bilinear surface of a saddle
            fits = bend <= tolerance
            for i in range(edge):
                for j in range(edge):
                    for k in range(4):
                        v = (i + (1 if k >= 2 else 0)) / edge
                        u = (j + (1 if k in (1, 2) else 0)) / edge
                        plane = (1 - v) * ((1 - u) * nw + u * ne) + v * ((1 - u) * sw + u * se)
                        if abs(corners[r + i, c + j, k] - plane) > tolerance - bend:
                            fits = False
                    # a wall within
                    if j < last and not _same(corners[r + i, c + j], corners[r + i, c + j + 1], 1, 0, 2, 3):
                        fits = False
                    if i < last and not _same(corners[r + i, c + j], corners[r + i + 1, c + j], 3, 0, 2, 1):
                        fits = False
                if not fits:
                    break
            if fits:
                size[r, c], size[r + half, c], size[r, c + half], size[r + half, c + half] = edge, 0, 0, 0
                joined += 1
    return joined


@njit(cache=True)
def _same(one, other, a, b, c, d):
    """Whether two neighbours share the heights of both corners between them."""
    return one[a] == other[b] and one[c] == other[d]


@njit(cache=True)
def _mark(size, used, owner):
    """Mark the corners of all squares, and the square that every cell is of."""
    rows, cols = size.shape
    for r in range(rows):
        for c in range(cols):
            s = size[r, c]
            if s > 0:
                used[r, c] = used[r + s, c] = used[r, c + s] = used[r + s, c + s] = True
                owner[r : r + s, c : c + s] = r * cols + c


@njit(cache=True)
def _faces(corners, size, used):
    """Triangles ``[M, 3, 3]`` (column, row, height) of all squares: fans around their middles."""
    rows, cols = size.shape
    found = []
    for r in range(rows):
        for c in range(cols):
            s = size[r, c]
            if s == 0:
                continue
            last = s - 1
            # the used corners along the edge, counter-clockwise seen from above (rows run south)
            ring = []
            for j in range(s):  # along the southern edge eastwards
                if used[r + s, c + j]:
                    ring.append((float(c + j), float(r + s), corners[r + last, c + j, 3]))
            for i in range(s):  # along the eastern edge northwards
                if used[r + s - i, c + s]:
                    ring.append((float(c + s), float(r + s - i), corners[r + last - i, c + last, 2]))
            for j in range(s):
                if used[r, c + s - j]:
                    ring.append((float(c + s - j), float(r), corners[r, c + last - j, 1]))
            for i in range(s):
                if used[r + i, c]:
                    ring.append((float(c), float(r + i), corners[r + i, c, 0]))
            count = len(ring)
            if count == 4:
                found.append((ring[0], ring[1], ring[2]))
                found.append((ring[0], ring[2], ring[3]))
                continue
            total = (
                corners[r, c, 0] + corners[r, c + last, 1] + corners[r + last, c + last, 2] + corners[r + last, c, 3]
            )
            middle = (c + 0.5 * s, r + 0.5 * s, total / 4)
            for k in range(count):
                found.append((middle, ring[k], ring[(k + 1) % count]))
    return _packed(found)


@njit(cache=True)
def _walls(corners, owner, used):
    """Triangles ``[M, 3, 3]`` (column, row, height) of the walls between neighbours of different heights."""
    rows, cols = owner.shape
    found = []
    for r in range(rows):  # between a cell and its eastern neighbour, from one used corner to the next
        for c in range(cols - 1):
            one, other = owner[r, c], owner[r, c + 1]
            if one >= 0 and other >= 0 and one != other and used[r, c + 1]:
                end = r
                while not used[end + 1, c + 1]:
                    end += 1
                west, east = (corners[r, c, 1], corners[end, c, 2]), (corners[r, c + 1, 0], corners[end, c + 1, 3])
                x, top, bottom = float(c + 1), float(r), float(end + 1)
                found.append(((x, top, west[0]), (x, bottom, west[1]), (x, bottom, east[1])))
                found.append(((x, top, west[0]), (x, bottom, east[1]), (x, top, east[0])))
    for r in range(rows - 1):
        for c in range(cols):
            one, other = owner[r, c], owner[r + 1, c]
            if one >= 0 and other >= 0 and one != other and used[r + 1, c]:
                end = c
                while not used[r + 1, end + 1]:
                    end += 1
                north, south = (corners[r, c, 3], corners[r, end, 2]), (corners[r + 1, c, 0], corners[r + 1, end, 1])
                y, left, right = float(r + 1), float(c), float(end + 1)
                found.append(((left, y, north[0]), (left, y, south[0]), (right, y, south[1])))
                found.append(((left, y, north[0]), (right, y, south[1]), (right, y, north[1])))
    return _packed(found)


@njit(cache=True)
def _packed(found):
    """Triangles as an array ``[M, 3, 3]``."""
    out = np.empty((len(found), 3, 3))
    for k in range(len(found)):
        for v in range(3):
            for d in range(3):
                out[k, v, d] = found[k][v][d]
    return out


__all__ = ["Mesh", "mesh_of", "squares"]

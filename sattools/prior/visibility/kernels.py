"""Compiled kernels of visibility: what a line of sight or a ray from the sun meets first."""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import FASTMATH, njit, spread

NO_SHADE = np.float32(-1e9)


@spread(lambda surface, parallax, *_: len(parallax) * len(surface))
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def first_hit_heights(surface, parallax, z_ref, z_top, z_bottom, first_hit_height, first, end):
    """Height at which the ray through every frame position of every view first meets the surface.

    Args:
        surface: ``[Hf, Wf]`` float32 heights on the frame [m].
        parallax: ``[V, 2]`` float64 (row, column) cells per metre of height.
        z_ref: reference height of the frame [m].
        z_top: where rays start and end [m].
        z_bottom: where rays start and end [m].
        first_hit_height: ``[V, Hf, Wf]`` float32, filled.
        first: first row of a view, counted over all views, from `spread`.
        end: the one after the last.
    """
    rows, cols = surface.shape
    for piece in range(first, end):
        v, row = piece // rows, piece % rows
        # no step may jump over a cell
        step = 1.0 / max(abs(parallax[v, 0]), abs(parallax[v, 1]), 0.5)
        for col in range(cols):
            z = z_top
            hit = z_bottom
            while z > z_bottom:
                dz = z - z_ref
                r = round(row - parallax[v, 0] * dz)
                c = round(col - parallax[v, 1] * dz)
                if 0 <= r < rows and 0 <= c < cols and surface[r, c] >= z:
                    hit = min(surface[r, c], z + step)
                    break
                z -= step
            first_hit_height[v, row, col] = hit


@spread(lambda surface, bottom, *_: len(bottom))
@njit(cache=True, nogil=True)
def descend(surface, bottom, top, low, high, depth, where, first_row, end_row):
    """Follow lines of sight from above to the first cell of the surface that reaches them.

    Args:
        surface: ``[H, W]`` float32 heights [m]; -inf = unknown.
        bottom: ``[h, w, 2]`` float32 (row, column) cells where a line of sight is at height ``low``, ``high`` [m].
        top: ``[h, w, 2]`` float32 (row, column) cells where a line of sight is at height ``low``, ``high`` [m].
        low: lower height [m].
        high: upper height [m].
        depth: ``[h, w]`` float32, filled with the height met; NaN = none.
        where: ``[h, w, 2]`` int64, filled with the cell met; (0, 0) if none.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    rows, cols = surface.shape
    for i in range(first_row, end_row):
        for j in range(depth.shape[1]):
            r0, c0 = bottom[i, j, 0], bottom[i, j, 1]
            dr, dc = top[i, j, 0] - r0, top[i, j, 1] - c0
            # half a cell or half a metre a step, whichever is finer
            steps = math.ceil(2 * max(abs(dr), abs(dc), high - low)) + 1
            depth[i, j] = np.nan
            where[i, j, 0] = where[i, j, 1] = 0
            before = high
            for n in range(steps, -1, -1):
                share = n / steps
                z = low + share * (high - low)
                r, c = round(r0 + share * dr), round(c0 + share * dc)
                if 0 <= r < rows and 0 <= c < cols and surface[r, c] >= z:
                    # on a roof the height is the cell's, on a wall where the line of sight enters it
                    depth[i, j] = min(surface[r, c], before)
                    where[i, j, 0], where[i, j, 1] = r, c
                    break
                before = z


@spread(lambda surface, *_: len(surface))
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def shadow_heights(surface, sun, cell, top, shadow, first_row, end_row):
    """Height below which a point over each cell lies in the shadow of the other cells.

    Args:
        surface: ``[H, W]`` float32 heights [m]; beyond its border nothing casts a shadow.
        sun: ``[3]`` float64 (east, north, up) to the sun.
        cell: edge of a cell [m].
        top: highest surface [m].
        shadow: ``[H, W]`` float32, filled; far below the ground where the sun is free down to it.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    rows, cols = surface.shape
    flat = max(math.hypot(sun[0], sun[1]), 1e-9)
    row_step, col_step, rise = -sun[1] / flat, sun[0] / flat, sun[2] / flat * cell
    for row in range(first_row, end_row):
        for col in range(cols):
            best = NO_SHADE
            t = 1.0
            while top - t * rise > best:
                r, c = round(row + t * row_step), round(col + t * col_step)
                if r < 0 or c < 0 or r >= rows or c >= cols:
                    break
                best = max(best, np.float32(surface[r, c] - t * rise))
                t += 1.0
            shadow[row, col] = best


__all__ = ["descend", "first_hit_heights", "shadow_heights"]

"""Compiled kernels of visibility: what a line of sight or a ray from the sun meets first."""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import FASTMATH, njit, spread

NO_SHADE = np.float32(-1e9)
GOING = np.float32(3e38)  # what a ray has met that has met nothing yet
TOGETHER = 128  # neighbouring cells of a row whose rays are followed side by side


@njit(cache=True, fastmath=FASTMATH)
def _meet(heights, z, step, hit):
    """Rays at height z over these cells meet the ones that reach it; returns how many have met nothing yet."""
    going = np.int32(0)
    for j in range(heights.shape[0]):
        meets = (hit[j] == GOING) & (heights[j] >= z)
        hit[j] = min(heights[j], z + step) if meets else hit[j]
        going = np.int32(going + np.int32(hit[j] == GOING))
    return going


@spread(lambda surface, parallax, *_: len(parallax) * len(surface))
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def first_hit_heights(surface, parallax, z_ref, z_top, z_bottom, first_hit_height, first, end):
    """Height at which the ray through every frame position of every view first meets the surface.

    Rays of a row that start side by side stay so: a step moves all of them by the same number of cells.

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
        for begin in range(0, cols, TOGETHER):
            count = min(TOGETHER, cols - begin)
            hit = first_hit_height[v, row, begin : begin + count]
            hit[:] = GOING
            going, z = count, z_top
            while z > z_bottom and going > 0:
                r, right = row + round(-parallax[v, 0] * (z - z_ref)), round(-parallax[v, 1] * (z - z_ref))
                there, last = max(0, -begin - right), min(count, cols - begin - right)
                if 0 <= r < rows and there < last:
                    at = begin + right
                    met = _meet(surface[r, at + there : at + last], np.float32(z), np.float32(step), hit[there:last])
                    going = met if last - there == count else going
                z -= step
            for j in range(count):
                hit[j] = z_bottom if hit[j] == GOING else hit[j]


@spread(lambda images, *_: len(images))
@njit(cache=True, nogil=True)
def look_at(
    images, masks, parallax, z_ref, margin, first_hit_height, surface, tolerance, value, seen, first_view, end_view
):  # fmt: skip
    """What every view shows at a surface, in the nearest pixel, and whether it sees it.

    Args:
        images: ``[V, Hf, Wf]`` float32 on the frame.
        masks: ``[V, Hf, Wf]`` uint8, 1 = valid.
        parallax: ``[V, 2]`` float64 (row, column) cells per metre of height.
        z_ref: reference height of the frame [m].
        margin: cells between the border of the frame and that of the grid.
        first_hit_height: ``[V, Hf, Wf]`` float32 heights at which rays first meet the surface [m].
        surface: ``[H, W]`` float32 heights [m].
        tolerance: depth below the visible surface that still counts as seen [m].
        value: ``[V, H, W]`` float32, filled.
        seen: ``[V, H, W]`` bool, filled.
        first_view: first view, from `spread`.
        end_view: the one after the last.
    """
    rows, cols = surface.shape
    last_row, last_col = images.shape[1] - 1, images.shape[2] - 1
    for v in range(first_view, end_view):
        for row in range(rows):
            for col in range(cols):
                z = surface[row, col]
                dz = z - z_ref
                r = min(max(round(margin + row + parallax[v, 0] * dz), 0), last_row)
                c = min(max(round(margin + col + parallax[v, 1] * dz), 0), last_col)
                value[v, row, col] = images[v, r, c]
                seen[v, row, col] = masks[v, r, c] > 0 and first_hit_height[v, r, c] <= z + tolerance


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


@njit(cache=True, fastmath=FASTMATH)
def _shade(heights, fall, shadow):
    """The line from the sun over these cells, so much lower behind them; returns the lowest line so far."""
    least = GOING
    for j in range(heights.shape[0]):
        shadow[j] = max(shadow[j], heights[j] - fall)
        least = min(least, shadow[j])
    return least


@spread(lambda surface, *_: len(surface))
@njit(cache=True, fastmath=FASTMATH, nogil=True)
def shadow_heights(surface, sun, cell, top, bottom, shadow, first_row, end_row):
    """Height below which a point over each cell lies in the shadow of the other cells.

    Args:
        surface: ``[H, W]`` float32 heights [m]; beyond its border nothing casts a shadow.
        sun: ``[3]`` float64 (east, north, up) to the sun.
        cell: edge of a cell [m].
        top: highest surface [m].
        bottom: height below which nobody asks: where the sun is free down to it, the result may be too low [m].
        shadow: ``[H, W]`` float32, filled.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    rows, cols = surface.shape
    flat = max(math.hypot(sun[0], sun[1]), 1e-9)
    row_step, col_step, rise = -sun[1] / flat, sun[0] / flat, sun[2] / flat * cell
    for row in range(first_row, end_row):
        for begin in range(0, cols, TOGETHER):
            count = min(TOGETHER, cols - begin)
            shade = shadow[row, begin : begin + count]
            shade[:] = NO_SHADE
            t, least = 1.0, bottom
            while top - t * rise > least:
                r, right = row + round(t * row_step), round(t * col_step)
                there, last = max(0, -begin - right), min(count, cols - begin - right)
                if not 0 <= r < rows or there >= last:
                    break
                at = begin + right
                lowest = _shade(surface[r, at + there : at + last], np.float32(t * rise), shade[there:last])
                least = max(bottom, lowest)
                t += 1.0


__all__ = ["descend", "first_hit_heights", "look_at", "shadow_heights"]

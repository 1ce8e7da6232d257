"""Ray tracing of a `DetailedWorld`: `trace` with clumps of leaves, mirrors and facades of their own.

Clumps, windows and stains come from hashes of their place, so that every image shows the same ones; no ray depends on
another.
"""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import njit
from sattools.simulate.detailed import BALCONIES, GLASS, RIBBONS, WINDOWS
from sattools.simulate.trace import GAP_M, TOP, WALL_X, WALL_Y

LEAF = 3
CLUMP_M = 0.5  # edge of a clump of leaves
LEAF_GAP_M = 0.6  # a clump does not shade itself
SHININESS = 60.0  # exponent of the mirror lobe about the half vector (Blinn 1977)
LITTER = (0.13, 0.12, 0.09)  # reflectance of the ground under crowns
WALL_SKY = 0.4  # share of the sky that a wall sees

_jit = njit(cache=True, nogil=True, fastmath=False)


@_jit
def _hashed(a: int, b: int, c: int, d: int) -> float:
    """A number in [0, 1) that looks random and belongs to four integers."""
    n = (a * 374761393 + b * 668265263 + c * 2147483647 + d * 1274126177) & 0xFFFFFFFF
    n = ((n ^ (n >> 15)) * 2246822519) & 0xFFFFFFFF
    n = ((n ^ (n >> 13)) * 3266489917) & 0xFFFFFFFF
    n ^= n >> 16
    return n / 4294967296.0


@_jit
def _leaf_hit(
    base: float, top: float, share: float, cell: float, column: int, row: int, z: float, dz: float, t: float,
    t_end: float, t_first: float,
) -> float:  # fmt: skip
    """Where between `t` and `t_end` a ray through one cell meets a clump; negative = nowhere.

    Args:
        base: heights between which clumps are [m].
        top: heights between which clumps are [m].
        share: of the clumps that are filled.
        cell: edge of a cell [m].
        column: of the cell.
        row: of the cell.
        z: height at t = 0 [m].
        dz: metres that the ray rises per unit of t.
        t: where it enters the cell.
        t_end: where it leaves it.
        t_first: before which nothing counts.
    """
    across = max(1, round(CLUMP_M / cell))
    t = max(t, t_first)
    while t < t_end:
        here = z + dz * t
        layer = math.floor(here / CLUMP_M + (1e-6 if dz > 0 else -1e-6))
        edge = (layer + 1 if dz > 0 else layer) * CLUMP_M
        t_next = min(t_end, t + (edge - here) / dz) if dz != 0.0 else t_end
        if base <= here <= top and _hashed(column // across, row // across, layer, 7) < share:
            return t
        t = max(t_next, t + 1e-4)
    return -1.0


@_jit
def first_hit(
    height: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, crown_base: np.ndarray, crown_top: np.ndarray,
    foliage: np.ndarray, cell: float, x: float, y: float, z: float, dx: float, dy: float, dz: float, z_low: float,
    skip_first: bool, gap: float, z_high: float, t_leaf: float,
) -> tuple[float, int, int, int]:  # fmt: skip
    """`trace.first_hit` with clumps of leaves (face 3), which count from `t_leaf` on."""
    rows, columns = height.shape
    column, row = math.floor(x), math.floor(y)
    step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    delta_c = abs(1.0 / dx) if dx != 0.0 else np.inf
    delta_r = abs(1.0 / dy) if dy != 0.0 else np.inf
    next_c = ((column + 1 - x) if dx > 0 else (x - column)) * delta_c if dx != 0.0 else np.inf
    next_r = ((row + 1 - y) if dy > 0 else (y - row)) * delta_r if dy != 0.0 else np.inf
    t = 0.0
    face = TOP
    first = True
    while True:
        t_exit = min(next_c, next_r)
        c, r = min(max(column, 0), columns - 1), min(max(row, 0), rows - 1)
        t_end = t_exit if t_exit < 1e30 else t + 1e6
        hit, hit_face = -1.0, face
        if not (first and skip_first):
            h, sx, sy = height[r, c], slope_x[r, c] * cell, slope_y[r, c] * cell
            over_in = z + dz * t - h - sx * (x + dx * t - column - 0.5) - sy * (y + dy * t - row - 0.5)
            over_out = z + dz * t_end - h - sx * (x + dx * t_end - column - 0.5) - sy * (y + dy * t_end - row - 0.5)
            if over_in < -gap:
                return t, c, r, face
            if over_out < -gap:
                hit = t + (t_end - t) * over_in / (over_in - over_out) if over_in > 0 else t
                hit_face = TOP
        if crown_top[r, c] > crown_base[r, c]:
            base, top = crown_base[r, c], crown_top[r, c]
            until = hit if hit >= 0 else t_end
            high, low = max(z + dz * t, z + dz * until), min(z + dz * t, z + dz * until)
            if high >= base and low <= top:
                leaf = _leaf_hit(base, top, foliage[r, c], cell, column, row, z, dz, t, min(until, 1e6), t_leaf)
                if leaf >= 0:
                    return leaf, c, r, LEAF
        if hit >= 0:
            return hit, c, r, hit_face
        first = False
        z_next = z + dz * t_exit
        if (dz >= 0 and z_next > z_high) or (dz <= 0 and z_next < z_low) or t_exit > 1e7:
            return t_exit, column, row, -1
        t = t_exit
        if next_c < next_r:
            next_c += delta_c
            column += step_c
            face = WALL_X
        else:
            next_r += delta_r
            row += step_r
            face = WALL_Y


@_jit
def wall_look(
    style: int, building: int, side: int, along: float, below: float, view: int, band: int
) -> tuple[float, float]:
    """Factor on the reflectance of a wall at a place, and what it mirrors of the sky.

    Args:
        style: `detailed.PLAIN` ... `BALCONIES`.
        building: its number.
        side: 0 ... 3, which way the wall looks.
        along: place along the wall [m].
        below: metres below the top of the wall.
        view: number of the image: some panes flash in one of them alone.
        band: 0 ... 2.
    """
    tint = 0.6 + 0.8 * _hashed(building, side, 1, 3)
    tint *= 0.85 + 0.3 * _hashed(building, side, 2 + band, 3)
    stain = 0.88 + 0.24 * _hashed(math.floor(along / 0.9), math.floor(below / 0.7), building, 5)
    storey_m = 2.8 + 1.2 * _hashed(building, 1, 1, 11)
    bay_m = 1.8 + 2.7 * _hashed(building, 2, 2, 11)
    storey, bay = (below / storey_m) % 1.0, (along / bay_m) % 1.0
    pane = _hashed(math.floor(along / bay_m), math.floor(below / storey_m), building, 13)
    flash = (
        2.0
        if _hashed(math.floor(along / bay_m), math.floor(below / storey_m), building + 977 * view, 17) < 0.02
        else 0.0
    )
    glass = 0.1 + 0.5 * pane * pane, 0.15 + 0.5 * pane + flash
    if style == WINDOWS and 0.25 < storey < 0.75 and 0.2 < bay < 0.7:
        return glass
    if style == RIBBONS and 0.35 < storey < 0.85 and bay > 0.05:
        return glass
    if style == GLASS and storey > 0.08 and bay > 0.08:
        return 0.2 + 0.3 * pane, 0.5 + 0.5 * pane + flash
    if style == BALCONIES:
        if storey < 0.2:
            return 1.6 * stain, 0.0
        if storey < 0.7 and bay > 0.15:
            return 0.15 + 0.2 * pane, 0.1
    return tint * stain, 0.0


@_jit
def mirrored_sun(
    nx: float, ny: float, nz: float, sx: float, sy: float, sz: float, vx: float, vy: float, vz: float
) -> float:
    """Mirror lobe about the half vector of unit vectors to sun and sensor, 1 at its peak (Blinn 1977)."""
    hx, hy, hz = sx + vx, sy + vy, sz + vz
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    cosine = (nx * hx + ny * hy + nz * hz) / max(length, 1e-9)
    return max(cosine, 0.0) ** SHININESS


@_jit
def render(
    height: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, albedo: np.ndarray, wall_albedo: np.ndarray,
    windows: np.ndarray, building: np.ndarray, gloss: np.ndarray, crown_base: np.ndarray, crown_top: np.ndarray,
    foliage: np.ndarray, sky_share: np.ndarray, sky_stride: int, cell: float, turn: np.ndarray, centre: np.ndarray,
    origin: np.ndarray, velocity: np.ndarray, look: np.ndarray, across: np.ndarray, focal: float, col0: float,
    row0: float, shape: tuple[int, int], samples: int, sun: np.ndarray, sun_colour: np.ndarray, sky_colour: np.ndarray,
    z_low: float, z_high: float, view: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """As `trace.render`; `view` is the number of the image."""
    rows, columns = height.shape
    image = np.zeros((3, shape[0], shape[1]), np.float32)
    lit = np.zeros(shape, np.float32)
    surface = np.zeros(shape, np.float32)
    sun_x, sun_y = turn[0, 0] * sun[0] + turn[0, 1] * sun[1], turn[1, 0] * sun[0] + turn[1, 1] * sun[1]
    for row in range(shape[0]):
        for col in range(shape[1]):
            for k in range(samples * samples + 1):
                middle = k == samples * samples
                v = row + (0.0 if middle else (k // samples + 0.5) / samples - 0.5)
                u = col + (0.0 if middle else (k % samples + 0.5) / samples - 0.5)
                a = (u - col0) / focal
                de, dn, dz = look[0] + a * across[0], look[1] + a * across[1], look[2] + a * across[2]
                t0 = (z_high - origin[2] - (v - row0) * velocity[2]) / dz
                east = origin[0] + (v - row0) * velocity[0] + t0 * de - centre[0]
                north = origin[1] + (v - row0) * velocity[1] + t0 * dn - centre[1]
                x = (turn[0, 0] * east + turn[0, 1] * north) / cell + columns / 2
                y = (turn[1, 0] * east + turn[1, 1] * north) / cell + rows / 2
                dx, dy = turn[0, 0] * de + turn[0, 1] * dn, turn[1, 0] * de + turn[1, 1] * dn
                t, c, r, face = first_hit(
                    height, slope_x, slope_y, crown_base, crown_top, foliage, cell, x, y, z_high, dx / cell, dy / cell,
                    dz, z_low, False, 0.0, z_high + 1.0, 0.0,
                )  # fmt: skip
                hz = z_high + t * dz
                if middle:
                    surface[row, col] = hz
                    continue
                if face < 0:
                    continue
                hx, hy = x + t * dx / cell, y + t * dy / cell
                nx, ny, nz, sky, t_leaf = 0.0, 0.0, 1.0, WALL_SKY, 0.0
                if face == TOP:
                    norm = math.sqrt(slope_x[r, c] ** 2 + slope_y[r, c] ** 2 + 1.0)
                    nx, ny, nz = -slope_x[r, c] / norm, -slope_y[r, c] / norm, 1.0 / norm
                    sr = min(max(int(hy) // sky_stride, 0), sky_share.shape[0] - 1)
                    sc = min(max(int(hx) // sky_stride, 0), sky_share.shape[1] - 1)
                    sky = sky_share[sr, sc] * (1 + nz) / 2
                    hz += GAP_M
                elif face == WALL_X:
                    nx, nz = (-1.0 if dx > 0 else 1.0), 0.0
                    hx += nx * 1e-3
                elif face == WALL_Y:
                    ny, nz = (-1.0 if dy > 0 else 1.0), 0.0
                    hy += ny * 1e-3
                else:
                    t_leaf, sky = LEAF_GAP_M, 0.5
                cosine = nx * sun_x + ny * sun_y + nz * sun[2]
                if face == LEAF:  # leaves stand at all angles: their clump decides
                    clump = _hashed(int(hx * cell / CLUMP_M), int(hy * cell / CLUMP_M), math.floor(hz / CLUMP_M), 19)
                    cosine = 0.25 + 0.65 * clump
                direct = 0.0
                if cosine > 0:
                    blocked = first_hit(
                        height, slope_x, slope_y, crown_base, crown_top, foliage, cell, hx, hy, hz, sun_x / cell,
                        sun_y / cell, sun[2], z_low, face != LEAF, GAP_M, z_high, t_leaf,
                    )[3]  # fmt: skip
                    if blocked < 0:
                        direct = cosine
                        lit[row, col] += 1.0
                mirror = 0.0
                if face == TOP and direct > 0 and gloss[r, c] > 0:
                    mirror = gloss[r, c] * mirrored_sun(nx, ny, nz, sun_x, sun_y, sun[2], -dx, -dy, -dz)
                covered = face == TOP and crown_top[r, c] > crown_base[r, c]
                for b in range(3):
                    reflected = 0.0
                    if covered:
                        rho = LITTER[b]
                    elif face in (TOP, LEAF):
                        rho = albedo[r, c, b]
                    else:
                        along, below = (hy if face == WALL_X else hx) * cell, height[r, c] - hz
                        side = (0 if nx > 0 else 1) if face == WALL_X else (2 if ny > 0 else 3)
                        factor, reflected = wall_look(windows[r, c], building[r, c], side, along, below, view, b)
                        rho = factor * wall_albedo[r, c, b]
                    light = sun_colour[b] * direct + sky_colour[b] * sky
                    image[b, row, col] += rho * light + sun_colour[b] * mirror + reflected * sky_colour[b]
    image /= samples * samples
    lit /= samples * samples
    return image, lit, surface


__all__ = ["LEAF", "first_hit", "mirrored_sun", "render", "wall_look"]

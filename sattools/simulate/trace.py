"""Ray tracing of a `World` by walking its cells (Amanatides & Woo 1987); compiled with numba.

Nothing here is shared with the renderer of the fit, so that a fit can be tested against it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sattools.compiled import njit

TOP, WALL_X, WALL_Y = 0, 1, 2
GAP_M = 0.02  # plates of one surface may part by this much without casting a shadow
STOREY_M = 3.2
WINDOW_M = 2.6

_jit = njit(cache=True, nogil=True, fastmath=False)


@_jit
def first_hit(
    height: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, cell: float,
    x: float, y: float, z: float, dx: float, dy: float, dz: float, z_low: float, skip_first: bool,
    gap: float, z_high: float,
) -> tuple[float, int, int, int]:  # fmt: skip
    """First hit of the ray (x, y, z) + t (dx, dy, dz); x, y and dx, dy in cells, z and dz in metres.

    Returns (t, column, row, face), face = 0 top, 1 wall across columns, 2 wall across rows, -1 nothing hit. Beyond the
    raster its edge cells go on for ever. The walk ends above `z_high` when rising and below `z_low` when falling.
    `gap`: how deep the ray may dip under a plate before it counts; `skip_first` leaves out the cell it starts from.
    """
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
        if not (first and skip_first):
            c, r = min(max(column, 0), columns - 1), min(max(row, 0), rows - 1)
            t_end = t_exit if t_exit < 1e30 else t + 1e6  # a vertical ray never leaves its cell
            # height of the ray over the plate, linear between entry and exit
            h, sx, sy = height[r, c], slope_x[r, c] * cell, slope_y[r, c] * cell
            over_in = z + dz * t - h - sx * (x + dx * t - column - 0.5) - sy * (y + dy * t - row - 0.5)
            over_out = z + dz * t_end - h - sx * (x + dx * t_end - column - 0.5) - sy * (y + dy * t_end - row - 0.5)
            if over_in < -gap:
                return t, c, r, face
            if over_out < -gap:
                hit = t + (t_end - t) * over_in / (over_in - over_out) if over_in > 0 else t
                return hit, c, r, TOP
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
def sky_view(
    height: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, cell: float, stride: int, z_high: float
) -> np.ndarray:
    """Share of an isotropic sky that every `stride`-th cell sees, weighted by the cosine to the zenith."""
    rows, columns = height.shape[0] // stride, height.shape[1] // stride
    share = np.zeros((rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            row, column = r * stride + stride // 2, c * stride + stride // 2
            free = 0
            # rings of equal cosine-weighted solid angle: sin² of the zenith angle at 1/6, 1/2, 5/6
            for ring in range(3):
                sine = math.sqrt((2 * ring + 1) / 6.0)
                for k in range(8):
                    angle = (k + 0.25 + 0.5 * (ring % 2)) * math.pi / 4  # off the axes, where walls run
                    dx, dy = sine * math.cos(angle) / cell, sine * math.sin(angle) / cell
                    face = first_hit(
                        height, slope_x, slope_y, cell, column + 0.5, row + 0.5, height[row, column] + GAP_M,
                        dx, dy, math.sqrt(1 - sine * sine), -1e9, True, GAP_M, z_high,
                    )[3]  # fmt: skip
                    free += face < 0
            share[r, c] = free / 24
    return share


@_jit
def render(
    height: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, albedo: np.ndarray, wall_albedo: np.ndarray,
    windows: np.ndarray, sky_share: np.ndarray, sky_stride: int, cell: float, turn: np.ndarray, centre: np.ndarray,
    origin: np.ndarray, velocity: np.ndarray, look: np.ndarray, across: np.ndarray, focal: float, col0: float,
    row0: float, shape: tuple[int, int], samples: int, sun: np.ndarray, sun_colour: np.ndarray, sky_colour: np.ndarray,
    z_low: float, z_high: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Radiance [3, H, W], share of sunlit ground [H, W] and height hit by the pixel's middle [H, W] of one view.

    Camera: pixel (col, row) looks from `origin` + (row - row0) `velocity` along `look` + (col - col0) / focal `across`
    (easting, northing, height). Each pixel is the mean of `samples`² rays, which is the sensor's point spread.
    Sun: unit vector to it (east, north, up); Lambertian surfaces: albedo (sun n·s + sky share of visible sky).
    """
    rows, columns = height.shape
    image = np.zeros((3, shape[0], shape[1]), np.float32)
    lit = np.zeros(shape, np.float32)
    surface = np.zeros(shape, np.float32)
    sun_x = (turn[0, 0] * sun[0] + turn[0, 1] * sun[1]) / cell
    sun_y = (turn[1, 0] * sun[0] + turn[1, 1] * sun[1]) / cell
    for row in range(shape[0]):
        for col in range(shape[1]):
            for k in range(samples * samples + 1):
                middle = k == samples * samples
                v = row + (0.0 if middle else (k // samples + 0.5) / samples - 0.5)
                u = col + (0.0 if middle else (k % samples + 0.5) / samples - 0.5)
                a = (u - col0) / focal
                de = look[0] + a * across[0]
                dn = look[1] + a * across[1]
                dz = look[2] + a * across[2]
                # enter at the highest surface
                z = origin[2] + (v - row0) * velocity[2]
                t0 = (z_high - z) / dz
                east = origin[0] + (v - row0) * velocity[0] + t0 * de - centre[0]
                north = origin[1] + (v - row0) * velocity[1] + t0 * dn - centre[1]
                x = (turn[0, 0] * east + turn[0, 1] * north) / cell + columns / 2
                y = (turn[1, 0] * east + turn[1, 1] * north) / cell + rows / 2
                dx = (turn[0, 0] * de + turn[0, 1] * dn) / cell
                dy = (turn[1, 0] * de + turn[1, 1] * dn) / cell
                t, c, r, face = first_hit(
                    height, slope_x, slope_y, cell, x, y, z_high, dx, dy, dz, z_low, False, 0.0, z_high + 1.0
                )
                hz = z_high + t * dz
                if middle:
                    surface[row, col] = hz
                    continue
                if face < 0:
                    continue
                hx, hy = x + t * dx, y + t * dy
                # normal in (along columns, along rows, up)
                if face == TOP:
                    nx, ny, nz = -slope_x[r, c], -slope_y[r, c], 1.0
                    norm = math.sqrt(nx * nx + ny * ny + 1.0)
                    nx, ny, nz = nx / norm, ny / norm, nz / norm
                    sr = min(max(int(hy) // sky_stride, 0), sky_share.shape[0] - 1)
                    sc = min(max(int(hx) // sky_stride, 0), sky_share.shape[1] - 1)
                    sky = sky_share[sr, sc] * (1 + nz) / 2
                    hz += GAP_M
                else:
                    # the wall stands before the cell that was hit: step back out of it
                    if face == WALL_X:
                        nx, ny, nz = (-1.0 if dx > 0 else 1.0), 0.0, 0.0
                        hx += nx * 1e-3
                    else:
                        nx, ny, nz = 0.0, (-1.0 if dy > 0 else 1.0), 0.0
                        hy += ny * 1e-3
                    sky = 0.4
                cosine = (nx * sun_x + ny * sun_y) * cell + nz * sun[2]
                direct = 0.0
                if cosine > 0:
                    face_to_sun = first_hit(
                        height, slope_x, slope_y, cell, hx, hy, hz, sun_x, sun_y, sun[2],
                        z_low, True, GAP_M, z_high,
                    )[3]  # fmt: skip
                    if face_to_sun < 0:
                        direct = cosine
                        lit[row, col] += 1.0
                factor = 1.0
                if face != TOP and windows[r, c] == 1:
                    along = (hy if face == WALL_X else hx) * cell
                    storey = ((height[r, c] - hz) / STOREY_M) % 1.0
                    bay = (along / WINDOW_M) % 1.0
                    if 0.3 < storey < 0.8 and 0.2 < bay < 0.75:
                        factor = 0.35
                for b in range(3):
                    rho = albedo[r, c, b] if face == TOP else factor * wall_albedo[r, c, b]
                    image[b, row, col] += rho * (sun_colour[b] * direct + sky_colour[b] * sky)
    image /= samples * samples
    lit /= samples * samples
    return image, lit, surface


def sky_share(world: Any, stride: int) -> np.ndarray:
    """`sky_view` of a `World` on every `stride`-th cell."""
    return np.asarray(
        sky_view(world.height, world.slope_x, world.slope_y, world.cell_size, stride, float(world.height.max()) + 1.0)
    )

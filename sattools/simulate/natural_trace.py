"""Ray tracing of a `NaturalWorld`: one sun, sky light if given, reflectance of `sattools.simulate.brdf`."""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import njit
from sattools.simulate.brdf import radiance_factor
from sattools.simulate.trace import first_hit

GAP_SHARE = 0.12  # plates of a curved slope part by some centimetres: what dips less, in cells, casts no shadow


@njit(cache=True, nogil=True, fastmath=False)
def render_natural(
    height: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, amplitude: np.ndarray, parameters: np.ndarray,
    model: int, cell: float, centre: np.ndarray, origin: np.ndarray, velocity: np.ndarray, look: np.ndarray,
    across: np.ndarray, focal: float, col0: float, row0: float, shape: tuple[int, int], samples: int, sun: np.ndarray,
    z_low: float, z_high: float, sky: np.ndarray, sky_stride: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Reflectance factor pi L / E [3, H, W], share of sunlit ground [H, W] and height of the middle [H, W] of a view.

    E is the sun's irradiance on a plane across its beam, so a white Lambertian facet shows cos i. `sky` [h, w, 3] is
    what the sky adds to every `sky_stride`-th cell, over its amplitude; of no cells, shade is black.
    Camera and sampling as in `sattools.simulate.trace.render`; the raster's rows run south, its columns east.
    """
    rows, columns = height.shape
    image = np.zeros((3, shape[0], shape[1]), np.float32)
    lit = np.zeros(shape, np.float32)
    surface = np.zeros(shape, np.float32)
    gap = GAP_SHARE * cell
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
                z = origin[2] + (v - row0) * velocity[2]
                t0 = (z_high - z) / dz
                x = (origin[0] + (v - row0) * velocity[0] + t0 * de - centre[0]) / cell + columns / 2
                y = -(origin[1] + (v - row0) * velocity[1] + t0 * dn - centre[1]) / cell + rows / 2
                dx, dy = de / cell, -dn / cell
                t, c, r, face = first_hit(
                    height, slope_x, slope_y, cell, x, y, z_high, dx, dy, dz, z_low, False, 0.0, z_high + 1.0
                )
                hz = z_high + t * dz
                if middle:
                    surface[row, col] = hz
                    continue
                if face < 0:
                    continue
                if sky.size:
                    near_r, near_c = min(r // sky_stride, sky.shape[0] - 1), min(c // sky_stride, sky.shape[1] - 1)
                    for b in range(3):
                        image[b, row, col] += sky[near_r, near_c, b] * amplitude[r, c, b]
                # seams between plates count as the plate behind them
                ne, nn = -slope_x[r, c], slope_y[r, c]
                norm = math.sqrt(ne * ne + nn * nn + 1.0)
                ne, nn, nz = ne / norm, nn / norm, 1.0 / norm
                if ne * sun[0] + nn * sun[1] + nz * sun[2] <= 0.0:
                    continue
                blocked = first_hit(
                    height, slope_x, slope_y, cell, x + t * dx, y + t * dy, hz + gap, sun[0] / cell, -sun[1] / cell,
                    sun[2], z_low, True, gap, z_high,
                )[3]  # fmt: skip
                if blocked >= 0:
                    continue
                lit[row, col] += 1.0
                length = math.sqrt(de * de + dn * dn + dz * dz)
                for b in range(3):
                    image[b, row, col] += radiance_factor(
                        model, ne, nn, nz, sun[0], sun[1], sun[2], -de / length, -dn / length, -dz / length,
                        amplitude[r, c, b], parameters[r, c, 0], parameters[r, c, 1], parameters[r, c, 2],
                    )  # fmt: skip
    return image / (samples * samples), lit / (samples * samples), surface


__all__ = ["render_natural"]

"""Light of an even sky on natural ground: what every part of the surface sends of it towards a view."""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import njit
from sattools.simulate.brdf import radiance_factor
from sattools.simulate.trace import first_hit

STRIDE = 4  # cells of the world from one place to the next at which the sky is looked at; relief has 24 m at least
RINGS, SPOKES = 6, 12
GAP_SHARE = 0.12  # as for the sun's shadows
BANDS = (0.75, 1.0, 1.3)  # a clear sky is blue: its share in red, green, blue over that in green


def sky_directions() -> np.ndarray:
    """Directions ``[N, 4]``: unit vector (east, north, up) and solid angle over pi, which sum to 2.

    Midpoints of rings of equal solid angle; every other ring is turned by half a step.
    """
    rows = []
    for ring in range(RINGS):
        up = (ring + 0.5) / RINGS
        flat = math.sqrt(1 - up * up)
        for spoke in range(SPOKES):
            angle = (spoke + 0.5 * (ring % 2) + 0.25) * 2 * math.pi / SPOKES
            rows.append((flat * math.cos(angle), flat * math.sin(angle), up, 2.0 / (RINGS * SPOKES)))
    return np.array(rows)


@njit(cache=True, nogil=True, fastmath=False)
def open_sky(
    height: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, cell: float, directions: np.ndarray, stride: int,
    z_high: float,
) -> np.ndarray:  # fmt: skip
    """Whether every `stride`-th cell sees the sky in each direction, ``[H, W, N]`` uint8."""
    rows, columns = height.shape[0] // stride, height.shape[1] // stride
    seen = np.zeros((rows, columns, directions.shape[0]), np.uint8)
    gap = GAP_SHARE * cell
    for r in range(rows):
        for c in range(columns):
            row, column = r * stride + stride // 2, c * stride + stride // 2
            for k in range(directions.shape[0]):
                east, north, up = directions[k, 0], directions[k, 1], directions[k, 2]
                if up - slope_x[row, column] * east + slope_y[row, column] * north <= 0.0:
                    continue
                blocked = first_hit(
                    height, slope_x, slope_y, cell, column + 0.5, row + 0.5, height[row, column] + gap,
                    east / cell, -north / cell, up, -1e9, True, gap, z_high,
                )[3]  # fmt: skip
                seen[r, c, k] = blocked < 0
    return seen


@njit(cache=True, nogil=True, fastmath=False)
def sky_light(
    seen: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, amplitude: np.ndarray, parameters: np.ndarray,
    model: int, directions: np.ndarray, stride: int, view: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Light ``[H, W, 3]`` towards `view` over the cell's amplitude; the sky gives level ground an irradiance of 1."""
    rows, columns, _ = seen.shape
    light = np.zeros((rows, columns, 3), np.float32)
    for r in range(rows):
        for c in range(columns):
            row, column = r * stride + stride // 2, c * stride + stride // 2
            ne, nn = -slope_x[row, column], slope_y[row, column]
            norm = math.sqrt(ne * ne + nn * nn + 1.0)
            for b in range(3):
                own = amplitude[row, column, b]
                total = 0.0
                for k in range(directions.shape[0]):
                    if seen[r, c, k]:
                        total += directions[k, 3] * radiance_factor(
                            model, ne / norm, nn / norm, 1.0 / norm, directions[k, 0], directions[k, 1],
                            directions[k, 2], view[0], view[1], view[2], own, parameters[row, column, 0],
                            parameters[row, column, 1], parameters[row, column, 2],
                        )  # fmt: skip
                light[r, c, b] = total / max(own, 1e-6)
    return light


__all__ = ["BANDS", "STRIDE", "open_sky", "sky_directions", "sky_light"]

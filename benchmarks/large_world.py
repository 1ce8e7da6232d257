"""A city without end, for images of whole scenes: houses of `simulate`'s city, repeated, on rolling ground.

Rays are followed one by one through the surface, so that walls hide what is behind them; nothing larger than a strip of
an image is ever in memory.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

PERIOD_M = 512.0
CELL_M = 0.5
SUN = (145.28, 47.99)  # azimuth from north, elevation [degrees], at 15 E 46 N on `DATE`
DATE = "20260412093000"
SKY = 0.18  # share of the light that comes from the sky
STEP_M = 0.4  # of height, by which a ray is followed

Array = NDArray[np.float32]


class City:
    """Heights [m above the rolling ground] and brightness of a square that continues itself.

    Attributes:
        height: ``[N, N]`` [m], row 0 in the south.
        bright: ``[N, N]`` of what faces the sky, in the sun's light and shade.
        wall: brightness of walls.
    """

    def __init__(self, seed: int) -> None:
        from sattools.simulate.city import build_city

        rng = np.random.default_rng(seed)
        count = round(PERIOD_M / CELL_M)
        world = build_city((0.0, 0.0), PERIOD_M, CELL_M, 0.0, rng, rotation_deg=0.0, margin_m=0.0)
        self.height = np.ascontiguousarray(world.height[:count, :count][::-1])
        slope_x, slope_y = world.slope_x[:count, :count][::-1], -world.slope_y[:count, :count][::-1]
        azimuth, elevation = np.radians(SUN)
        sun = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
        facing = (sun[2] - slope_x * sun[0] - slope_y * sun[1]) / np.sqrt(1 + slope_x**2 + slope_y**2)
        lit = _lit(self.height, sun[:2] / sun[2])
        albedo = world.albedo[:count, :count].mean(axis=2)[::-1]
        self.bright = (albedo * (lit * np.maximum(facing, 0) * (1 - SKY) + SKY)).astype(np.float32)
        self.wall = 0.25 * SKY
        self.top = float(self.height.max())
        self.low = float(self.height.min())

    def above(self, east: NDArray[np.float64], north: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of the surface [m] above the reference height at local coordinates [m]."""
        count = len(self.height)
        col, row = (np.floor(v / CELL_M).astype(int) % count for v in (east, north))
        return np.asarray(rolling(east, north) + self.height[row, col])


def rolling(east: NDArray[np.float64], north: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the ground under the city [m], within 30 m of the reference."""
    return np.asarray(30.0 * np.sin(east / 700.0) * np.cos(north / 900.0))


@njit(cache=True, parallel=True)
def _lit(height: Array, run: NDArray[np.float64]) -> Array:
    """1 where the sun reaches a cell of the endless square, 0 in cast shadow."""
    count = height.shape[0]
    lit = np.ones((count, count), np.float32)
    top = height.max()
    for r in prange(count):
        for c in range(count):
            z = height[r, c] + 0.3
            while z < top:
                z += STEP_M
                along = z - height[r, c]
                cc = math.floor(c + 0.5 + run[0] * along / CELL_M) % count
                rr = math.floor(r + 0.5 + run[1] * along / CELL_M) % count
                if height[rr, cc] > z:
                    lit[r, c] = 0.0
                    break
    return lit


@njit(cache=True, parallel=True)
def look(
    height: Array, bright: Array, wall: float, limits: tuple[float, float], run: NDArray[np.float64],
    east0: NDArray[np.float64], north0: NDArray[np.float64],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """What rays see: brightness ``[H, W]``, and where they end (east, north) [m].

    Args:
        height: see `City`.
        bright: see `City`.
        wall: see `City`.
        limits: least and largest of `height`.
        run: (east, north) by which a ray moves per metre of height.
        east0: ``[W]`` of the columns at the reference height [m].
        north0: ``[H]`` of the rows.
    """
    rows, cols, count = len(north0), len(east0), height.shape[0]
    seen = np.empty((rows, cols), np.float32)
    at_east, at_north = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    for i in prange(rows):
        for j in range(cols):
            # where the ray meets the rolling ground; over the height of a house that is as good as level
            base = 0.0
            for _ in range(5):
                base = (
                    30.0 * math.sin((east0[j] + run[0] * base) / 700.0) * math.cos((north0[i] + run[1] * base) / 900.0)
                )
            z, value, e, n = limits[1] + 2.0, wall, 0.0, 0.0
            while z > limits[0] - 8.0:
                e, n = east0[j] + run[0] * (base + z), north0[i] + run[1] * (base + z)
                here = 30.0 * math.sin(e / 700.0) * math.cos(n / 900.0)
                c, r = math.floor(e / CELL_M) % count, math.floor(n / CELL_M) % count
                below = here - base + height[r, c] - z
                if below >= 0:
                    # deeper than a step below its top, a cell was entered through its wall
                    value = bright[r, c] if below < 2.0 * STEP_M else wall
                    break
                z -= STEP_M
            seen[i, j], at_east[i, j], at_north[i, j] = value, e, n
    return seen, at_east, at_north

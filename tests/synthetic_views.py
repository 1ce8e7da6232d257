"""Cameras and images with known geometry for tests: lines of sight are parallel, so answers are plain arithmetic.

A view with run t = (tx, ty) sees the ground point (east, north, height) at
    col = cx + (east - tx * height) / gsd,    row = cy - (north - ty * height) / gsd.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from sattools.camera import RPC

LON0, LAT0, ALT0 = 15.0, 46.0, 100.0  # on the central meridian of UTM zone 33
_E2 = 6.69437999014e-3
_W2 = 1 - _E2 * math.sin(math.radians(LAT0)) ** 2
EAST_M = math.radians(6378137.0 / math.sqrt(_W2) * math.cos(math.radians(LAT0)))  # metres per degree at height 0
NORTH_M = math.radians(6378137.0 * (1 - _E2) / _W2**1.5)


def parallel_rpc(run: Any = (0.0, 0.0), gsd: Any = 0.5, size: Any = (240, 260), bias: Any = (0.0, 0.0)) -> RPC:
    """The RPC of the formula above, metres from (LON0, LAT0) and ALT0; `bias` is its error in pixels."""
    height, width = size
    lon_scale, lat_scale, alt_scale = 0.01, 0.01, 200.0
    col_num, row_num, one = np.zeros(20), np.zeros(20), np.zeros(20)
    one[0] = 1.0
    scale = 1000.0  # pixels
    col_num[1], col_num[3] = lon_scale * EAST_M / gsd / scale, -run[0] * alt_scale / gsd / scale
    row_num[2], row_num[3] = -lat_scale * NORTH_M / gsd / scale, run[1] * alt_scale / gsd / scale
    row0, col0 = (height - 1) / 2 + bias[1], (width - 1) / 2 + bias[0]
    return RPC(row0, col0, LAT0, LON0, ALT0, scale, scale, lat_scale, lon_scale, alt_scale, row_num, one, col_num, one)


def cubic_rpc(seed: Any = 0) -> RPC:
    """A camera with all 80 coefficients at work, as a vendor's would have them."""
    rng = np.random.default_rng(seed)
    base = parallel_rpc((0.3, -0.2), 0.5, (20000, 20000))
    small = [rng.normal(0, 1e-4, 20) for _ in range(4)]
    for s in small[2:]:
        s[0] = 0.0
    return RPC(
        9000.25,
        10000.75,
        46.0,
        15.0,
        450.0,
        10500.0,
        11000.0,
        0.05,
        0.07,
        400.0,
        np.where(np.arange(20) == 2, -1.05, 0) + np.where(np.arange(20) == 3, 0.02, 0) + small[0],
        base.row_den + small[2],
        np.where(np.arange(20) == 1, 1.02, 0) + np.where(np.arange(20) == 3, -0.03, 0) + small[1],
        base.col_den + small[3],
    )


def texture(seed: Any = 1, size: Any = 900) -> Any:
    """Random ground, cells of 0.25 m, detail from 1 m to 10 m, centred on the origin."""
    rng = np.random.default_rng(seed)
    mosaics = [gaussian_filter(rng.normal(size=(size, size)), s) * s for s in (2, 5, 15)]
    return sum(mosaics)


def hills(east: Any, north: Any) -> Any:
    """Height above ALT0 [m]: waves of 8 m."""
    return 8.0 * np.sin(east / 17.0) * np.cos(north / 23.0)


def render(ground: Any, run: Any, gsd: Any = 0.5, size: Any = (240, 260), height: Any = hills) -> Any:
    """The image [H, W] float32 of a view by fixed-point iteration along its lines of sight (independent of the RPC)."""
    rows, cols = np.mgrid[: size[0], : size[1]].astype(float)
    east0, north0 = (cols - (size[1] - 1) / 2) * gsd, -(rows - (size[0] - 1) / 2) * gsd
    east, north = east0, north0
    for _ in range(30):
        h = height(east, north)
        east, north = east0 + run[0] * h, north0 + run[1] * h
    middle = ground.shape[0] / 2
    sampled = map_coordinates(ground, [middle - north / 0.25, middle + east / 0.25], order=1, mode="nearest")
    return (100.0 + 20.0 * sampled).astype(np.float32)

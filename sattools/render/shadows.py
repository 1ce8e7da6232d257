"""Cast shadows of a height map with plain arrays: what `sattools.render.visibility` computes, without PyTorch."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sattools.compiled import chunk_count
from sattools.render import shadow_kernels

SUN_RADIUS_DEG = 0.27


class Cast(NamedTuple):
    """Shadows, and what they depend on.

    Attributes:
        lit: ``[H, W]`` in [0, 1], 1 = lit.
        caster: ``[H, W]`` index of the cell that decides, negative = none.
        width: ``[H, W]`` of the ramp from dark to lit [m].
    """

    lit: NDArray[np.float32]
    caster: NDArray[np.int64]
    width: NDArray[np.float32]


def limited_slopes(height: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Rise of every cell per cell eastwards and southwards ``[H, W]`` [m], see `sattools.render.plate_slopes`."""
    height = np.ascontiguousarray(height, np.float32)
    east, south = np.empty_like(height), np.empty_like(height)
    shadow_kernels.limited_slopes(height, east, south)
    return east, south


def light_from(
    height: NDArray[np.float32], cell_size: float, direction: tuple[float, float, float]
) -> NDArray[np.float32]:
    """Share ``[H, W]`` of the light from a direction that reaches every cell, see `sattools.render.sun_visibility`.

    Args:
        height: ``[H, W]`` heights [m], row 0 = north.
        cell_size: [m].
        direction: unit vector (east, north, up) from the ground.
    """
    east, north, up = direction
    if up <= 0:
        return np.zeros(height.shape, np.float32)
    if math.hypot(east, north) < 1e-6 * up:
        return np.ones(height.shape, np.float32)
    return cast_shadows(height, cell_size, direction).lit


def cast_shadows(height: NDArray[np.float32], cell_size: float, direction: tuple[float, float, float]) -> Cast:
    """The shadows of a sun that is above the horizon and not straight above; arguments as of `light_from`.

    Unknown heights cast none, and are lit as if they were the lowest of all.
    """
    east, north, up = direction
    horizontal = math.hypot(east, north)
    heading = np.array([east / horizontal, -north / horizontal], np.float32)  # columns east, rows south
    tangent = up / horizontal
    height = _known(np.ascontiguousarray(height, np.float32))
    slopes = limited_slopes(height)
    # width of the half shadow per metre along the ray's ground track: d(tan el) = d(el) / cos(el)^2
    growth = math.radians(SUN_RADIUS_DEG) * (1 + tangent**2) * cell_size
    top = height.max() + 0.5 * max(np.abs(slope).max() for slope in slopes)
    # a ray passes a plate's cell within half a cell of its middle, and rounding
    plates = height + np.float32(0.51) * (np.abs(slopes[0]) + np.abs(slopes[1]))
    tops = np.maximum.reduceat(plates, np.arange(0, height.shape[1], shadow_kernels.LANES), axis=1)
    lit, width = np.empty_like(height), np.empty_like(height)
    caster = np.empty(height.shape, np.int64)
    shadow_kernels.shadow_march(
        height, *slopes, heading, np.float32(tangent * cell_size), np.float32(growth), np.float32(top), tops,
        lit, caster, width, 4 * chunk_count(height.size),
    )  # fmt: skip
    return Cast(lit, caster, width)


def _known(height: NDArray[np.float32]) -> NDArray[np.float32]:
    """Heights [m] with the lowest one in the place of those that are not finite, which kernels know nothing of."""
    known = np.isfinite(height)
    if known.all():
        return height
    return np.where(known, height, height[known].min() if known.any() else np.float32(0.0))


__all__ = ["SUN_RADIUS_DEG", "Cast", "cast_shadows", "light_from", "limited_slopes"]

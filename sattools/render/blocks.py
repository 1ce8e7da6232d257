"""How rays, maps and functions are laid out for the renderer's compiled kernels (`sattools.render.kernels`).

Positions are in cells of the height grid (column = east, row = south), heights in metres.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sattools.compiled import FASTMATH, njit, spread

# rays that are led down together
LANES = 32
# beyond this many softness lengths the logistic density is below 1e-3 of its maximum
EMPTY = 6.0
# so far below the surface, in softness lengths, the density has long been constant
DEEP = 14.0
# radius in cells of the highest surfaces that let rays skip empty air without jumping over a wall
REACH = 4
# columns to the left of the map: a block whose plane lies beyond the edge reads only cells that repeat the edge
PAD = LANES + 1
# channels of a packed map
HEIGHT, CEILING, COLOUR = 0, 1, 2


class Sampling(NamedTuple):
    """Rays of a view and their planes, for the kernels; float32 but for the number of planes.

    offset_x, offset_y [cells] at z_ref [m]; slope_x, slope_y [cells per m]; z_top [m]: first plane; step [m] between
    the `planes`; softness [m].
    """

    offset_x: np.float32
    offset_y: np.float32
    slope_x: np.float32
    slope_y: np.float32
    z_ref: np.float32
    z_top: np.float32
    step: np.float32
    softness: np.float32
    planes: int


def coefficients(function: Callable[[np.ndarray], np.ndarray], degree: int, domain: tuple[float, float]) -> tuple:
    """Of a polynomial close to the function on the domain, as float32, the constant one first.

    Args:
        function: to follow.
        degree: of the polynomial.
        domain: from, to.
    """
    series = np.polynomial.Chebyshev.interpolate(function, degree, domain)
    return tuple(np.float32(c) for c in series.convert(kind=np.polynomial.Polynomial).coef)


@lru_cache(maxsize=64)
def absorption(thickness: float) -> tuple[np.float32, ...]:
    """Seven coefficients of the polynomial in 2 p - 1 that is (1 - exp(-thickness p)) / p for p from 0 to 1.

    thickness: step / softness. The relative error is below 1e-7 up to a thickness of 1, and 3e-6 up to 2.
    """
    return coefficients(lambda q: -np.expm1(-thickness * (q + 1) / 2) * 2 / (q + 1), 6, (-1, 1))


def packed_width(cols: int) -> int:
    """Columns of a packed map."""
    return PAD + cols + LANES + 1


@spread(lambda height, across: len(height))
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def _highest_across(height, across, first, end):
    """Highest surface within REACH cells of the same row, for some rows."""
    cols = height.shape[1]
    for row in range(first, end):
        line = height[row]
        for col in range(cols):
            across[row, col] = line[col]
        for d in range(1, REACH + 1):
            for col in range(cols - d):
                across[row, col] = max(across[row, col], line[col + d])
            for col in range(d, cols):
                across[row, col] = max(across[row, col], line[col - d])


@spread(lambda height, *_: len(height))
@njit(fastmath=FASTMATH, cache=True, nogil=True)
def _pack_rows(height, colour, across, maps, first, end):
    """Fill some rows, see `pack`."""
    rows, cols = height.shape
    for row in range(first, end):
        top = maps[row, CEILING, PAD : PAD + cols]
        for col in range(cols):
            top[col] = across[row, col]
        for r in range(max(0, row - REACH), min(rows, row + REACH + 1)):
            for col in range(cols):
                top[col] = max(top[col], across[r, col])
        # a sample at the last column is the right end of the cell before
        maps[row, CEILING, PAD + cols - 1] = maps[row, CEILING, PAD + max(0, cols - 2)]
        for col in range(cols):
            maps[row, HEIGHT, PAD + col] = height[row, col]
            for c in range(colour.shape[2]):
                maps[row, COLOUR + c, PAD + col] = colour[row, col, c]
        for channel in range(maps.shape[1]):
            maps[row, channel, :PAD] = maps[row, channel, PAD]
            maps[row, channel, PAD + cols :] = maps[row, channel, PAD + cols - 1]


def pack(height, colour, maps):
    """Fill maps [H, 2 + C, `packed_width`] from height [H, W] and colour [H, W, C].

    They hold height, ceiling (the highest surface within REACH cells) and colours, one after the other, with the edge
    columns repeated on both sides.
    """
    across = np.empty_like(height)
    _highest_across(height, across)
    _pack_rows(height, colour, across, maps)


__all__ = [
    "CEILING",
    "COLOUR",
    "DEEP",
    "EMPTY",
    "LANES",
    "PAD",
    "REACH",
    "Sampling",
    "absorption",
    "coefficients",
    "pack",
    "packed_width",
]

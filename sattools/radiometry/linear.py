"""Digital numbers to linear radiance in [0, 1]."""

from __future__ import annotations

import math
from collections.abc import Iterable
from statistics import median_high

import numpy as np

from sattools.scene.document import Item
from sattools.scene.jsonio import JsonObject

DEFAULT_BITS = 11  # WorldView, GeoEye, QuickBird products in 16-bit files
LEAST_WHITE = 2.0**-7  # largest number of an image below which none are shares of 1: all scenes show something brighter


def without_bits(properties: JsonObject) -> bool:
    """Whether an item has floating point numbers and nothing says how many bits they had: none is known for white."""
    floating = np.dtype(properties.get("sattools:dtype") or "uint16").kind == "f"
    return floating and not properties.get("sattools:bits")


def item_bits(properties: JsonObject) -> int:
    """Significant bits of an item's digital numbers: its own statement, else 8 or 11 by file type.

    Floating point numbers may be counts or shares of 1: theirs are the fewest that hold the largest, 1 up to 1.0; see
    `own_bits`.
    """
    bits = properties.get("sattools:bits")
    if bits:
        return int(bits)
    highest = (properties.get("sattools:value_range") or [None, None])[1]
    if without_bits(properties) and highest is not None:
        return max(1, math.ceil(math.log2(max(highest, 0.0) + 1)))
    return 8 if properties.get("sattools:dtype") == "uint8" else DEFAULT_BITS


def shared_bits(item: Item, items: Iterable[Item]) -> int:
    """Bits of an item's full scale, see `own_bits`: images of one sensor share the largest.

    A dark scene's values prove nothing: with a full scale of its own it would be twice as bright beside the others.

    Args:
        item: the image.
        items: all of the scene.
    """
    everything = list(items)
    alike = [other for other in everything if _sensor(other) == _sensor(item)] or [item]
    return max(own_bits(other, everything) for other in alike)


def _sensor(item: Item) -> tuple[str | None, str | None]:
    return item.properties.get("platform"), item.properties.get("sattools:dtype")


def own_bits(item: Item, items: Iterable[Item]) -> int:
    """Bits of an item's numbers, see `item_bits`, for floating point numbers what most images of its sensor need.

    One bright roof or bad pixel in one image would else make all of that image darker than the others. It may be
    brighter than the full scale then; nothing is clipped.

    Where all such images of the scene have numbers too small for shares of 1, as radiances in some units are, the bits
    are negative: full scale is the power of two that holds the largest. Else no model of reflectance, whose amplitudes
    lie between 0 and 1, would know them from black.

    Args:
        item: the image.
        items: all of the scene.
    """
    if not without_bits(item.properties):
        return item_bits(item.properties)
    floating = [other.properties for other in items if without_bits(other.properties)] or [item.properties]
    bits_of = _negative_bits if all(0 < _largest(properties) < LEAST_WHITE for properties in floating) else item_bits
    platform = item.properties.get("platform")
    alike = [bits_of(properties) for properties in floating if properties.get("platform") == platform]
    return median_high(alike or [bits_of(item.properties)])


def _largest(properties: JsonObject) -> float:
    """Largest number of an item; 0 where it is not known."""
    return float((properties.get("sattools:value_range") or [0.0, 0.0])[1])


def _negative_bits(properties: JsonObject) -> int:
    """Exponent of the power of two above the largest number."""
    return math.frexp(_largest(properties))[1]


def full_scale(bits: int) -> float:
    """Number of white: 2^bits - 1, or 2^bits of negative ones, see `own_bits`."""
    return 2.0**bits - (1.0 if bits > 0 else 0.0)


def eight_bits(properties: JsonObject) -> bool:
    """Whether an item has the numbers of a picture of 8 bits, which are tone-mapped."""
    return item_bits(properties) <= 8 and not without_bits(properties)


def linear_radiance(numbers: np.ndarray, bits: int, black: float = 0.0) -> np.ndarray:
    """(DN - black) / (`full_scale` - black), as float32; NaN stays NaN, nothing is clipped.

    Args:
        numbers: digital numbers, any shape.
        bits: significant bits.
        black: digital number of no light.
    """
    return ((numbers - black) / (full_scale(bits) - black)).astype(np.float32)


def undo_gamma(values: np.ndarray, gamma: float) -> np.ndarray:
    """Linear radiance sign(v) |v|^gamma: undoes v = linear^(1/gamma); values below black stay below."""
    return np.asarray((np.sign(values) * np.abs(values) ** gamma).astype(np.float32))


def invalid_numbers(numbers: np.ndarray, saturation: float) -> tuple[np.ndarray, np.ndarray]:
    """Masks ``[H, W]`` of pixels without data (not finite in a band, or 0 in all) and of saturated ones (in any band).

    Vendors fill the frame around an image with 0 in all bands without saying so.

    Args:
        numbers: ``[C, H, W]``.
        saturation: digital number from which a pixel is saturated.
    """
    empty = ~np.isfinite(numbers).all(axis=0) | (numbers == 0).all(axis=0)
    return empty, (numbers >= saturation).any(axis=0) & ~empty


def gain_and_offset(found: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset ``[C]`` that give middle and spread (radiance) ``[2, C]`` the wanted values.

    Where either has no spread (most pixels of the band are one number), no gain is known: 1, and the middle alone is
    brought over. A gain of 0 would make the band one number everywhere.
    """
    spread = (found[1] > 0) & (wanted[1] > 0)
    gain = np.where(spread, wanted[1], 1.0) / np.where(spread, found[1], 1.0)
    return gain, wanted[0] - gain * found[0]


__all__ = [
    "DEFAULT_BITS",
    "eight_bits",
    "full_scale",
    "gain_and_offset",
    "invalid_numbers",
    "item_bits",
    "linear_radiance",
    "own_bits",
    "shared_bits",
    "undo_gamma",
    "without_bits",
]

"""Digital numbers to linear radiance in [0, 1]."""

from __future__ import annotations

import numpy as np

from sattools.scene.jsonio import JsonObject

DEFAULT_BITS = 11  # WorldView, GeoEye, QuickBird products in 16-bit files


def item_bits(properties: JsonObject) -> int:
    """Significant bits of an item's digital numbers: its own statement, else 8 or 11 by file type."""
    bits = properties.get("sattools:bits")
    if bits:
        return int(bits)
    return 8 if properties.get("sattools:dtype") == "uint8" else DEFAULT_BITS


def linear_radiance(numbers: np.ndarray, bits: int, black: float = 0.0) -> np.ndarray:
    """(DN - black) / (2^bits - 1 - black), as float32; NaN stays NaN, nothing is clipped.

    Args:
        numbers: digital numbers, any shape.
        bits: significant bits.
        black: digital number of no light.
    """
    full = 2.0**bits - 1 - black
    return ((numbers - black) / full).astype(np.float32)


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
    """Gain and offset ``[C]`` that give middle and spread (radiance) ``[2, C]`` the wanted values."""
    gain = wanted[1] / np.maximum(found[1], 1e-6)
    return gain, wanted[0] - gain * found[0]


__all__ = ["DEFAULT_BITS", "gain_and_offset", "invalid_numbers", "item_bits", "linear_radiance", "undo_gamma"]

"""Digital numbers to linear radiance in [0, 1]."""

from __future__ import annotations

from typing import Any

import numpy as np

DEFAULT_BITS = 11  # WorldView, GeoEye, QuickBird products in 16-bit files


def item_bits(properties: dict[str, Any]) -> int:
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


__all__ = ["DEFAULT_BITS", "item_bits", "linear_radiance"]

"""Colours of maps for eyes: red, green and blue in 8 bits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sattools.export.products.maps import Maps
from sattools.radiometry.bands import RGB_OF_EIGHT
from sattools.scene.opening import opened

_TAILS = (0.5, 99.5)  # per cent of the values that are clipped below and above


@dataclass(frozen=True)
class Palette:
    """How a map's bands become red, green and blue.

    Attributes:
        bands: index of the band shown in red, green and blue.
        low, high: values that become black and white, the same for all three.
    """

    bands: tuple[int, int, int]
    low: float
    high: float

    @classmethod
    def of(cls, maps: Maps, name: str) -> Palette:
        """That shows nearly all values of a map."""
        bands = rgb_bands(maps.paths[name])
        values = maps.sample(name)[sorted(set(bands))]
        known = values[np.isfinite(values)]
        low, high = (float(v) for v in np.percentile(known, _TAILS)) if known.size else (0.0, 1.0)
        return cls(bands, low, max(high, low + 1e-6))

    def shown(self, array: np.ndarray) -> np.ndarray:
        """``[B, ...]`` of the map as ``[..., 3]`` uint8; where it has no value, black."""
        scaled = (array[list(self.bands)] - self.low) / (self.high - self.low)
        return np.moveaxis(np.rint(255 * np.clip(np.nan_to_num(scaled), 0, 1)).astype(np.uint8), 0, -1)


def rgb_bands(path: Path) -> tuple[int, int, int]:
    """Bands of a map to show in red, green and blue: those with these names, else the first three, or the only one.

    Eight bands without names are taken as WorldView's, as `normalise` takes them.
    """
    with opened(path) as data:
        words = [str(text or "").lower().rpartition(" ")[2] for text in data.descriptions]
    if {"red", "green", "blue"} <= set(words):
        return words.index("red"), words.index("green"), words.index("blue")
    if words == [str(number) for number in range(1, 9)]:
        red, green, blue = (number - 1 for number in RGB_OF_EIGHT)
        return red, green, blue
    return (0, 1, 2) if len(words) >= 3 else (0, 0, 0)


__all__ = ["Palette", "rgb_bands"]

"""Saturated pixels: no radiance is known of them, but they are bright, and heights are found by that.

`normalise` masks them in the asset `radiance`, and notes there how their numbers would have become radiance. Matching
takes them from the asset `image`; a masked roof would otherwise be a hole that anything fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sattools.errors import InputError, counted
from sattools.scene.document import Item

NOTED = "sattools:saturated"  # of an asset `radiance`: a `Conversion`, where saturated pixels are masked


@dataclass(frozen=True)
class Conversion:
    """How an image's numbers have become radiance: gain x number + offset, band by band.

    Attributes:
        bands: of the image, counted from 1.
        gain: of each.
        offset: of each.
    """

    bands: list[int]
    gain: list[float]
    offset: list[float]

    def to_dict(self) -> dict[str, Any]:
        """As it is noted."""
        return asdict(self)

    def saturated(self, radiance: np.ndarray, numbers: np.ndarray) -> Saturated:
        """The pixels that are masked though they have numbers.

        Args:
            radiance: ``[C, h, w]``, NaN where masked.
            numbers: ``[B, h, w]`` of the same pixels; NaN, or 0 in all bands, where there are none.

        Raises:
            InputError: the image is not the one that this is of.
        """
        if not len(self.gain) == len(self.offset) == len(self.bands) == len(radiance) or (
            max(self.bands) > len(numbers) or numbers.shape[1:] != radiance.shape[1:]
        ):
            raise InputError(
                f"found an image of {counted(len(numbers), 'bands')} and {numbers.shape[1]} x {numbers.shape[2]} "
                f"pixels, expected the bands {self.bands} that became {len(radiance)} of {radiance.shape[1]} x "
                f"{radiance.shape[2]}"
            )
        own = numbers[[band - 1 for band in self.bands]]
        there = np.isfinite(own).all(axis=0) & (own != 0).any(axis=0) & ~np.isfinite(radiance).all(axis=0)
        gain, offset = (np.array(part)[:, None] for part in (self.gain, self.offset))
        return Saturated(np.flatnonzero(there), (gain * own[:, there] + offset).astype(np.float32))


@dataclass(frozen=True)
class Saturated:
    """Saturated pixels of an image, and what they show at least.

    Attributes:
        at: ``[N]`` flat positions.
        radiance: ``[C, N]`` float32.
    """

    at: np.ndarray
    radiance: np.ndarray

    def within(self, radiance: np.ndarray) -> np.ndarray:
        """``[C, h, w]`` radiance with them."""
        filled = radiance.copy()
        filled.reshape(len(filled), -1)[:, self.at] = self.radiance
        return filled

    def of_bands(self, places: Sequence[int]) -> Saturated:
        """The same of some of the bands, counted from 0."""
        return Saturated(self.at, self.radiance[list(places)])


def conversion_of(item: Item) -> Conversion | None:
    """What is noted of an item's saturated pixels, if they are masked."""
    radiance = item.assets.get("radiance")
    noted = radiance.extra.get(NOTED) if radiance and "image" in item.assets else None
    return Conversion(**noted) if noted else None


def showing_asset(item: Item) -> str:
    """Name of the asset whose pixels are valid wherever the image shows something, as bright as it may be."""
    return "image" if "radiance" not in item.assets or conversion_of(item) else "radiance"


__all__ = ["NOTED", "Conversion", "Saturated", "conversion_of", "showing_asset"]

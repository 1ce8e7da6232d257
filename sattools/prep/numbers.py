"""What numbers an image holds, strip by strip: their range, and those that may not be brightness."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.errors import InputError

MANY_ZEROS = 0.05  # of the pixels: more than a frame's corners
MANY_NEGATIVE = 0.01  # of the pixels: atmospheric corrections leave some in deep shadow
MOST_NEGATIVE = 0.5  # of the pixels: black is in the wrong place, and all below it looks alike to matching
LEAST_NUMBER = 1e-15  # that the largest of an image is: squares of less are none in single precision
LARGEST_NUMBER = 1e9  # of a pixel's mean over the bands
MOST_NUMBER = 1e30  # of a band: sums of more are none in single precision
LEAST_MARK = -1.0  # a negative number that fills pixels as a mark of no data does is a whole one


@dataclass
class Numbers:
    """Smallest and largest valid number of every band, and how many pixels are not, or may not be, of the ground.

    Attributes:
        bands: how many.
        low, high: ``[bands]``.
        odd: pixels of the first band that are not finite.
        seen: pixels.
        zero: pixels that are 0 in all bands without being no data.
        negative: pixels that are negative in a band.
        lowest: pixels of the first band that have its smallest number.
        hot: pixels that are left out because they are, see `sattools.prep.hot`.
    """

    bands: int
    low: NDArray[np.float64] = field(init=False)
    high: NDArray[np.float64] = field(init=False)
    odd: int = 0
    seen: int = 0
    zero: int = 0
    negative: int = 0
    lowest: int = 0
    hot: int = 0

    def __post_init__(self) -> None:
        self.low, self.high = np.full(self.bands, np.inf), np.full(self.bands, -np.inf)

    def add(self, band: int, values: NDArray[np.generic], good: NDArray[np.bool_]) -> None:
        """Numbers of a band, counted from 1, and which of them are data."""
        if not good.any():
            return
        known = values[good]
        low = float(known.min())
        if band == 1 and low < min(0.0, self.low[0]):
            self.lowest = 0
        if band == 1 and low < 0 and low <= self.low[0]:
            self.lowest += int((known == known.min()).sum())
        self.low[band - 1] = min(self.low[band - 1], low)
        self.high[band - 1] = max(self.high[band - 1], float(known.max()))

    def check(self, path: Path) -> None:
        """Raise InputError for a band without any data, and for numbers too small or large to calculate with."""
        for band, (low, high) in enumerate(zip(self.low, self.high, strict=True), 1):
            if low >= high:
                what = f"{low:g} everywhere" if low == high else "no-data or NaN everywhere"
                raise InputError(f"{path}: found band {band} to be {what}, expected an image")
        largest = max(abs(number) for number in self.overall())
        if largest < LEAST_NUMBER:
            raise InputError(
                f"{path}: found numbers of up to {largest:.2g}, expected digital numbers, radiance or reflectance "
                f"above {LEAST_NUMBER:g} (multiply them)"
            )

        if largest > MOST_NUMBER:
            raise too_large(path, largest)

    def notes(self) -> list[str]:
        """What is masked without a no-data number."""
        found = []
        if self.odd:
            found.append(f"{self._percent(self.odd)} % of the pixels are NaN and were masked")
        if self.zero > MANY_ZEROS * self.seen:
            found.append(f"{self._percent(self.zero)} % of the pixels are 0 in all bands: they tie no images")
        return found

    def doubts(self) -> list[str]:
        """What is taken for brightness and may not be, and the other way round."""
        return self._hot() + self._negative()

    def _hot(self) -> list[str]:
        if not self.hot:
            return []
        return [
            f"{self._percent(self.hot)} % of its pixels are hot, single ones far brighter than all around them, and "
            "taken for no data"
        ]

    def _negative(self) -> list[str]:
        low = self.low[0]
        if self.lowest > MANY_NEGATIVE * self.seen and low <= LEAST_MARK:
            return [
                f"{self._percent(self.lowest)} % of its pixels are {low:g}, taken for brightness: where that "
                f"means no data, declare it (gdal_edit.py -a_nodata {low:g})"
            ]
        if self.negative > MANY_NEGATIVE * self.seen and self.low.min() <= LEAST_MARK:
            return [
                f"{self._percent(self.negative)} % of its pixels are negative, down to {self.low.min():g}, "
                "taken for brightness: declare numbers that mean no data (gdal_edit.py -a_nodata), and write numbers "
                "above 32767 without sign"
            ]
        return []

    def _percent(self, count: int) -> str:
        """Two digits of a share of the pixels."""
        percent = 100.0 * count / self.seen
        return f"{percent:.2g}" if percent < 10 else f"{percent:.0f}"  # no 1e+02

    def overall(self) -> tuple[float, float]:
        """Of all bands."""
        return float(self.low.min()), float(self.high.max())


def too_large(path: Path, largest: float) -> InputError:
    """The error of an image with numbers that are no brightness."""
    return InputError(
        f"{path}: found numbers of up to {largest:.2g}, expected digital numbers, radiance or reflectance below "
        f"{LARGEST_NUMBER:g}; declare those that mean no data (gdal_edit.py -a_nodata)"
    )


def check_brightness(path: Path, known: NDArray[np.float32]) -> None:
    """Raise InputError for an image that is mostly darker than black: matching would see next to nothing of it.

    Args:
        path: of the image.
        known: ``[N]`` means over the bands of its pixels.
    """
    share = float(np.mean(known < 0))
    if share > MOST_NEGATIVE:
        raise InputError(
            f"{path}: found {100 * share:.0f} % of the pixels below 0, expected brightness, "
            "0 where it is black (add an offset to all images, write numbers above 32767 without sign, or declare "
            "those that mean no data)"
        )


def read_band(data: DatasetReader, path: Path, band: int, window: Window) -> NDArray[np.generic]:
    """Numbers ``[H, W]`` of a band as stored.

    Args:
        data: the open image.
        path: its name, for messages.
        band: from 1.
        window: of the file.

    Raises:
        InputError: it is damaged.
    """
    try:
        return np.asarray(data.read(band, window=window))
    except (RasterioError, ValueError):
        raise InputError(
            f"{path}: found a damaged or truncated image in band {band}, expected {data.width} x {data.height} pixels"
        ) from None


__all__ = ["LARGEST_NUMBER", "Numbers", "check_brightness", "read_band", "too_large"]

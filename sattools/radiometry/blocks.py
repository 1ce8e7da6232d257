"""The pixels of an image as `normalise` writes them, and what is counted of them on the way."""

from __future__ import annotations

import math

import numpy as np

from sattools.radiometry.atmosphere import Air, air_of
from sattools.radiometry.job import Job
from sattools.radiometry.linear import gain_and_offset, invalid_numbers, linear_radiance, undo_gamma, without_bits
from sattools.radiometry.saturated import Conversion
from sattools.scene import Item
from sattools.scene.pixels import ImagePart
from sattools.scene.stored import pieces

SAMPLE = 20000  # pixels per image and band in the histogram
TOLD = 4_000_000  # pixels that tell an image's middle and spread for --match, and its darkest


class Blocks:
    """An image's pixels as they come out, and what is counted of them on the way."""

    def __init__(self, job: Job, item: Item, part: ImagePart) -> None:
        self.job, self.item, self.part = job, item, part
        self.chosen = job.bands(item, part.bands)
        self.saturation = job.saturation(item)
        picture = bool(job.options.bits) or not without_bits(item.properties)
        self.tone_mapped = picture and job.bits[item.id] <= 8 and job.scales[item.id].reflectance is None
        wanted = job.options.saturated
        self.masks = wanted == "mask" or (wanted == "auto" and not self.tone_mapped)
        self._air: Air | None = None
        self._matched: tuple[np.ndarray, np.ndarray] | None = None
        height, width = part.shape
        self._places = np.divmod(job.rng.integers(height * width, size=min(SAMPLE, height * width)), width)
        self.numbers, self.radiance = (np.full((len(self.chosen), len(self._places[0])), np.nan) for _ in range(2))
        self.counts = dict.fromkeys(("pixels", "no_data", "saturated", "known", "below_0", "above_1", "bright"), 0)

    def _values(self, rows: slice, cols: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Digital numbers and radiance ``[C, h, w]``, and where there are no data or too much light ``[h, w]``."""
        bands = self.part.read((rows, cols))[[b - 1 for b in self.chosen]]
        empty, full = invalid_numbers(bands, self.saturation)
        return bands, self._radiance(np.where(empty | full if self.masks else empty, np.nan, bands)), empty, full

    def _radiance(self, values: np.ndarray) -> np.ndarray:
        """Radiance of digital numbers ``[C, h, w]``, but for --match."""
        options, scale = self.job.options, self.job.scales[self.item.id]
        if self.job.quantity != "relative":
            above = scale.apply(values - options.black, self.chosen, self.job.quantity)
            return above if self._air is None else self._air.through(above)
        radiance = linear_radiance(values, self.job.bits[self.item.id], options.black)
        return undo_gamma(radiance, options.gamma) if self.tone_mapped and options.gamma is not None else radiance

    def conversion(self) -> Conversion | None:
        """How saturated pixels would have become radiance, if they are masked and it is linear in their numbers."""
        if not self.masks or not self.counts["saturated"] or (self.tone_mapped and self.job.options.gamma is not None):
            return None
        most = float(self.saturation)
        ends = self._radiance(np.tile([0.0, most], (len(self.chosen), 1, 1))).astype(np.float64)[:, 0]
        gain, offset = (ends[:, 1] - ends[:, 0]) / most, ends[:, 0]
        if self._matched is not None:
            gain, offset = gain * self._matched[0], offset * self._matched[0] + self._matched[1]
        return Conversion(self.chosen, gain.tolist(), offset.tolist())

    def _told(self) -> np.ndarray:
        """Radiance ``[C, N]`` of pixels at even distances, but for --match."""
        height, width = self.part.shape
        step = math.ceil(math.sqrt(height * width / TOLD))
        some = [
            self._values(rows, slice(0, width))[1][:, -rows.start % step :: step, ::step].reshape(len(self.chosen), -1)
            for rows in pieces((height, width * len(self.chosen)))
        ]
        return np.concatenate(some, axis=1)

    def look_through_air(self) -> Air | None:
        """Take the air off from now on, as pixels at even distances tell it; None where none has a value."""
        self._air = air_of(self.item, self._told(), self.job.quantity, self.job.options)
        return self._air

    def blank(self) -> list[str]:
        """Bands, from 1, that are 0 in all pixels of the histogram, of which others show something."""
        none = ~(np.nan_to_num(self.numbers) != 0).any(axis=1)
        return [] if none.all() else [str(band) for band, is_blank in zip(self.chosen, none, strict=True) if is_blank]

    def match(self) -> list[int]:
        """Bring the image to the first one's middle and spread, which pixels at even distances tell.

        Returns:
            Bands, from 1, of which one of the two has no spread, so that no gain is known.
        """
        told = self._told()
        if not np.isfinite(told).any():
            return []  # an image without a valid pixel is refused later on
        low, middle, high = np.nanpercentile(told, [16, 50, 84], axis=1)
        level_and_spread = np.stack([middle, high - low])
        if self.job.reference is None:  # the first one stays as it is
            self.job.reference = level_and_spread
            return []
        self._matched = gain_and_offset(level_and_spread, self.job.reference)
        flat = (level_and_spread[1] <= 0) | (self.job.reference[1] <= 0)
        return [band for band, without in zip(self.chosen, flat, strict=True) if without]

    def block(self, rows: slice, cols: slice) -> np.ndarray:
        """Some pixels ``[C, h, w]`` float32 radiance, which are counted."""
        bands, radiance, empty, full = self._values(rows, cols)
        if self._matched is not None:
            gain, offset = (part[:, None, None] for part in self._matched)
            radiance = (radiance * gain + offset).astype(np.float32)
        row, col = self._places
        own = np.flatnonzero((row >= rows.start) & (row < rows.stop) & (col >= cols.start) & (col < cols.stop))
        here = (slice(None), row[own] - rows.start, col[own] - cols.start)
        self.numbers[:, own], self.radiance[:, own] = bands[here], radiance[here]
        known = np.isfinite(radiance)
        above = radiance > 1
        bright = (above & ~full).sum()  # a glint that is kept says nothing of the scale
        counted = (empty.size, empty.sum(), full.sum(), known.sum(), (radiance < 0).sum(), above.sum(), bright)
        for name, count in zip(self.counts, counted, strict=True):
            self.counts[name] += int(count)
        return radiance

    def shares(self) -> dict[str, float]:
        """Of the pixels without data, of saturated ones, and of what is known below 0 and above 1."""
        pixels, known = self.counts["pixels"], max(self.counts["known"], 1)
        shares = {name: self.counts[name] / pixels for name in ("no_data", "saturated")}
        return shares | {name: self.counts[name] / known for name in ("below_0", "above_1")}


__all__ = ["Blocks"]

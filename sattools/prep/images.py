"""Images as they come: reading a window, and writing the scene's own copy."""

from __future__ import annotations

import logging
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.camera import RPC
from sattools.errors import InputError
from sattools.prep.metadata import Metadata
from sattools.prep.numbers import Numbers
from sattools.scene.files import write_with
from sattools.scene.memory import check_memory
from sattools.scene.opening import opened
from sattools.scene.raster import block_means, sensor_profile

log = logging.getLogger(__name__)
LARGE_PX = 9_000_000  # of an image, beyond which none is read as a whole
LARGE_TOTAL_PX = 200_000_000  # of all images together
REDUCED_PX = 5_000_000
_STRIP_PX = 4_000_000
_AT_ONCE_PX = 9_000_000  # of images that are read or written at a time


@dataclass
class SourceImage:
    """One input image: its file, what is known about it, and the part of it that is used."""

    id: str
    path: Path
    size: tuple[int, int]  # (height, width)
    bands: int
    dtype: str
    rpc: RPC
    metadata: Metadata
    window: tuple[int, int, int, int] = (0, 0, 0, 0)  # col0, row0, width, height
    notes: list[str] = field(default_factory=list)
    meanings: tuple[str, ...] = ()  # of the bands: gray, red, alpha, palette, ...
    mask_like: bool = False  # the band marked as alpha holds two values at most
    masked: bool = False  # a mask lies beside the bands
    tags_rpc: RPC | None = None  # the camera of the image's own tags, whichever is used
    read_range: tuple[tuple[int, int, int, int], tuple[float, float]] | None = None  # window, its extreme numbers

    def warn(self, text: str) -> None:
        """A note that the user sees at once."""
        self.notes.append(text)
        log.warning("%s: %s", self.id, text)


def block_factor(size: tuple[int, int], sizes: Sequence[tuple[int, int]]) -> int:
    """Pixels along an axis that are read as one where images are looked at as a whole; 1 for small ones.

    Args:
        size: (height, width) of the image [px].
        sizes: of all images.
    """
    pixels = [h * w for h, w in sizes]
    if max(pixels) <= LARGE_PX and sum(pixels) <= LARGE_TOTAL_PX:
        return 1
    budget = min(REDUCED_PX, LARGE_TOTAL_PX // len(sizes))
    return max(1, math.ceil(math.sqrt(size[0] * size[1] / budget)))


def at_once(sources: Sequence[SourceImage]) -> int:
    """Images that are read or written at a time: several small ones, but one that is a whole satellite scene."""
    largest = max((source.window[2] * source.window[3] for source in sources), default=1)
    return max(1, _AT_ONCE_PX // max(largest, 1))


def read_gray(source: SourceImage, factor: int = 1, *, whole: bool = True) -> NDArray[np.float32]:
    """Mean of the bands over the source's window `[H, W]`, NaN where a band has no data.

    Adds a note where pixels are not finite, and to the source the range of its values.

    Args:
        source: the image.
        factor: pixels along an axis of which the mean is taken; rows and columns left over at the end are dropped.
        whole: the window is all that is used of the image, which then must show something in every band.

    Raises:
        InputError: truncated, or a band without any data.
    """
    _, _, width, height = source.window
    rows, cols = height // factor, width // factor
    needed = 14.0 * min(height * width, _STRIP_PX + factor * width) if factor > 1 else 14.0 * height * width
    check_memory(needed + 4.0 * rows * cols, f"{source.path}: {width} x {height} pixels", "give --aoi or --bounds")
    gray = np.empty((rows, cols), np.float32)
    ranges = Numbers(source.bands)
    strip = rows if factor == 1 else max(1, _STRIP_PX // (factor * width))
    with opened(source.path) as data:
        for first in range(0, rows, strip):
            some = min(strip, rows - first)
            piece = _gray_rows(data, source, first * factor, some * factor, ranges)
            if factor > 1:
                blocks = piece[:, : cols * factor].reshape(1, some, factor, cols, factor)
                piece = block_means(blocks)[0].astype(np.float32)
            gray[first : first + some] = piece
    if whole:
        ranges.check(source.path)
        source.notes += ranges.notes()
        for text in ranges.doubts():
            source.warn(text)
        if not np.isfinite(gray).any():
            raise InputError(f"{source.path}: found no pixel that is valid in all bands, expected an image")
        source.read_range = (source.window, ranges.overall())
    return gray


def _gray_rows(
    data: DatasetReader, source: SourceImage, first: int, count: int, ranges: Numbers
) -> NDArray[np.float32]:
    """Mean of the bands ``[count, width]`` in rows of the source's window."""
    col, row, width, _ = source.window
    total = np.zeros((count, width), np.float32)
    valid = np.ones((count, width), bool)
    nonzero, negative = np.zeros((count, width), bool), np.zeros((count, width), bool)
    for band in range(1, data.count + 1):
        values = _read(data, source, band, Window(col, row + first, width, count))
        good = np.isfinite(values) if np.issubdtype(values.dtype, np.floating) else np.ones(values.shape, bool)
        if band == 1:
            ranges.odd += int((~good).sum())
            ranges.seen += good.size
        if data.nodata is not None:
            good &= values != data.nodata
        ranges.add(band, values, good)
        if values.dtype.kind != "u":
            negative |= np.less(values, 0) & good
        nonzero |= values != 0
        valid &= good
        total += np.where(good, values, 0).astype(np.float32)
    ranges.zero += int((valid & ~nonzero).sum())
    ranges.negative += int(negative.sum())
    # Vendors fill the frame around an image with 0 in all bands without saying so.
    return np.where(valid & nonzero, total / source.bands, np.nan).astype(np.float32)


def value_range(source: SourceImage) -> tuple[float, float]:
    """Smallest and largest finite value of the window that is not no-data."""
    if source.read_range is not None and source.read_range[0] == source.window:
        return source.read_range[1]
    col, row, width, height = source.window
    ranges = Numbers(source.bands)
    strip = max(1, _STRIP_PX // max(1, width))
    with opened(source.path) as data:
        for band in range(1, data.count + 1):
            for first in range(0, height, strip):
                values = _read(data, source, band, Window(col, row + first, width, min(strip, height - first)))
                good = np.isfinite(values)
                if data.nodata is not None:
                    good &= values != data.nodata
                ranges.add(band, values, good)
    return ranges.overall()


def significant_bits(source: SourceImage, highest: float) -> int | None:
    """Bits of the pixel values: the vendor's word if the values agree with it, else the fewest that hold them."""
    if np.issubdtype(np.dtype(source.dtype), np.floating):
        return None
    stored = 8 * np.dtype(source.dtype).itemsize
    if stored == 8:
        return 8
    said = source.metadata.bits
    if said is not None and said < stored and highest < 2**said:
        return said
    return next((b for b in (8, 10, 11, 12, 14, 16) if highest < 2**b), stored)


def write_image(source: SourceImage, rpc: RPC, target: Path) -> None:
    """The window's pixels as a tiled GeoTIFF whose only georeference is `rpc` (camera of the window).

    Strip by strip, and read back before the file gets its name.

    Args:
        source: the image.
        rpc: the camera.
        target: file to write.

    Raises: InputError when the source cannot be read; SattoolsError when the target cannot be written.
    """
    col, row, width, height = source.window
    sums: list[tuple[int, Window, int]] = []
    with opened(source.path) as data:
        profile = sensor_profile(source.dtype, data.count, height, width, data.nodata)
        profile |= {"interleave": "pixel" if data.count > 1 else "band", "bigtiff": "if_safer"}
        strip = max(256, int(5e7 // max(1, width * data.count)) // 256 * 256)

        def write(path: Path) -> None:
            with rasterio.open(path, "w", **profile) as out:
                for first in range(0, height, strip):
                    rows = min(strip, height - first)
                    for band in range(1, data.count + 1):
                        values = _read(data, source, band, Window(col, row + first, width, rows))
                        place = Window(0, first, width, rows)
                        out.write(values, band, window=place)
                        sums.append((band, place, zlib.crc32(values.tobytes())))
                out.descriptions, out.scales, out.offsets = data.descriptions, data.scales, data.offsets
                out.update_tags(ns="RPC", **rpc.to_tags())

        def check(path: Path) -> None:
            with rasterio.open(path) as written:
                for band, place, expected in sums:
                    if zlib.crc32(written.read(band, window=place).tobytes()) != expected:
                        raise OSError(5, "found other pixels than were written")

        write_with(target, write, check)


def _read(data: DatasetReader, source: SourceImage, band: int, window: Window) -> NDArray[np.generic]:
    try:
        return np.asarray(data.read(band, window=window))
    except (RasterioError, ValueError):
        raise InputError(
            f"{source.path}: found a damaged or truncated image in band {band}, "
            f"expected {data.width} x {data.height} pixels"
        ) from None


__all__ = [
    "LARGE_PX",
    "LARGE_TOTAL_PX",
    "SourceImage",
    "at_once",
    "block_factor",
    "read_gray",
    "significant_bits",
    "value_range",
    "write_image",
]

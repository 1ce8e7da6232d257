"""Pixels of source images: their brightness, their numbers, and the copies that a scene keeps."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.camera.rpc import RPC
from sattools.errors import InputError
from sattools.prep.frames import find_frames
from sattools.prep.grays import of_size_one
from sattools.prep.hot import hot_pixels
from sattools.prep.images import SourceImage
from sattools.prep.numbers import Numbers, read_band
from sattools.scene.files import write_with
from sattools.scene.memory import check_memory
from sattools.scene.opening import opened
from sattools.scene.raster import block_means
from sattools.scene.sensor_files import sensor_profile

_STRIP_PX = 4_000_000


def look_for_frames(data: DatasetReader, source: SourceImage) -> None:
    """Find the frames of a source's window, and tell them.

    Args:
        data: the open image.
        source: gets the frames, and notes.

    Raises:
        InputError: it cannot be read.
    """
    source.frames = tuple(find_frames(data, source.path, source.window))
    for frame in source.frames:
        if frame.value == 0:  # what every vendor does
            source.notes.append(str(frame))
        else:
            source.warn(str(frame))


def unknown(data: DatasetReader, source: SourceImage, window: Window) -> NDArray[np.bool_]:
    """Which pixels ``[H, W]`` of a window are no data by a mask, as a frame, as a cloud or as hot pixels.

    Args:
        data: the open image.
        source: the same.
        window: of the file.

    Raises:
        InputError: it cannot be read.
    """
    found = np.zeros((window.height, window.width), bool)
    if source.masked:
        found |= data.dataset_mask(window=window) == 0
    for frame in source.frames:
        there = frame.blocks.within(window)
        for band in range(1, data.count + 1):
            there &= read_band(data, source.path, band, window) == frame.value
        found |= there
    if source.clouds is not None:
        found |= source.clouds.within(window)
    if source.hot:
        found |= hot_pixels(data, source.path, window)
    return found


def read_gray(source: SourceImage, factor: int = 1, *, whole: bool = True) -> NDArray[np.float32]:
    """Mean of the bands over the source's window `[H, W]`, NaN where a band has no data; see `of_size_one`.

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
        if whole:
            look_for_frames(data, source)
            source.hot = None
        for first in range(0, rows, strip):
            some = min(strip, rows - first)
            piece = _gray_rows(data, source, first * factor, some * factor, ranges)
            if factor > 1:
                blocks = piece[:, : cols * factor].reshape(1, some, factor, cols, factor)
                piece = block_means(blocks)[0].astype(np.float32)
            gray[first : first + some] = piece
    if whole:
        ranges.check(source.path)
        source.hot = ranges.hot
        source.notes += ranges.notes()
        for text in ranges.doubts():
            source.warn(text)
        if not np.isfinite(gray).any():
            raise InputError(f"{source.path}: found no pixel that is valid in all bands, expected an image")
        source.read_range = (source.window, ranges.overall())
    return of_size_one(gray)


def _gray_rows(
    data: DatasetReader, source: SourceImage, first: int, count: int, ranges: Numbers
) -> NDArray[np.float32]:
    """Mean of the bands ``[count, width]`` in rows of the source's window."""
    col, row, width, _ = source.window
    window = Window(col, row + first, width, count)
    total = np.zeros((count, width), np.float32)
    there = ~unknown(data, source, window)
    if source.hot is None:
        hot = hot_pixels(data, source.path, window)
        ranges.hot += int((hot & there).sum())
        there &= ~hot
    valid = there.copy()
    ranges.seen += valid.size
    nonzero, negative = np.zeros((count, width), bool), np.zeros((count, width), bool)
    for band in range(1, data.count + 1):
        values = read_band(data, source.path, band, window)
        good = np.isfinite(values) if np.issubdtype(values.dtype, np.floating) else np.ones(values.shape, bool)
        if band == 1:
            ranges.odd += int((~good).sum())
        if data.nodata is not None:
            good &= values != data.nodata
        good &= there
        ranges.add(band, values, good)
        if values.dtype.kind != "u":
            negative |= np.less(values, 0) & good
        nonzero |= values != 0
        valid &= good
        with np.errstate(over="ignore"):  # of numbers that `Numbers.check` refuses, or that are beyond the area
            total += np.where(good, values, 0).astype(np.float32)
    ranges.zero += int((valid & ~nonzero).sum())
    ranges.negative += int(negative.sum())
    # what is black in all bands ties no images, whether it is ground or not
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
                window = Window(col, row + first, width, min(strip, height - first))
                values = read_band(data, source.path, band, window)
                good = np.isfinite(values) & ~unknown(data, source, window)
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

    A mask within the file says which of them are no data where the source's mask, its frames, clouds or hot pixels do.

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

        mask = source.masked or bool(source.frames) or source.clouds is not None or bool(source.hot)

        def write(path: Path) -> None:
            with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "w", **profile) as out:
                for first in range(0, height, strip):
                    rows = min(strip, height - first)
                    window, place = Window(col, row + first, width, rows), Window(0, first, width, rows)
                    if mask:
                        out.write_mask(~unknown(data, source, window), window=place)
                    for band in range(1, data.count + 1):
                        values = read_band(data, source.path, band, window)
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


__all__ = ["look_for_frames", "read_gray", "significant_bits", "unknown", "value_range", "write_image"]

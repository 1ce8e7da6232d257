"""Images in sensor geometry that are written row by row, whatever their size."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window

from sattools.scene.files import write_with
from sattools.scene.raster import sensor_profile

TILE_ROWS = 256
_STRIP_VALUES = 4 << 20  # of all bands that are held at a time


def write_sensor_maps(path: Path, maps: Sequence[np.ndarray], rpc: Mapping[str, str]) -> None:
    """Write bands in the geometry of an image; see `write_sensor_rows`.

    Args:
        path: target file.
        maps: ``[H, W]`` float32 each, of any unit, which may be read by rows (`sattools.scene.stored`); NaN = no data.
        rpc: the image's camera as RPC tags.

    Raises:
        SattoolsError: the file cannot be written.
    """
    shape = (maps[0].shape[0], maps[0].shape[1])
    write_sensor_rows(path, shape, len(maps), lambda rows: np.stack([map_[rows] for map_ in maps]), rpc)


def write_sensor_rows(
    path: Path,
    shape: tuple[int, int],
    bands: int,
    rows_of: Callable[[slice], np.ndarray],
    rpc: Mapping[str, str],
    descriptions: Sequence[str] | None = None,
) -> None:
    """Write an image as a tiled GeoTIFF, some rows at a time; see `sattools.scene.raster.write_sensor_image`.

    Args:
        path: target file.
        shape: rows and columns [px].
        bands: number of bands.
        rows_of: makes some rows ``[B, h, W]`` float32, of any unit, NaN = no data; asked once for each, from the top.
        rpc: the image's camera as RPC tags.
        descriptions: one name per band.

    Raises:
        SattoolsError: the file cannot be written.
    """
    height, width = shape
    profile = sensor_profile("float32", bands, height, width, float("nan"))
    step = TILE_ROWS
    while step > 1 and step * width * bands > _STRIP_VALUES:
        step //= 2
    strips = [slice(first, min(first + step, height)) for first in range(0, height, step)]
    sums: list[int] = []

    def write(target: Path) -> None:
        with rasterio.open(target, "w", **profile, bigtiff="if_safer") as data:
            if descriptions:
                data.descriptions = tuple(descriptions)
            data.update_tags(ns="RPC", **rpc)
            for rows in strips:
                values = np.ascontiguousarray(rows_of(rows), np.float32)
                sums.append(zlib.crc32(values.data))
                data.write(values, window=Window.from_slices(rows, slice(0, width)))

    def check(target: Path) -> None:
        with rasterio.open(target) as data:
            for rows, expected in zip(strips, sums, strict=True):
                found = np.ascontiguousarray(data.read(window=Window.from_slices(rows, slice(0, width))))
                if zlib.crc32(found.data) != expected:
                    raise OSError(5, "found other pixels than were written")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        write_with(path, write, check)


__all__ = ["TILE_ROWS", "write_sensor_maps", "write_sensor_rows"]

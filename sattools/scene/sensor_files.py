"""Images in sensor geometry that are written row by row, whatever their size."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window

from sattools.scene.files import write_with
from sattools.scene.raster import sensor_profile

_ROWS = 256  # at a time: a row of tiles


def write_sensor_maps(path: Path, maps: Sequence[np.ndarray], rpc: Mapping[str, str]) -> None:
    """Write bands in the geometry of an image as a tiled GeoTIFF; see `sattools.scene.raster.write_sensor_image`.

    Args:
        path: target file.
        maps: ``[H, W]`` float32 each, of any unit, which may be read by rows (`sattools.scene.stored`); NaN = no data.
        rpc: the image's camera as RPC tags.

    Raises:
        SattoolsError: the file cannot be written.
    """
    height, width = maps[0].shape
    profile = sensor_profile("float32", len(maps), height, width, float("nan"))
    strips = [slice(first, min(first + _ROWS, height)) for first in range(0, height, _ROWS)]

    def rows_of(rows: slice) -> np.ndarray:
        return np.stack([map_[rows] for map_ in maps])

    def write(target: Path) -> None:
        with rasterio.open(target, "w", **profile, bigtiff="if_safer") as data:
            data.update_tags(ns="RPC", **rpc)
            for rows in strips:
                data.write(rows_of(rows), window=Window.from_slices(rows, slice(0, width)))

    def check(target: Path) -> None:
        with rasterio.open(target) as data:
            for rows in strips:
                found = data.read(window=Window.from_slices(rows, slice(0, width)))
                if not np.array_equal(found, rows_of(rows), equal_nan=True):
                    raise OSError(5, "found other pixels than were written")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        write_with(path, write, check)


__all__ = ["write_sensor_maps"]

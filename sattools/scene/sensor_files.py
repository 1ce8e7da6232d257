"""Writing of images in sensor geometry: as a whole, or block by block, whatever their size."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.windows import Window

from sattools.scene.files import write_bytes, write_with
from sattools.scene.gdal import not_georeferenced

TILE = 256  # pixels along an edge
_VALUES = 1 << 20  # of all bands that are held at a time
_LEAST_ROWS, _MOST_ROWS = 16, 2048  # of a block: tiles of a TIFF have multiples of 16, those of JPEG 2000 are large


def write_sensor_image(
    path: Path,
    array: np.ndarray,
    rpc: Mapping[str, str] | None = None,
    *,
    nodata: float | None = None,
    descriptions: Sequence[str] | None = None,
    units: str | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write an image (pixels of any unit) in sensor geometry as a tiled GeoTIFF.

    Args:
        path: target file.
        array: ``[B, H, W]``.
        rpc: its camera as RPC tags.
        nodata: no-data value.
        descriptions: one name per band.
        units: unit of the bands.
        tags: dataset tags.

    Raises:
        SattoolsError: the file cannot be written.
    """
    bands, height, width = array.shape
    profile = sensor_profile(array.dtype, bands, height, width, nodata)
    with not_georeferenced, rasterio.MemoryFile() as memory:
        with memory.open(**profile) as data:
            data.write(array)
            if descriptions:
                data.descriptions = tuple(descriptions)
            if units:
                data.units = [units] * bands
            data.update_tags(**(tags or {}))
            if rpc:
                data.update_tags(ns="RPC", **rpc)
        write_bytes(path, memory.getbuffer())


def write_sensor_maps(
    path: Path,
    maps: Sequence[np.ndarray],
    rpc: Mapping[str, str],
    tags: Mapping[str, str] | None = None,
    descriptions: Sequence[str] = (),
) -> None:
    """Write bands in the geometry of an image; see `write_sensor_blocks`.

    Args:
        path: target file.
        maps: ``[H, W]`` float32 each, of any unit, which may be read by pieces (`sattools.scene.stored`); NaN = no
            data.
        rpc: the image's camera as RPC tags.
        tags: of the file, beside them.
        descriptions: of the bands; none = without.

    Raises:
        SattoolsError: the file cannot be written.
    """
    shape = (maps[0].shape[0], maps[0].shape[1])
    write_sensor_blocks(
        path, shape, len(maps), lambda *place: np.stack([map_[place] for map_ in maps]), rpc, tags=tags,
        descriptions=descriptions,
    )  # fmt: skip


def write_sensor_blocks(
    path: Path,
    shape: tuple[int, int],
    bands: int,
    block_of: Callable[[slice, slice], np.ndarray],
    rpc: Mapping[str, str],
    *,
    descriptions: Sequence[str] | None = None,
    tags: Mapping[str, str] | None = None,
    source_block: tuple[int, int] = (TILE, TILE),
) -> None:
    """Write an image as a tiled GeoTIFF, some pixels at a time; see `write_sensor_image`.

    Args:
        path: target file.
        shape: rows and columns [px].
        bands: number of bands.
        block_of: makes some rows and columns ``[B, h, w]`` float32, of any unit, NaN = no data; asked once for each.
        rpc: the image's camera as RPC tags.
        descriptions: one name per band.
        tags: of the file, beside those of the camera.
        source_block: rows and columns in which what they are made from is stored.

    Raises:
        SattoolsError: the file cannot be written.
    """
    height, width = shape
    places = list(_blocks(shape, bands, source_block))
    profile = sensor_profile("float32", bands, height, width, float("nan"))
    # a tile is whole after a block: else it would be compressed again and again where a row of them is more than
    # GDAL's cache
    profile["blockysize"] = min(TILE, -(-places[0][0].stop // _LEAST_ROWS) * _LEAST_ROWS)
    sums: list[int] = []

    def write(target: Path) -> None:
        with rasterio.open(target, "w", **profile, bigtiff="if_safer") as data:
            if descriptions:
                data.descriptions = tuple(descriptions)
            data.update_tags(**(tags or {}))
            data.update_tags(ns="RPC", **rpc)
            for place in places:
                values = np.ascontiguousarray(block_of(*place), np.float32)
                sums.append(zlib.crc32(values.data))
                data.write(values, window=Window.from_slices(*place))

    def check(target: Path) -> None:
        with rasterio.open(target) as data:
            for place, expected in zip(places, sums, strict=True):
                found = np.ascontiguousarray(data.read(window=Window.from_slices(*place)))
                if zlib.crc32(found.data) != expected:
                    raise OSError(5, "found other pixels than were written")

    with not_georeferenced:
        write_with(path, write, check)


def sensor_profile(dtype: np.dtype | str, bands: int, height: int, width: int, nodata: float | None) -> dict[str, Any]:
    """Rasterio profile of an image in sensor geometry, without its camera.

    Args:
        dtype: of the pixels.
        bands: number of bands.
        height: rows [px].
        width: columns [px].
        nodata: value, or None.
    """
    profile: dict[str, Any] = {"driver": "GTiff", "dtype": dtype, "count": bands, "height": height, "width": width}
    # images hold much noise: the default level makes their files 2 % smaller and `prep` a twentieth dearer
    profile |= {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate", "zlevel": 1}
    profile["predictor"] = 3 if np.issubdtype(np.dtype(dtype), np.floating) else 2
    return profile if nodata is None else profile | {"nodata": nodata}


def _blocks(shape: tuple[int, int], bands: int, source: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """Rows and columns, about `_VALUES` values each, so that little of the source is unpacked more than once."""
    height, width = shape
    if source[1] >= width:
        rows, cols = TILE, width
        while rows > _LEAST_ROWS and rows * width * bands > _VALUES:
            rows //= 2
    else:
        rows = min(-(-source[0] // TILE) * TILE, _MOST_ROWS)
        while rows > TILE and rows * TILE * bands > _VALUES:
            rows -= TILE
        cols = max(1, _VALUES // (bands * rows * TILE)) * TILE
    for row in range(0, height, rows):
        for col in range(0, width, cols):
            yield slice(row, min(row + rows, height)), slice(col, min(col + cols, width))


__all__ = ["TILE", "sensor_profile", "write_sensor_blocks", "write_sensor_image", "write_sensor_maps"]

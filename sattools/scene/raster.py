"""Reading and writing rasters: the one I/O layer of the suite.

Everything is written under a temporary name in the target's folder and renamed when complete, so that an interrupted
command never leaves half a file.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.windows import Window

from sattools.errors import InputError, SattoolsError
from sattools.scene.grid import Grid
from sattools.scene.memory import check_memory
from sattools.scene.opening import opened

_STRIP_PIXELS = 2_000_000  # of an image that are held at a time where it is read reduced


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it on success, remove it on any failure.

    Raises:
        SattoolsError: the folder is not writable or the disk is full.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=".tmp" + path.suffix, dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise SattoolsError(f"{path}: cannot be written ({error.strerror}), expected a writable folder") from error
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes files private; a product has the permissions any other new file would have
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except (OSError, RasterioError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise SattoolsError(f"{path}: cannot be written ({reason})") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_cog(
    path: Path,
    array: np.ndarray,
    grid: Grid,
    *,
    nodata: float | None = float("nan"),
    units: str | None = None,
    tags: Mapping[str, str] | None = None,
    descriptions: Sequence[str] | None = None,
) -> None:
    """Write a cloud-optimised GeoTIFF.

    Args:
        path: target file.
        array: ``[H, W]`` or ``[B, H, W]``; float64 is stored as float32, bool as uint8.
        grid: its georeference; shapes must agree.
        nodata: no-data value (NaN for float products).
        units: unit of the bands, e.g. ``"m"``.
        tags: dataset tags, e.g. the vertical datum.
        descriptions: one name per band.

    Raises:
        SattoolsError: wrong shape, or the file cannot be written.
    """
    array = np.asarray(array)
    if array.ndim == 2:
        array = array[None]
    if array.shape[1:] != grid.shape:
        raise SattoolsError(f"{path}: found an array of {array.shape[1:]}, expected the grid's {grid.shape}")
    if array.dtype == np.float64:
        array = array.astype(np.float32)
    elif array.dtype == bool:
        array = array.astype(np.uint8)
    is_float = np.issubdtype(array.dtype, np.floating)
    with atomic(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.MemoryFile() as memory:
            with memory.open(
                driver="GTiff",
                dtype=array.dtype,
                count=array.shape[0],
                height=grid.height,
                width=grid.width,
                crs=grid.crs,
                transform=grid.transform,
                nodata=nodata if is_float or nodata is None or np.isfinite(nodata) else None,
            ) as data:
                data.write(array)
                if units:
                    data.units = [units] * array.shape[0]
                if descriptions:
                    data.descriptions = tuple(descriptions)
                data.update_tags(**(tags or {}))
            with memory.open() as data:
                rasterio.shutil.copy(
                    data,
                    temporary,
                    driver="COG",
                    compress="DEFLATE",
                    predictor="YES",
                    overview_resampling="average" if is_float else "nearest",
                )


def read_raster(path: Path, within: Grid | None = None) -> tuple[np.ndarray, Grid]:
    """Read a georeferenced north-up raster, or the part of it that lies within a grid whose edges lie on its cells.

    Returns:
        ``[B, H, W]`` array in the file's type (float no-data becomes NaN), and its grid.

    Raises:
        InputError: unreadable, without CRS, or not north-up with square cells.
    """
    with opened(path) as data:
        grid = _grid_of(data, path)
        window = None
        if within is not None:
            rows, cols = grid.window(within)
            window = Window.from_slices(rows, cols)
            grid = grid.part(rows, cols)
        check_memory(
            8.0 * data.count * grid.width * grid.height, f"{path}: {grid.width} x {grid.height} cells", "crop it"
        )
        array = _read(data, path, window)
        if np.issubdtype(array.dtype, np.floating) and data.nodata is not None and np.isfinite(data.nodata):
            array = np.where(array == data.nodata, np.nan, array)
    return array, grid


def raster_grid(path: Path) -> Grid:
    """The grid of a georeferenced north-up raster; raises as `read_raster` does."""
    with opened(path) as data:
        return _grid_of(data, path)


def _grid_of(data: rasterio.DatasetReader, path: Path) -> Grid:
    transform = data.transform
    if data.crs is None:
        raise InputError(f"{path}: found no coordinate reference system, expected a georeferenced raster")
    if abs(transform.b) > 1e-9 or abs(transform.d) > 1e-9 or abs(transform.a + transform.e) > 1e-6 * abs(transform.a):
        raise InputError(f"{path}: found a rotated or non-square grid, expected north-up square cells")
    return Grid(data.crs.to_string(), transform.c, transform.f, transform.a, data.width, data.height)


def image_shape(path: Path) -> tuple[int, int]:
    """(rows, columns) of an image. Raises InputError where it cannot be read."""
    with opened(path) as data:
        return data.height, data.width


def read_image(path: Path, window: tuple[slice, slice] | None = None, reduce: int = 1) -> np.ndarray:
    """Read an image of any sensor geometry as ``[B, H, W]`` float32; no-data becomes NaN.

    Args:
        path: the file.
        window: rows and columns to read, within the image; None = all.
        reduce: pixels, along either axis, of which the mean is taken while reading; rows and columns that are left
            over at the end are dropped, and a mean without half of its pixels is NaN.

    Raises:
        InputError: missing, truncated or not an image.
    """
    with opened(path) as data:
        rows, cols = window or (slice(0, data.height), slice(0, data.width))
        pixels = data.count * (rows.stop - rows.start) * (cols.stop - cols.start) // reduce**2
        check_memory(8.0 * pixels, f"{path}: {data.width} x {data.height} pixels", "crop it, or `prep --aoi`")
        if reduce == 1:
            return _numbers(data, path, rows, cols)
        height, width = (rows.stop - rows.start) // reduce, (cols.stop - cols.start) // reduce
        array = np.empty((data.count, height, width), np.float32)
        strip = max(1, _STRIP_PIXELS // (reduce * (cols.stop - cols.start)))
        for row in range(0, height, strip):
            some = min(strip, height - row)
            first = rows.start + row * reduce
            piece = _numbers(data, path, slice(first, first + some * reduce), cols)[..., : width * reduce]
            array[:, row : row + some] = _means(piece.reshape(data.count, some, reduce, width, reduce))
    return array


def _numbers(data: rasterio.DatasetReader, path: Path, rows: slice, cols: slice) -> np.ndarray:
    whole = (rows, cols) == (slice(0, data.height), slice(0, data.width))
    window = None if whole else Window(cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
    array = _read(data, path, window).astype(np.float32)
    if data.nodata is not None and np.isfinite(data.nodata):
        array[array == np.float32(data.nodata)] = np.nan
    return array


def _means(blocks: np.ndarray) -> np.ndarray:
    """Means ``[B, H, W]`` of ``[B, H, n, W, n]``; NaN where fewer than half of the pixels are known."""
    known = np.isfinite(blocks)
    count = known.sum(axis=(2, 4))
    total = np.where(known, blocks, 0.0).sum(axis=(2, 4))
    return np.where(2 * count >= blocks.shape[2] * blocks.shape[4], total / np.maximum(count, 1), np.nan)


def write_image_like(path: Path, array: np.ndarray, like: Path, descriptions: Sequence[str] | None = None) -> None:
    """Write a float32 image ``[B, H, W]`` (NaN = no data) in the sensor geometry of another one, whose RPC it takes.

    Raises:
        InputError: ``like`` cannot be read.
        SattoolsError: the file cannot be written.
    """
    with opened(like) as source:
        rpc = source.tags(ns="RPC")
    bands, height, width = array.shape
    with atomic(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            temporary, "w", driver="GTiff", dtype="float32", count=bands, height=height, width=width,
            nodata=float("nan"), tiled=True, blockxsize=256, blockysize=256, compress="deflate", predictor=3,
        ) as data:  # fmt: skip
            data.write(array.astype(np.float32))
            if descriptions:
                data.descriptions = tuple(descriptions)
            if rpc:
                data.update_tags(ns="RPC", **rpc)


def _read(data: rasterio.DatasetReader, path: Path, window: Window | None = None) -> np.ndarray:
    try:
        return data.read(window=window)
    except RasterioError as error:
        raise InputError(
            f"{path}: found a damaged or truncated image ({data.count} bands, {data.width} x {data.height} expected)"
        ) from error


__all__ = [
    "atomic",
    "image_shape",
    "raster_grid",
    "read_image",
    "read_raster",
    "write_cog",
    "write_image_like",
    "write_text",
]

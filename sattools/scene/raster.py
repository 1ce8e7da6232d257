"""Reading and writing rasters: the one I/O layer of the suite."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.enums import MaskFlags
from rasterio.errors import RasterioError
from rasterio.windows import Window

from sattools.errors import InputError
from sattools.scene.cog import CogWriter
from sattools.scene.datums import ELLIPSOID, is_solid, vertical_of
from sattools.scene.grid import Grid
from sattools.scene.memory import check_memory
from sattools.scene.opening import opened
from sattools.scene.placement import grid_of, is_south_up, stored_window
from sattools.scene.regrid import reproject_map, windows_around
from sattools.scene.values import meant

_STRIP_PIXELS = 2_000_000  # of an image that are held at a time where it is read reduced


def write_cog(
    path: Path,
    array: np.ndarray,
    grid: Grid,
    *,
    nodata: float | None = float("nan"),
    units: str | None = None,
    tags: Mapping[str, str] | None = None,
    descriptions: Sequence[str] | None = None,
    vertical: str | None = None,
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
        vertical: CRS of the numbers where they are heights above a geoid, e.g. ``"EPSG:5773"``: the file's CRS is then
            compound.

    Raises:
        SattoolsError: wrong shape, or the file cannot be written.
    """
    array = np.asarray(array)
    array = array[None] if array.ndim == 2 else array
    about: dict[str, Any] = {"nodata": nodata, "units": units, "tags": tags, "descriptions": descriptions}
    with CogWriter(path, grid, bands=array.shape[0], dtype=array.dtype, vertical=vertical, **about) as out:
        out.write(array)


def read_raster(path: Path, within: Grid | None = None, stored: bool = False) -> tuple[np.ndarray, Grid]:
    """Read a georeferenced raster, or the part of it that lies within a grid whose edges lie on its cells.

    One that is stored from south to north is turned over.

    Args:
        path: the file.
        within: see above; None = all.
        stored: the numbers as they stand in the file, instead of what its scale, offset and unit make of them.

    Returns:
        ``[B, H, W]`` array in the file's type where that can say all (see `sattools.scene.values.meant`; no-data
        becomes NaN), and its grid.

    Raises:
        InputError: unreadable, without CRS, turned or not of square cells.
    """
    with opened(path) as data:
        grid = grid_of(data, path)
        window = None
        if within is not None:
            rows, cols = grid.window(within)
            window = stored_window(data, rows, cols)
            grid = grid.part(rows, cols)
        check_memory(
            8.0 * data.count * grid.width * grid.height, f"{path}: {grid.width} x {grid.height} cells", "crop it"
        )
        array = _read(data, path, window) if stored else read_window(data, path, window)
        if is_south_up(data):
            array = array[:, ::-1]
    return array, grid


def read_window(data: rasterio.DatasetReader, path: Path, window: Window | None = None) -> np.ndarray:
    """Some pixels ``[B, H, W]`` of an open file, rows as stored; the numbers as `read_raster` has them.

    Args:
        data: the file.
        path: its name, for messages.
        window: what is read; None = all.

    Raises:
        InputError: they cannot be read.
    """
    return meant(_read(data, path, window), data, window)


def read_overview(path: Path, cells: int = 400_000) -> tuple[np.ndarray, Grid]:
    """`read_raster` for looking at: on so many times larger cells that there are no more than about ``cells``.

    Float maps become means, others keep the values of some cells. Rows and columns left over at the end are dropped.

    Args:
        path: the file.
        cells: see above.

    Raises:
        InputError: as `read_raster`.
    """
    with opened(path) as data:
        grid = grid_of(data, path)
        step = math.ceil(math.sqrt(max(1.0, grid.width * grid.height / cells)))
        if step == 1:
            return read_raster(path)
        rows, cols = grid.height // step, grid.width // step
        window = stored_window(data, slice(0, rows * step), slice(0, cols * step))
        array = _decimated(data, path, window, (rows, cols), np.issubdtype(np.dtype(data.dtypes[0]), np.floating))
        if is_south_up(data):
            array = array[:, ::-1]
    return array, Grid(grid.crs, grid.left, grid.top, grid.cell_size * step, cols, rows)


def read_some_pixels(path: Path, pixels: int = 4_000_000) -> np.ndarray:
    """About so many pixels ``[B, h, w]`` of an image, at even distances; NaN = no data.

    They are those of an overview where the file brings one.

    Args:
        path: the file.
        pixels: see above.

    Raises:
        InputError: as `read_image`.
    """
    with opened(path) as data:
        step = math.ceil(math.sqrt(max(1.0, data.width * data.height / pixels)))
        shape = math.ceil(data.height / step), math.ceil(data.width / step)
        array = _decimated(data, path, Window(0, 0, data.width, data.height), shape, False).astype(np.float32)
        if data.nodata is not None and np.isfinite(data.nodata):
            array[array == np.float32(data.nodata)] = np.nan
        if has_mask(data):
            array[:, data.dataset_mask(out_shape=shape) == 0] = np.nan
    return array


def has_mask(data: rasterio.DatasetReader) -> bool:
    """Whether a mask says which pixels are data; transparency is another thing."""
    return bool(data.mask_flag_enums[0] == [MaskFlags.per_dataset])


def _decimated(
    data: rasterio.DatasetReader, path: Path, window: Window, shape: tuple[int, int], means: bool
) -> np.ndarray:
    from rasterio.enums import Resampling

    try:
        return data.read(
            window=window,
            out_shape=(data.count, *shape),
            resampling=Resampling.average if means else Resampling.nearest,
        )
    except RasterioError as error:
        raise _damaged(data, path) from error


def read_on(path: Path, target: Grid, nearest: bool = False) -> np.ndarray:
    """A raster ``[B, h, w]`` on another grid, of which only the part that lies there is read.

    Args:
        path: the file.
        target: the grid; NaN where the raster is not.
        nearest: take the nearest cell instead of interpolating.

    Raises:
        InputError: as `read_raster`.
    """
    found = read_around(path, target)
    if found is None:
        return np.full((1, *target.shape), np.nan, np.float32)
    return reproject_map(*found, target, nearest=nearest)


def read_around(path: Path, target: Grid) -> tuple[np.ndarray, Grid] | None:
    """The part of a raster ``[B, h, w]`` that lies on another grid, and a little more; None where there is none.

    Across the edges of one that goes around the globe, too.

    Args:
        path: the file.
        target: grid in any CRS.

    Raises:
        InputError: as `read_raster`.
    """
    grid = raster_grid(path)
    found = windows_around(grid, target)
    if not found:
        return None
    pieces = [read_raster(path, grid.part(*window))[0] for _, window in found]
    turn, (rows, cols) = found[0]
    array = pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=2)
    return array, grid.moved(turn, 0.0).part(rows, slice(cols.start, cols.start + array.shape[2]))


def raster_grid(path: Path) -> Grid:
    """The grid of a georeferenced raster; raises as `read_raster` does."""
    with opened(path) as data:
        return grid_of(data, path)


def raster_bands(path: Path) -> int:
    """Number of bands of an image or map. Raises InputError where it cannot be read."""
    with opened(path) as data:
        return int(data.count)


def raster_vertical(path: Path) -> str | None:
    """The vertical part of a raster's compound CRS, e.g. ``"EPSG:5773"``; None where it has none."""
    with opened(path) as data:
        return None if data.crs is None else vertical_of(data.crs)


def heights_above(path: Path) -> str | None:
    """What a raster's heights are above: the code of its vertical CRS, ``ellipsoid``, or None where nothing says so.

    A compound CRS says it, a three-dimensional one, or the tag ``VERTICAL_DATUM`` of our own files.
    """
    with opened(path) as data:
        own = None if data.crs is None else vertical_of(data.crs)
        tag = data.tags().get("VERTICAL_DATUM")
        solid = data.crs is not None and is_solid(data.crs)
    if own is not None:
        return own
    return "ellipsoid" if solid or tag == ELLIPSOID else tag


def datum_tag(path: Path) -> str | None:
    """The tag ``VERTICAL_DATUM`` of a raster; of one without it what its CRS says where that is the ellipsoid."""
    with opened(path) as data:
        tag = data.tags().get("VERTICAL_DATUM")
    return ELLIPSOID if tag is None and heights_above(path) == "ellipsoid" else tag


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
            array[:, row : row + some] = block_means(piece.reshape(data.count, some, reduce, width, reduce))
    return array


def _numbers(data: rasterio.DatasetReader, path: Path, rows: slice, cols: slice) -> np.ndarray:
    whole = (rows, cols) == (slice(0, data.height), slice(0, data.width))
    window = None if whole else Window(cols.start, rows.start, cols.stop - cols.start, rows.stop - rows.start)
    array = _read(data, path, window).astype(np.float32)
    if data.nodata is not None and np.isfinite(data.nodata):
        array[array == np.float32(data.nodata)] = np.nan
    if has_mask(data):
        array[:, data.dataset_mask(window=window) == 0] = np.nan
    return array


def block_means(blocks: np.ndarray) -> np.ndarray:
    """Means ``[B, H, W]`` of ``[B, H, n, W, n]``; NaN where fewer than half of the pixels are known."""
    known = np.isfinite(blocks)
    count = known.sum(axis=(2, 4))
    total = np.where(known, blocks, 0.0).sum(axis=(2, 4))
    return np.where(2 * count >= blocks.shape[2] * blocks.shape[4], total / np.maximum(count, 1), np.nan)


def _read(data: rasterio.DatasetReader, path: Path, window: Window | None = None) -> np.ndarray:
    try:
        return data.read(window=window)
    except RasterioError as error:
        raise _damaged(data, path) from error


def _damaged(data: rasterio.DatasetReader, path: Path) -> InputError:
    return InputError(
        f"{path}: found a damaged or truncated image ({data.count} bands, {data.width} x {data.height} expected)"
    )


__all__ = [
    "block_means",
    "datum_tag",
    "has_mask",
    "heights_above",
    "image_shape",
    "raster_bands",
    "raster_grid",
    "raster_vertical",
    "read_around",
    "read_image",
    "read_on",
    "read_overview",
    "read_raster",
    "read_some_pixels",
    "read_window",
    "write_cog",
]

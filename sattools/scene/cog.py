"""Cloud-optimised GeoTIFFs that are written block by block: the memory of a block, whatever the size of the map."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import ColorInterp, Resampling
from rasterio.windows import Window

from sattools.errors import SattoolsError
from sattools.processors import side_by_side
from sattools.scene.datums import compound
from sattools.scene.files import scratch, write_bytes, write_with
from sattools.scene.gdal import ERRORS, not_georeferenced, quiet_libtiff, why_not_written
from sattools.scene.grid import Grid
from sattools.scene.stored import cut

IN_MEMORY = 8 << 20  # bytes up to which a map is put together in memory
TILE = 512  # cells along an edge: blocks that begin on multiples of it are written fastest
AT_ONCE = 4  # of these that are made at a time
_CACHE = 16 << 20  # bytes for GDAL
_COLOURS = {"red": ColorInterp.red, "green": ColorInterp.green, "blue": ColorInterp.blue}


def _colours_of(descriptions: Sequence[str]) -> list[ColorInterp] | None:
    """What viewers show bands as, by the last words of their names; None where not all three colours are there once.

    Three bands of which only the numbers are known are taken for red, green and blue, as in pictures.
    """
    words = [text.rpartition(" ")[2].lower() for text in descriptions]
    if words == ["1", "2", "3"]:
        return list(_COLOURS.values())
    if any(words.count(colour) != 1 for colour in _COLOURS):
        return None
    return [_COLOURS.get(word, ColorInterp.undefined) for word in words]


class CogWriter:
    """A map that is written in pieces, in any order; used by ``with``, at the end of which the file is there.

    Args:
        path: target file.
        grid: its georeference.
        bands: number of bands.
        dtype: of the cells; float64 is stored as float32, bool as uint8.
        nodata: no-data value (NaN for float maps).
        vertical: CRS of heights, e.g. ``"EPSG:5773"``, to be compounded with the grid's.
        units: unit of the bands, e.g. ``"m"``.
        tags: dataset tags, e.g. the vertical datum.
        descriptions: one name per band.

    Raises:
        SattoolsError: the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        grid: Grid,
        *,
        bands: int = 1,
        dtype: Any = np.float32,
        nodata: float | None = float("nan"),
        vertical: str | None = None,
        units: str | None = None,
        tags: Mapping[str, str] | None = None,
        descriptions: Sequence[str] | None = None,
    ) -> None:
        self.path, self.grid = Path(path), grid
        kind = np.dtype(dtype)
        self.dtype = np.dtype(np.float32) if kind == np.float64 else np.dtype(np.uint8) if kind.kind == "b" else kind
        self._is_float = np.issubdtype(self.dtype, np.floating)
        self._stack, self._finished = ExitStack(), False
        self._profile = {
            "driver": "GTiff",
            "dtype": self.dtype,
            "count": bands,
            "height": grid.height,
            "width": grid.width,
            "crs": compound(grid.crs, vertical) if vertical else grid.crs,
            "transform": grid.transform,
            "nodata": nodata if self._is_float or nodata is None or np.isfinite(nodata) else None,
        }
        self._about = (units, dict(tags or {}), descriptions)
        #: whether it is made in memory
        self.small = bands * grid.height * grid.width * self.dtype.itemsize <= IN_MEMORY

    def __enter__(self) -> CogWriter:
        self._stack.enter_context(not_georeferenced)
        try:
            if self.small:
                self._memory = self._stack.enter_context(rasterio.MemoryFile())
                self._data = self._memory.open(**self._profile)
            else:
                self._raw = self._stack.enter_context(scratch(self.path))
                quiet_libtiff()
                # by bands: overviews of pixels take twice the memory and a quarter more seconds
                laid_out = {"tiled": True, "blockxsize": TILE, "blockysize": TILE, "interleave": "band"}
                laid_out["bigtiff"] = "if_safer"
                with rasterio.Env(GDAL_CACHEMAX=_CACHE):
                    self._data = rasterio.open(self._raw, "w", **self._profile, **laid_out)
        except (*ERRORS, OSError) as error:
            failed = self._failed(error)
            self._stack.close()
            raise failed from error
        units, tags, descriptions = self._about
        if units:
            self._data.units = [units] * self._data.count
        if descriptions:
            self._data.descriptions = tuple(descriptions)
            self._data.colorinterp = _colours_of(descriptions) or self._data.colorinterp
        self._data.update_tags(**tags)
        return self

    def write(self, array: np.ndarray, rows: slice | None = None, cols: slice | None = None) -> None:
        """Write a piece ``[h, w]`` or ``[B, h, w]``, of any unit, into these rows and columns; None = all of them.

        Raises:
            SattoolsError: wrong shape, or the file cannot be written.
        """
        rows, cols = rows or slice(0, self.grid.height), cols or slice(0, self.grid.width)
        array = np.asarray(array)
        array = array[None] if array.ndim == 2 else array
        wanted = (rows.stop - rows.start, cols.stop - cols.start)
        if array.shape[1:] != wanted:
            raise SattoolsError(f"{self.path}: found an array of {array.shape[1:]}, expected the grid's {wanted}")
        try:
            self._data.write(array.astype(self.dtype, copy=False), window=Window.from_slices(rows, cols))
        except (*ERRORS, OSError) as error:
            raise self._failed(error) from error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.finish()
            else:
                with suppress(*ERRORS):  # it has been told why
                    self._data.close()
        finally:
            self._stack.close()

    def finish(self) -> None:
        """Make the file of what has been written, unless that is done; the end of ``with`` does it otherwise.

        Raises:
            SattoolsError: the file cannot be written.
        """
        if self._finished:
            return
        self._finished = True
        try:
            self._data.close()
            if self.small:
                self._finish_small()
            else:
                self._finish_large()
        except ERRORS as problem:
            raise self._failed(problem) from problem

    @property
    def _resampling(self) -> Resampling:
        return Resampling.average if self._is_float else Resampling.nearest

    def _options(self) -> dict[str, Any]:
        # level 1 takes two thirds of the seconds of the usual 6 for 1 to 2 % more bytes
        packed = {"compress": "DEFLATE", "level": 1, "predictor": "YES"}
        return {"driver": "COG", **packed, "overview_resampling": self._resampling.name}

    def _overviews(self) -> list[int]:
        """Factors of the overviews that the driver of COGs would make: the smallest has no more than one tile."""
        factors = [1]
        while max(self.grid.shape) > TILE * factors[-1]:
            factors.append(2 * factors[-1])
        return factors[1:]

    def _finish_small(self) -> None:
        with rasterio.MemoryFile(ext=".tif") as optimised:
            with self._memory.open() as data:
                rasterio.shutil.copy(data, optimised.name, **self._options())
            write_bytes(self.path, optimised.getbuffer())

    def _finish_large(self) -> None:
        def optimise(target: Path) -> None:
            with rasterio.Env(GDAL_CACHEMAX=_CACHE):
                # not left to the driver, which compresses their tiles before they are whole, again and again, unless
                # its cache holds some rows of tiles of the map
                with rasterio.open(self._raw, "r+") as data:
                    data.build_overviews(self._overviews(), self._resampling)
                with rasterio.open(self._raw) as data:
                    made = {**self._options(), "overviews": "FORCE_USE_EXISTING", "bigtiff": "if_safer"}
                    rasterio.shutil.copy(data, os.fspath(target), **made)

        def check(target: Path) -> None:
            with rasterio.open(self._raw) as one, rasterio.open(target) as two:
                for place in cut(self.grid.shape):
                    window = Window.from_slices(*place)
                    if not np.array_equal(one.read(window=window), two.read(window=window), equal_nan=self._is_float):
                        raise OSError(5, "found other cells than were written")

        write_with(self.path, optimise, check)

    def _failed(self, error: Exception) -> SattoolsError:
        if not self.small and isinstance(error, ERRORS):
            error = why_not_written(self._raw, error)
        reason = " ".join(str(getattr(error, "strerror", None) or error).split())[:200]
        return SattoolsError(f"{self.path}: cannot be written ({reason})")


@contextmanager
def cogs(files: Collection[CogWriter]) -> Iterator[None]:
    """``with`` several files, of which those that are made in memory are made side by side at the end.

    Args:
        files: before their ``with``.

    Raises:
        SattoolsError: one of them cannot be written.
    """
    with ExitStack() as stack:
        for file in files:
            stack.enter_context(file)
        yield
        for _ in side_by_side(CogWriter.finish, [file for file in files if file.small], AT_ONCE):
            pass


__all__ = ["TILE", "CogWriter", "cogs"]

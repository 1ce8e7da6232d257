"""Cloud-optimised GeoTIFFs that are written block by block, so that the map never is in memory."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.windows import Window

from sattools.scene.files import scratch_name, write_with
from sattools.scene.grid import Grid

_BLOCK = 256  # of the scratch file


@dataclass(frozen=True)
class Layer:
    """A map that is going to be written.

    Attributes:
        path: target file.
        grid: its georeference.
        bands: number of bands.
        dtype: of the numbers.
        nodata: no-data value, or None.
        descriptions: one name per band.
        units: of the bands.
        tags: of the file.
    """

    path: Path
    grid: Grid
    bands: int = 1
    dtype: str = "float32"
    nodata: float | None = float("nan")
    descriptions: Sequence[str] = ()
    units: str | None = None
    tags: Mapping[str, str] = field(default_factory=dict)


class BlockWriter:
    """Takes the blocks of a layer in any order."""

    def __init__(self, layer: Layer, data: Any) -> None:
        self.layer, self._data = layer, data

    def write(self, rows: slice, cols: slice, array: np.ndarray) -> None:
        """Write the cells of these rows and columns.

        Args:
            rows: of the layer's grid.
            cols: of the layer's grid.
            array: ``[B, h, w]`` of the layer's unit.
        """
        self._data.write(array.astype(self.layer.dtype), window=Window.from_slices(rows, cols))


@contextmanager
def cog_by_blocks(layer: Layer) -> Iterator[BlockWriter]:
    """Write a cloud-optimised GeoTIFF by blocks; the file gets its name at the end, complete, or not at all.

    Raises:
        SattoolsError: it cannot be written.
    """
    layer.path.parent.mkdir(parents=True, exist_ok=True)
    scratch = scratch_name(layer.path)
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "dtype": layer.dtype,
        "count": layer.bands,
        "height": layer.grid.height,
        "width": layer.grid.width,
        "crs": layer.grid.crs,
        "transform": layer.grid.transform,
        "nodata": layer.nodata,
        "tiled": True,
        "blockxsize": _BLOCK,
        "blockysize": _BLOCK,
        "compress": "deflate",
        "zlevel": 1,
        "bigtiff": "if_safer",
    }
    try:
        with rasterio.open(scratch, "w", **profile) as data:
            if layer.descriptions:
                data.descriptions = tuple(layer.descriptions)
            if layer.units:
                data.units = [layer.units] * layer.bands
            data.update_tags(**layer.tags)
            yield BlockWriter(layer, data)
        write_with(layer.path, lambda target: _optimise(scratch, target, layer), lambda target: _check(scratch, target))
    finally:
        scratch.unlink(missing_ok=True)


def _optimise(source: Path, target: Path, layer: Layer) -> None:
    is_float = np.issubdtype(np.dtype(layer.dtype), np.floating)
    with rasterio.open(source) as data:
        rasterio.shutil.copy(
            data,
            os.fspath(target),
            driver="COG",
            compress="DEFLATE",
            predictor="YES",
            overview_resampling="average" if is_float else "nearest",
            bigtiff="IF_SAFER",
        )


def _check(source: Path, target: Path) -> None:
    """Raise OSError where a block of the two differs."""
    with rasterio.open(source) as one, rasterio.open(target) as other:
        for _, window in one.block_windows(1):
            if not np.array_equal(
                one.read(window=window), other.read(window=window), equal_nan=one.dtypes[0][0] == "f"
            ):
                raise OSError(5, "found other cells than were written")


__all__ = ["BlockWriter", "Layer", "cog_by_blocks"]

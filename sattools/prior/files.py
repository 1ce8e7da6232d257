"""Maps on an image's own pixels as files."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from sattools.camera.rpc import RPC
from sattools.scene.raster import atomic


def write_sensor_map(path: Path, array: np.ndarray, rpc: RPC, name: str, unit: str) -> None:
    """Write a map ``[rows, columns]`` float32 (NaN = unknown) as tiled GeoTIFF with the image's camera in its RPC tags.

    Raises:
        SattoolsError: the file cannot be written.
    """
    rows, cols = array.shape
    profile = {"driver": "GTiff", "height": rows, "width": cols, "count": 1, "dtype": "float32", "nodata": np.nan}
    profile |= {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate", "predictor": 3}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        # through memory: on a full disk GDAL closes a broken file without an error, Python's own write does not
        with rasterio.MemoryFile() as memory:
            with memory.open(**profile) as data:
                data.write(array.astype(np.float32), 1)
                data.units, data.descriptions = [unit], (name,)
                data.update_tags(SOFTWARE="sattools")
                data.update_tags(ns="RPC", **rpc.to_tags())
            with atomic(path) as temporary:
                temporary.write_bytes(memory.getbuffer())


__all__ = ["write_sensor_map"]

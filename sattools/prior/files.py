"""Maps on an image's own pixels as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sattools.camera.rpc import RPC
from sattools.scene.raster import write_sensor_image


def write_sensor_map(path: Path, array: np.ndarray, rpc: RPC, name: str, unit: str) -> None:
    """Write a map ``[rows, columns]`` float32 (NaN = unknown) as tiled GeoTIFF with the image's camera in its RPC tags.

    Raises:
        SattoolsError: the file cannot be written.
    """
    write_sensor_image(
        path, array[None].astype(np.float32), rpc.to_tags(), nodata=float("nan"), descriptions=[name], units=unit,
        tags={"SOFTWARE": "sattools"},
    )  # fmt: skip


__all__ = ["write_sensor_map"]

"""Which camera is an image's where its own RPC tags and a file beside it say different things."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio import warp
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader

from sattools.camera import RPC
from sattools.errors import InputError
from sattools.scene.gdal import rpc_tags
from sattools.scene.location import RemotePath
from sattools.scene.opening import opened

Array = NDArray[np.float64]

SAME_PX = 1.0  # as far as two files of one camera may differ by digits and conventions
_IN_PIXELS = {"col_offset", "row_offset", "col_scale", "row_scale"}
_MARGIN = 0.1  # of a camera's scale, by which vendors' are not centred on their image
_OTHER_PIXELS = 0.2  # of the logarithm of an image's size: more than such margins
_WHOLE_PX = 1e-3  # of a window's corner
_WHOLE_SHARE = 0.02  # of an image's size: where the camera of a whole image begins, and what size it tells


def own_camera(path: Path) -> RPC | None:
    """The camera in an image itself: GDAL says that of a file beside it where there is one.

    Args:
        path: of the image.
    """
    if isinstance(path, RemotePath):
        return None
    with suppress(InputError), opened(path, alone=True) as data:
        return RPC.from_tags(found, source=str(path)) if (found := rpc_tags(data)) else None
    return None


def of_another_window(beside: RPC, own: RPC, size: tuple[int, int]) -> tuple[float, float] | None:
    """Columns and rows [px] by which a camera beside an image is that of another window of the same whole; else None.

    Programs that cut images move the tags with them and leave files beside them as they are. Corrections of a camera
    move it by fractions of a pixel or change its polynomials.

    Args:
        beside: the camera in the file.
        own: that of the image's tags.
        size: (height, width) of the image [px].
    """
    if not _same_but_for({"col_offset", "row_offset"}, beside, own):
        return None
    apart = np.array([beside.col_offset - own.col_offset, beside.row_offset - own.row_offset])
    if np.abs(apart).max() <= SAME_PX or np.abs(apart - apart.round()).max() > _WHOLE_PX:
        return None
    if _of_larger(own, size) and not _of_larger(beside, size):
        return None  # cut without moving the tags, which somebody has put right in the file
    return float(apart[0]), float(apart[1])


def of_other_pixels(beside: RPC, own: RPC, size: tuple[int, int]) -> float | None:
    """How many pixels of an image that a camera beside it is of are one of the image's own, along an axis; else None.

    Programs that reduce images, and cut them by the way, adapt the tags and leave files beside them as they are.

    Args:
        beside: the camera in the file.
        own: that of the image's tags.
        size: (height, width) of the image [px].
    """
    if not _same_but_for(_IN_PIXELS, beside, own):
        return None
    counts = np.array([own.col_scale, own.row_scale])
    factors = np.array([beside.col_scale, beside.row_scale]) / counts
    if np.abs(factors - 1).max() < _WHOLE_SHARE or factors.min() <= 0:
        return None
    shares = np.abs(np.log(2 * np.abs(counts) / size[::-1])), np.abs(np.log(2 * np.abs(counts * factors) / size[::-1]))
    return float(np.sqrt(factors.prod())) if (shares[0] < shares[1]).all() else None


def made_for_other_pixels(rpc: RPC, size: tuple[int, int]) -> float | None:
    """By what the camera of a whole image counts more pixels along both sides than the image has, or fewer; else None.

    As vendors make them, cameras are centred on their image and scaled by half of it, but for some hundredths.

    Args:
        rpc: the camera.
        size: (height, width) of the image [px].
    """
    counts = np.array([rpc.col_scale, rpc.row_scale])
    starts = np.abs(np.array([rpc.col_offset, rpc.row_offset]) - counts) / counts
    ratios = 2 * counts / size[::-1]
    if ratios.min() <= 0 or np.abs(starts).max() > _MARGIN or np.ptp(np.log(ratios)) > _MARGIN:
        return None
    factor = float(np.sqrt(ratios.prod()))
    return factor if abs(np.log(factor)) > _OTHER_PIXELS else None


def _same_but_for(names: set[str], first: RPC, second: RPC) -> bool:
    others = {f.name for f in fields(RPC)} - names
    return all(np.allclose(getattr(first, n), getattr(second, n), rtol=1e-9, atol=1e-12) for n in others)


def georeference_of(data: DatasetReader) -> Array | None:
    """Longitude and latitude ``[9, 2]`` [degrees] that a file states for a 3 x 3 grid of its pixels; None = nothing."""
    if data.crs is None or data.transform.is_identity:
        return None
    col, row = _grid((data.height, data.width))
    a, b, c, d, e, f = data.transform[:6]
    x, y = a * (col + 0.5) + b * (row + 0.5) + c, d * (col + 0.5) + e * (row + 0.5) + f
    try:
        found = np.array(warp.transform(data.crs, "EPSG:4326", x, y)).T
    except RasterioError:
        return None
    return found if np.isfinite(found).all() else None


def beside_georeference(rpc: RPC, size: tuple[int, int], stated: Array) -> float:
    """By how many pixels a camera and a georeference of the same place are apart across an image, but for a shift.

    Map projected images for which the vendor has made the camera agree but for that: the height on which they lie is
    not known. A raw image's camera beside an orthophoto does not. 0 where they are of different places, too, as then
    the georeference means nothing.

    Args:
        rpc: the camera.
        size: (height, width) of the image [px].
        stated: see `georeference_of`.
    """
    pixel = np.stack(_grid(size), axis=1)
    seen = np.stack(rpc.projection(stated[:, 0], stated[:, 1], rpc.alt_offset), axis=1)
    height, width = size
    if not (np.isfinite(seen).all() and (np.abs(seen[4] - pixel[4]) < (width / 2, height / 2)).all()):
        return 0.0
    apart = (seen - seen.mean(axis=0)) - (pixel - pixel.mean(axis=0))
    return float(np.hypot(*apart.T).max())


def _grid(size: tuple[int, int]) -> tuple[Array, Array]:
    """Columns and rows ``[9]`` of the corners, the edges' middles and the middle (number 4) of an image."""
    row, col = np.meshgrid(*(np.linspace(0, n - 1, 3) for n in size), indexing="ij")
    return col.ravel(), row.ravel()


def _of_larger(rpc: RPC, size: tuple[int, int]) -> bool:
    """The camera looks like that of a whole image, as vendors make them, which is not of this size."""
    starts = abs(rpc.col_offset - rpc.col_scale) / rpc.col_scale, abs(rpc.row_offset - rpc.row_scale) / rpc.row_scale
    ratios = 2 * rpc.col_scale / size[1], 2 * rpc.row_scale / size[0]
    return max(starts) < _WHOLE_SHARE and max(ratios) > 1 + _WHOLE_SHARE


__all__ = [
    "SAME_PX",
    "beside_georeference",
    "georeference_of",
    "made_for_other_pixels",
    "of_another_window",
    "of_other_pixels",
    "own_camera",
]

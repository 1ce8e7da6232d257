"""What the numbers of a raster's file mean: which are none, by what they are scaled, in what they count heights."""

from __future__ import annotations

import re

import numpy as np
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.io import DatasetReader
from rasterio.windows import Window

_FEET = {
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), 0.3048),
    **dict.fromkeys(("us-ft", "usft", "ftus", "us survey foot", "us_survey_foot", "us survey feet"), 1200 / 3937),
}


_METRES = re.compile(r"m|met(er|re)s?\b.*|m[èe]tres?", re.IGNORECASE)


def is_length(unit: str | None) -> bool:
    """Whether a band's unit is one of heights, or says nothing."""
    return (unit or "").strip().lower() in ("", "unknown", *_FEET) or says_metres(unit)


def says_metres(unit: str | None) -> bool:
    """Whether a band's unit is metres, and not left open."""
    return _METRES.fullmatch((unit or "").strip()) is not None


def scale_of(data: DatasetReader, band: int = 0) -> tuple[float, float]:
    """Factor and offset that make of a band's numbers what they stand for: its scale and offset, metres of feet.

    Args:
        data: the open file.
        band: from 0.
    """
    feet = _FEET.get((data.units[band] or "").strip().lower(), 1.0)
    return feet * data.scales[band], feet * data.offsets[band]


def meant(array: np.ndarray, data: DatasetReader, window: Window | None = None) -> np.ndarray:
    """The numbers ``[B, H, W]`` of a file as what they stand for; NaN where it says that they are none.

    No-data numbers, masks and transparency say so. Whole numbers without a scale stay such where none is missing, and
    those of a byte always: they are codes.

    Args:
        array: as stored.
        data: the open file.
        window: from which the array is; None = all.
    """
    scales = [scale_of(data, band) for band in range(data.count)]
    if not np.issubdtype(array.dtype, np.number) or np.issubdtype(array.dtype, np.complexfloating):
        return array
    as_stored = all(scale == (1.0, 0.0) for scale in scales)
    if as_stored and array.dtype.itemsize == 1:
        return array
    known = _known(array, data, window)
    if known is not None:
        array = np.where(known, array, np.array(np.nan, np.result_type(array.dtype, np.float32)))
    if as_stored:
        return array
    factor, offset = (np.array(part).reshape(-1, 1, 1) for part in zip(*scales, strict=True))
    return (array * factor + offset).astype(np.float32)


def _known(array: np.ndarray, data: DatasetReader, window: Window | None) -> np.ndarray | None:
    """Where numbers are some; None where all are, or NaN says it."""
    known = None
    if data.nodata is not None and np.isfinite(data.nodata):
        known = array != data.nodata
    elif MaskFlags.per_dataset in data.mask_flag_enums[0]:
        known = np.broadcast_to(data.dataset_mask(window=window) > 0, array.shape)
    elif ColorInterp.alpha in data.colorinterp:  # of bytes and uint16 alone GDAL makes a mask, and warps floats to them
        known = np.broadcast_to(array[data.colorinterp.index(ColorInterp.alpha)] > 0, array.shape)
    return None if known is None or known.all() else known


__all__ = ["is_length", "meant", "says_metres", "scale_of"]

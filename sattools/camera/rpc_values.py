"""What a camera's tags hold, as numbers, or what is wrong with them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sattools.camera.rpc_names import SCALARS, VECTORS
from sattools.errors import InputError

Array = NDArray[np.float64]

# magnitudes that no camera over the Earth has; beyond them polynomials overflow
_LARGEST = {
    "LAT_OFF": 90.0,
    "LONG_OFF": 540.0,
    "HEIGHT_OFF": 1e5,
    "LAT_SCALE": 180.0,
    "LONG_SCALE": 360.0,
    "HEIGHT_SCALE": 1e6,
}
_LARGEST_NUMBER = 1e9
_SMALLEST_SCALE = 1e-9


def read_members(tags: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The members of an `RPC` by their names.

    Args:
        tags: GDAL's RPC metadata.
        source: file that is named in errors.

    Raises: InputError when a member is missing, not finite, of wrong length or a magnitude that no camera has.
    """
    values: dict[str, Any] = {}
    for key, name in SCALARS.items():
        values[name] = _number(tags, key, source)
    for key, name in VECTORS.items():
        values[name] = _twenty(tags, key, source)
    for key, name in SCALARS.items():
        value, largest = abs(values[name]), _LARGEST.get(key, _LARGEST_NUMBER)
        if key.endswith("SCALE") and value < _SMALLEST_SCALE:
            raise InputError(f"{source}: found {key} = {values[name]:g}, expected a scale different from 0")
        if value > largest:
            swapped = " (latitude and longitude swapped?)" if key == "LAT_OFF" and value <= 180.0 else ""
            raise InputError(f"{source}: found {key} = {values[name]:g}, expected at most {largest:g}{swapped}")
    for key, name in VECTORS.items():
        if np.abs(values[name]).max() > _LARGEST_NUMBER:
            worst = np.abs(values[name]).max()
            raise InputError(f"{source}: found {key} of up to {worst:g}, expected at most {_LARGEST_NUMBER:g}")
        if key.endswith("DEN_COEFF") and not values[name].any():
            raise InputError(f"{source}: found {key} that are all 0, expected a denominator")
    return values


def _number(tags: Mapping[str, Any], key: str, source: str) -> float:
    if key not in tags:
        raise InputError(f"{source}: found an RPC without {key}, expected all of {', '.join(SCALARS)}")
    try:
        value = float(str(tags[key]).split()[0])  # GDAL passes on units from a _RPC.TXT file: "5124.00 pixels"
    except (IndexError, ValueError):
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{source}: found {key} = {str(tags[key])[:40]!r}, expected a finite number")
    return value


def _twenty(tags: Mapping[str, Any], key: str, source: str) -> Array:
    if key in tags:
        raw = tags[key].split() if isinstance(tags[key], str) else list(tags[key])
    else:
        raw = [tags[f"{key}_{i}"] for i in range(1, 21) if f"{key}_{i}" in tags]
    try:
        values = np.array([float(c) for c in raw], np.float64)
    except (TypeError, ValueError):
        values = np.full(len(raw), np.nan)
    if values.size != 20 or not np.isfinite(values).all():
        usable = int(np.isfinite(values).sum())
        raise InputError(f"{source}: found {usable} usable {key} members of {values.size}, expected 20 finite numbers")
    values.flags.writeable = False
    return values


__all__ = ["read_members"]

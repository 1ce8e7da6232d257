"""Images that were cut out of a whole whose camera they keep: NITF's extension ICHIPB, and ENVI's offset of a tile."""

from __future__ import annotations

import math
from collections.abc import Mapping

from sattools.errors import InputError

_CORNERS = ("11", "12", "21")  # upper left, upper right, lower left
_STRAIGHT = 1e-6  # of a pixel of the chip: what its rows and columns may run across those of the whole


def camera_of_chip(rpc: Mapping[str, str], about: Mapping[str, str], name: str) -> dict[str, str]:
    """The RPC of an image that says which part of a whole it is; the one given where it says nothing.

    Source: STDI-0002, appendix B (ICHIPB): rows and columns of four pixels in the image ("output product") and in the
    whole ("full image"), both with the first pixel's middle at 0.5. The RPC beside it (appendix E) is that of the
    whole, and GDAL gives it as it stands.

    Args:
        rpc: GDAL's RPC metadata.
        about: GDAL's metadata of the image, which have the pixels as ``ICHIP_OP_ROW_11``, ``ICHIP_FI_ROW_11``, ...
        name: of the image, for messages.

    Raises:
        InputError: the image is turned against the whole.
    """
    try:
        chip, whole = (
            {(axis, k): float(about[f"ICHIP_{of}_{axis}_{k}"]) for axis in ("ROW", "COL") for k in _CORNERS}
            for of in ("OP", "FI")
        )
        numbers = {key: float(str(rpc[key]).split()[0]) for key in _MOVED}
    except (KeyError, ValueError, IndexError):
        return dict(rpc)
    found = dict(rpc)
    for axis, side, (along, across) in (("ROW", "LINE", ("21", "12")), ("COL", "SAMP", ("12", "21"))):
        length, run = chip[axis, along] - chip[axis, "11"], whole[axis, along] - whole[axis, "11"]
        if not (length and math.isfinite(run / length)):  # left empty
            return dict(rpc)
        step = run / length
        if not step or abs(whole[axis, across] - whole[axis, "11"]) > _STRAIGHT * abs(length):
            raise InputError(
                f"{name}: found an image that is turned against the whole whose RPC it has (ICHIPB), expected one that "
                "was cut out of it along rows and columns"
            )
        first = whole[axis, "11"] - step * (chip[axis, "11"] - 0.5) - 0.5
        if step != 1.0 or first:
            found[f"{side}_OFF"] = repr((numbers[f"{side}_OFF"] - first) / step)
            found[f"{side}_SCALE"] = repr(numbers[f"{side}_SCALE"] / step)
    return found


_MOVED = ("LINE_OFF", "SAMP_OFF", "LINE_SCALE", "SAMP_SCALE")

__all__ = ["camera_of_chip"]

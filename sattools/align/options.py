"""Options of `sattools align`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sattools.settings import option


@dataclass(frozen=True)
class AlignOptions:
    """Onto what a scene is brought, and how."""

    to: str | None = option(
        None,
        "Reference: a raster of heights (in the DSM's vertical datum), or a CSV of ground control points with the "
        "columns x, y (in the scene's CRS) or lon, lat; z; item, column, row (place in an image, 0 = centre of the "
        "first pixel).",
        path="file",
    )
    method: Literal["nuth-kaab", "z"] = option(
        "nuth-kaab", "For rasters: in all three directions by slopes (Nuth and Kaab), or in height only."
    )
    max_shift: float = option(100.0, "A shift larger than that is refused [m].", minimum=0.0, maximum=1e4)


__all__ = ["AlignOptions"]

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
        "Reference: a raster of heights (in the DSM's vertical datum), or ground control points: a CSV with the "
        "columns x, y (in the scene's CRS) or lon, lat; z; item, column, row (place in an image, 0 = centre of the "
        "first pixel), or points of a GeoPackage or GeoJSON with these columns (z may be the geometry's).",
        path="file",
    )
    method: Literal["auto", "means", "icp", "nuth-kaab", "z"] = option(
        "auto",
        "For rasters: in all three directions by means over the reference's cells, where these are at least twice as "
        "large as the DSM's, by iterated closest points and planes (the last part of a cell by means), or by slopes "
        "(Nuth and Kaab), which is for open ground; or in height only. auto: means where it can be, else icp.",
    )
    tilt: bool = option(False, "With means and icp: the plane that heights are off by, too.")
    max_shift: float = option(100.0, "A shift larger than that is refused [m].", minimum=0.0, maximum=1e4)


__all__ = ["AlignOptions"]

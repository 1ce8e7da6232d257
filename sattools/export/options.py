"""Options of `sattools export`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sattools.settings import option


@dataclass(frozen=True)
class ExportOptions:
    """What `export` writes."""

    vertical: Literal["ellipsoid", "egm96", "egm2008"] = option(
        "ellipsoid", "Heights above the WGS84 ellipsoid, or above a geoid whose grid PROJ has."
    )
    view: list[str] = option([], "Item to render as the model predicts it, in its own geometry (repeatable).")
    sun: tuple[float, float] | None = option(
        None, "Sun to relight the scene and the --view images with: azimuth and elevation [degrees]."
    )
    fill: bool = option(
        False, "Keep the heights and maps of ground that fewer than two images reach; product validity marks them."
    )


__all__ = ["ExportOptions"]

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


__all__ = ["ExportOptions"]

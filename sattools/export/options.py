"""Options of `sattools export`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from sattools.errors import InputError
from sattools.export.products.names import parse_names
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
    undetermined: Literal["nodata", "prior"] = option(
        "nodata",
        "Cells whose b, c, theta (k, asymmetry, rhoc) the images did not determine (product identifiable below 0.5): "
        "no data, or the value that the fit took, which is mostly its prior.",
    )
    products: list[str] = option(
        [],
        "What else to write, repeated or with commas between: laz and ply (point clouds), contours, dtm "
        "(bare ground, heights above it), ortho (true orthophoto), mesh (glTF) and obj (textured with it), tiles (3D "
        "Tiles of the mesh).",
    )
    ground_width: float = option(
        100.0,
        "Width of the widest building [m], where it is narrowest: what is wider counts as ground in product dtm.",
        minimum=1,
        maximum=1000,
    )
    contours: float | None = option(
        None, "Contour lines at multiples of so many metres of height, as a GeoPackage.", minimum=0.01
    )

    def __post_init__(self) -> None:
        parse_names(self.products)
        twice = next((name for k, name in enumerate(self.view) if name in self.view[:k]), None)
        if twice is not None:
            raise InputError(f"--view: found {twice!r} twice, expected every image once")
        if self.sun is None:
            return
        azimuth, elevation = self.sun
        if not (-360 <= azimuth <= 360 and 0 < elevation <= 90):
            raise InputError(
                f"--sun: found azimuth {azimuth:g} and elevation {elevation:g}, expected -360 to 360 degrees and a sun "
                "above the horizon, up to 90"
            )

    @property
    def wanted(self) -> list[str]:
        """Products beside the maps, see `sattools.export.products.names`."""
        return parse_names(self.products, self.contours)


def without_effect(options: ExportOptions, given: Iterable[str]) -> list[tuple[str, str]]:
    """Those of some options that do nothing beside the others, each with what was expected.

    Args:
        options: of the export.
        given: names of options that the user gave.
    """
    idle = {} if "dtm" in options.wanted else {"ground_width": "expected --products dtm beside it"}
    return [(name, idle[name]) for name in given if name in idle]


__all__ = ["ExportOptions", "without_effect"]

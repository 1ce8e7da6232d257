"""Vertical datums."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sattools.camera.ground import to_geographic
from sattools.errors import SattoolsError
from sattools.scene.datums import ELLIPSOID
from sattools.scene.grid import Grid

if TYPE_CHECKING:
    from pyproj import Transformer

# option -> (CRS, name, PROJ's file)
GEOIDS = {
    "egm96": ("EPSG:4326+5773", "EGM96 geoid", "us_nga_egm96_15.tif"),
    "egm2008": ("EPSG:4326+3855", "EGM2008 geoid", "us_nga_egm08_25.tif"),
}


def to_datum(height: np.ndarray, grid: Grid, vertical: str) -> tuple[np.ndarray, str]:
    """Ellipsoidal heights in another vertical datum, and the datum's name.

    Args:
        height: ``[H, W]`` [m].
        grid: ground grid.
        vertical: name of the datum.

    Raises:
        SattoolsError: PROJ has no grid for the geoid.
    """
    if vertical == "ellipsoid":
        return height, datum_name(vertical)
    from pyproj.exceptions import ProjError

    x, y = np.meshgrid(grid.x(), grid.y())
    lon, lat = to_geographic(grid.crs, x.ravel(), y.ravel())
    try:
        _, _, above = _transformer(vertical).transform(lon, lat, height.astype(np.float64).ravel(), errcheck=True)
    except ProjError as error:
        raise _no_grid(vertical) from error
    return np.asarray(above).reshape(height.shape), datum_name(vertical)


def check_datum(grid: Grid, vertical: str) -> None:
    """Raise SattoolsError where PROJ has no grid for a geoid at the middle of an area.

    Args:
        grid: ground grid.
        vertical: name of the datum.
    """
    middle = grid.part(*(slice(n // 2, n // 2 + 1) for n in grid.shape))
    to_datum(np.zeros((1, 1)), middle, vertical)


def check_grid(vertical: str) -> None:
    """Raise SattoolsError where PROJ has no grid for a geoid anywhere.

    Args:
        vertical: name of the datum.
    """
    if vertical in GEOIDS and not has_grid(vertical):
        raise _no_grid(vertical)


def _no_grid(vertical: str) -> SattoolsError:
    _, name, file = GEOIDS[vertical]
    return SattoolsError(
        f"--vertical {vertical}: found no grid of the {name} in PROJ, expected {file} "
        f"(fetch it with `sattools doctor --fetch-geoids`)"
    )


def datum_name(vertical: str) -> str:
    """What a datum is called in the tags of a raster."""
    return ELLIPSOID if vertical == "ellipsoid" else GEOIDS[vertical][1]


def vertical_crs(vertical: str) -> str | None:
    """CRS of the heights of a datum, e.g. ``"EPSG:5773"``; None for the ellipsoid, which needs none of its own."""
    return f"EPSG:{GEOIDS[vertical][0].partition('+')[2]}" if vertical in GEOIDS else None


def vertical_datum(path: Path) -> str:
    """What the heights of an exported surface model are above, by its tag."""
    from sattools.scene.opening import opened

    with opened(path) as data:
        return str(data.tags().get("VERTICAL_DATUM", ELLIPSOID))


def has_grid(vertical: str) -> bool:
    """Whether PROJ has the grid of a geoid."""
    from pyproj.exceptions import ProjError

    try:
        _transformer(vertical).transform(15.0, 46.0, 0.0, errcheck=True)
    except ProjError:
        return False
    return True


def _transformer(vertical: str) -> Transformer:
    from pyproj import Transformer

    # without the geoid's grid PROJ would silently hand the ellipsoidal heights back ("ballpark" transformation)
    return Transformer.from_crs("EPSG:4979", GEOIDS[vertical][0], always_xy=True, only_best=True, allow_ballpark=False)


__all__ = [
    "ELLIPSOID",
    "GEOIDS",
    "check_datum",
    "check_grid",
    "datum_name",
    "has_grid",
    "to_datum",
    "vertical_crs",
    "vertical_datum",
]

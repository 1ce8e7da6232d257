"""The horizontal and the vertical part of a coordinate reference system (CRS).

A grid knows its place on the map only; what its heights are above belongs to the file that holds them.
"""

from __future__ import annotations

import rasterio.crs
from pyproj import CRS
from pyproj.exceptions import CRSError


def horizontal(crs: rasterio.crs.CRS) -> str:
    """The part of a raster's CRS that says where it lies, e.g. ``"EPSG:32617"`` of a compound or 3D one."""
    parsed = _parsed(crs)
    if parsed is None or not (parsed.is_compound or len(parsed.axis_info) > 2):
        return str(crs.to_string())
    return str(rasterio.crs.CRS.from_wkt(parsed.to_2d().to_wkt()).to_string())


def vertical_of(crs: rasterio.crs.CRS) -> str | None:
    """The vertical part of a raster's compound CRS, by its code where it has one, e.g. ``"EPSG:5773"``, else None."""
    parsed = _parsed(crs)
    if parsed is None or not parsed.is_compound:
        return None
    part = parsed.sub_crs_list[1]
    code = part.to_authority()
    return ":".join(code) if code else str(part.to_wkt())


def compound(crs: str, vertical: str) -> rasterio.crs.CRS:
    """A horizontal CRS together with a vertical one; both keep their codes.

    Args:
        crs: of a grid, e.g. ``"EPSG:32617"``.
        vertical: of its heights, e.g. ``"EPSG:5773"``.
    """
    return rasterio.crs.CRS.from_wkt(compound_crs(crs, vertical).to_wkt("WKT1_GDAL"))


def compound_crs(crs: str, vertical: str) -> CRS:
    """`compound` as pyproj has it."""
    from pyproj.crs import CompoundCRS

    parts = CRS.from_user_input(crs), CRS.from_user_input(vertical)
    return CRS(CompoundCRS(" + ".join(part.name for part in parts), list(parts)).to_wkt())


def _parsed(crs: rasterio.crs.CRS) -> CRS | None:
    """As pyproj has it; None where it cannot."""
    try:
        return CRS.from_wkt(crs.to_wkt())
    except CRSError:
        return None


__all__ = ["compound", "compound_crs", "horizontal", "vertical_of"]

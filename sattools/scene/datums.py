"""The horizontal and the vertical part of a coordinate reference system (CRS).

A grid knows its place on the map only; what its heights are above belongs to the file that holds them.
"""

from __future__ import annotations

from collections.abc import Mapping

import rasterio.crs
from pyproj import CRS
from pyproj.exceptions import CRSError

ELLIPSOID = "WGS84 ellipsoid"  # tag of rasters whose heights are above it


def horizontal(crs: rasterio.crs.CRS) -> str:
    """The part of a raster's CRS that says where it lies, e.g. ``"EPSG:32617"`` of a compound or 3D one."""
    parsed = _parsed(crs)
    if parsed is None or not (parsed.is_compound or len(parsed.axis_info) > 2):
        return str(crs.to_string())
    flat = parsed.to_2d()
    text, name = flat.to_wkt(), flat.name
    if parsed.is_compound:  # GeoTIFF has one name for both parts where the horizontal one has no code
        added = f" + {parsed.sub_crs_list[1].name}"
        while name.endswith(added):
            name = name.removesuffix(added)
        text = text.replace(flat.name, name, 1)
    return str(rasterio.crs.CRS.from_wkt(text).to_string())


def vertical_of(crs: rasterio.crs.CRS) -> str | None:
    """The vertical part of a raster's compound CRS, by its code where it has one, e.g. ``"EPSG:5773"``, else None."""
    parsed = _parsed(crs)
    if parsed is None or not parsed.is_compound:
        return None
    part = parsed.sub_crs_list[1]
    code = part.to_authority()
    return ":".join(code) if code else str(part.to_wkt())


def is_solid(crs: rasterio.crs.CRS) -> bool:
    """Whether a CRS has three axes: its heights are above its own ellipsoid."""
    parsed = _parsed(crs)
    return parsed is not None and not parsed.is_compound and len(parsed.axis_info) > 2


def difference(names: Mapping[str, str | None]) -> str | None:
    """A sentence where surfaces are known to have heights above different things, else None.

    Args:
        names: what each is called -> what its heights are above (`sattools.scene.raster.heights_above`).
    """
    known = {name: above for name, above in names.items() if above is not None}
    if len(set(known.values())) < 2:
        return None
    found = ", ".join(f"{name} above {_words(above)}" for name, above in known.items())
    return f"heights are above different things ({found}): the difference between them is part of the result"


def _words(above: str) -> str:
    if above == "ellipsoid":
        return "the ellipsoid"
    try:
        return f"{CRS.from_user_input(above).name} ({above})"
    except CRSError:
        return above


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


__all__ = ["ELLIPSOID", "compound", "compound_crs", "difference", "horizontal", "is_solid", "vertical_of"]

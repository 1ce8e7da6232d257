"""Rasters as `xarray.DataArray` in rioxarray's convention; needs the extra `notebook`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sattools.errors import extra
from sattools.scene.opening import opened
from sattools.scene.raster import read_raster

if TYPE_CHECKING:
    import xarray


def data_array(path: Path, name: str) -> xarray.DataArray:
    """A georeferenced raster with coordinates of the cells' centres.

    Returns:
        ``(y, x)``, or ``(band, y, x)`` of more than one band, with the scalar coordinate `spatial_ref` (CRS as WKT and
        the affine transform), as `rioxarray.open_rasterio` gives it. Attributes are ``units``, where all bands have the
        same, and ``VERTICAL_DATUM`` (what heights are above), where the file has that tag.

    Raises:
        SattoolsError: xarray is not installed.
        InputError: the file cannot be read.
    """
    xarray = extra("xarray", "notebook")
    from rasterio.crs import CRS

    array, grid = read_raster(path)
    attributes = {"grid_mapping": "spatial_ref"}
    with opened(path) as data:
        units = set(data.units)
        if len(units) == 1 and (unit := units.pop()):
            attributes["units"] = unit
        if (datum := data.tags().get("VERTICAL_DATUM")) is not None:
            attributes["VERTICAL_DATUM"] = datum
    t = grid.transform
    about = {
        "crs_wkt": CRS.from_user_input(grid.crs).to_wkt(),
        "GeoTransform": f"{t.c} {t.a} {t.b} {t.f} {t.d} {t.e}",
    }
    coordinates: dict[str, Any] = {"y": grid.y(), "x": grid.x(), "spatial_ref": xarray.Variable((), 0, about)}
    dimensions: tuple[str, ...] = ("y", "x")
    if array.shape[0] == 1:
        array = array[0]
    else:
        dimensions, coordinates["band"] = ("band", *dimensions), np.arange(1, len(array) + 1)
    return xarray.DataArray(array, coordinates, dimensions, name, attributes)


__all__ = ["data_array"]

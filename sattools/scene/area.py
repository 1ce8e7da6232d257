"""The part of a scene's rectangle in which a surface is wanted: polygons of `prep --aoi`, without those of `--mask`."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sattools.scene.document import Scene
from sattools.scene.files import write_text
from sattools.scene.grid import Grid
from sattools.scene.vectors import in_crs, read_polygons

AREA = "area.geojson"  # href of the product "area"


def write_area(scene: Scene, area: Any) -> None:
    """Write the wanted area beside the scene's document.

    Args:
        scene: gets the product.
        area: shapely geometry in the CRS of the scene's grid.
    """
    from shapely.geometry import mapping

    (degrees,) = in_crs([area], scene.require_grid().crs, "EPSG:4326")
    feature = {"type": "Feature", "properties": {}, "geometry": mapping(degrees)}
    write_text(scene.output(AREA), json.dumps({"type": "FeatureCollection", "features": [feature]}) + "\n")
    scene.products["area"] = AREA


def wanted_cells(scene: Scene, grid: Grid) -> NDArray[np.bool_] | None:
    """Cells ``[H, W]`` of a grid whose centre lies in the scene's wanted area; None where all of the scene is wanted.

    Raises:
        InputError: the area's file cannot be read.
    """
    if "area" not in scene.products:
        return None
    from rasterio.features import geometry_mask

    path = scene.path(scene.products["area"])
    status = path.stat() if path.exists() else None
    shapes = _shapes(path, grid.crs, status.st_mtime_ns if status else 0)
    return np.asarray(geometry_mask(list(shapes), grid.shape, grid.transform, invert=True))


@functools.lru_cache(maxsize=4)
def _shapes(path: Path, crs: str, _: int) -> tuple[Any, ...]:
    return tuple(read_polygons(path, crs))


__all__ = ["AREA", "wanted_cells", "write_area"]

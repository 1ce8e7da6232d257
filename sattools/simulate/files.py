"""Files of a simulated scene: images with RPC tags, metadata, truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from sattools.camera.rpc import RPC
from sattools.camera.rpc_names import SCALARS, VECTORS
from sattools.scene.datums import ELLIPSOID
from sattools.scene.document import Scene
from sattools.scene.files import write_text
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import write_cog
from sattools.simulate.world import World


def sat_nerf_metadata(
    name: str, rpc: RPC, shape: tuple[int, int], sun: tuple[float, float], date: str, corners: list[list[float]]
) -> JsonObject:
    """The JSON that Sat-NeRF keeps beside an image; sun = (azimuth, elevation) in degrees, corners as [lon, lat].

    Args:
        name: of the image.
        rpc: the camera.
        shape: (rows, columns) [px].
        sun: see above.
        date: of the image.
        corners: see above.
    """
    middle = np.mean(corners, axis=0).tolist()
    members = {name: getattr(rpc, name) for name in (*SCALARS.values(), *VECTORS.values())}
    return {
        "img": name,
        "height": shape[0],
        "width": shape[1],
        "sun_elevation": f"{sun[1]:+.4f}",
        "sun_azimuth": f"{sun[0]:.4f}",
        "acquisition_date": date,
        "geojson": {"type": "Polygon", "coordinates": [corners], "center": middle},
        "rpc": {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in members.items()},
    }


def write_truth(scene: Scene, world: World, grid: Grid) -> None:
    """`truth/<id>_DSM.tif`, `_CLS.tif`, `_ALBEDO.tif` and `_DSM.txt` (the contest's layout); names them as products.

    `_DTM.tif` too where the bare ground is known.

    Args:
        scene: gets the products.
        world: what is seen.
        grid: ground grid.
    """
    east, north = np.meshgrid(grid.x(), grid.y())
    rasters: dict[str, tuple[str, np.ndarray, float | None, str | None]] = {
        "truth_dsm": ("DSM", world.surface(east, north).astype(np.float32), float("nan"), "m"),
        "truth_classes": ("CLS", world.on_grid(world.classes, grid), None, None),
        "truth_albedo": ("ALBEDO", world.on_grid(world.level_reflectance, grid).transpose(2, 0, 1), float("nan"), None),
    }
    if world.ground is not None:
        rasters["truth_dtm"] = ("DTM", world.on_grid(world.ground, grid).astype(np.float32), float("nan"), "m")
    for product, (suffix, array, nodata, units) in rasters.items():
        href = f"truth/{scene.id}_{suffix}.tif"
        above = {"VERTICAL_DATUM": ELLIPSOID} if units == "m" else None
        write_cog(scene.output(href), array, grid, nodata=nodata, units=units, tags=above)
        scene.products[product] = href
    west, south, _, _ = grid.bounds
    text = f"{west:.6f}\n{south:.6f}\n{grid.width:.6f}\n{grid.cell_size:.6f}\n"
    write_text(scene.output(f"truth/{scene.id}_DSM.txt"), text)


def write_json(path: Path, document: JsonObject) -> None:
    """A JSON file, one member a line."""
    write_text(path, json.dumps(document, indent=1) + "\n")

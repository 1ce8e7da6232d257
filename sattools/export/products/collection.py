"""The products as a STAC collection with one item, so that catalogues and browsers find them."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from sattools.camera.ground import to_geographic
from sattools.radiometry.bands import COMMON_NAMES
from sattools.scene import Scene
from sattools.scene.datums import horizontal, vertical_of
from sattools.scene.dependencies import STAGES, names_of
from sattools.scene.document import COG_TYPE
from sattools.scene.files import write_text, written
from sattools.scene.globe import outline_on_globe
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.members import instant
from sattools.scene.opening import opened

COLLECTION, ITEM = "export/collection.json", "export/item.json"
PRODUCTS = {"collection": COLLECTION, "collection_item": ITEM}
_PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
_RASTER = "https://stac-extensions.github.io/raster/v2.0.0/schema.json"
_EO = "https://stac-extensions.github.io/eo/v2.0.0/schema.json"
_TYPES = {
    ".tif": COG_TYPE,
    ".png": "image/png",
    ".laz": "application/vnd.laszip",
    ".ply": "application/octet-stream",
    ".gpkg": "application/geopackage+sqlite3",
    ".glb": "model/gltf-binary",
    ".obj": "model/obj",
    ".mtl": "model/mtl",
    ".json": "application/json",
}
_TITLES = {
    "dsm": "Surface model",
    "dsm_std": "Standard deviation of the surface model",
    "dsm_error95": "What 95 % of the errors of the surface model are below",
    "dsm_picture": "Picture of the surface model",
    "validity": "What was measured",
    "probability": "Probability of less than 1 m of error",
    "albedo": "Albedo",
    "points": "Point cloud (LAZ)",
    "points_ply": "Point cloud (PLY)",
    "contours": "Contour lines",
    "dtm": "Terrain model: the bare ground",
    "dtm_validity": "Where the ground was seen",
    "ndsm": "Height above the ground",
    "ortho": "True orthophoto",
    "ortho_source": "Image that a pixel of the orthophoto is from",
    "mesh": "Textured mesh (glTF)",
    "mesh_obj": "Textured mesh (OBJ)",
    "tileset": "3D Tiles of the mesh",
}


def write_collection(scene: Scene, grid: Grid) -> None:
    """Write the collection, and its item where the images say when they were taken; names both as products.

    Args:
        scene: with the exported products; is changed.
        grid: of the surface.
    """
    folder = scene.path(COLLECTION).parent
    made = names_of(STAGES["export"]) - PRODUCTS.keys()
    assets = {
        name: _asset(name, written(scene.path(href)), Path(os.path.relpath(scene.path(href), folder)).as_posix())
        for name, href in scene.products.items()
        if name in made
    }
    outline, box = _place(grid)
    times = sorted((str(t) for t in (item.properties.get("datetime") for item in scene.items) if t), key=instant)
    collection = {
        "type": "Collection",
        "stac_version": "1.1.0",
        "stac_extensions": _extensions(assets),
        "id": f"{scene.id}-products",
        "title": f"{scene.id}: surface and reflectance",
        "description": f"What sattools has made of {len(scene.items)} satellite images of {scene.id}.",
        "license": "other",
        "extent": {
            "spatial": {"bbox": [box]},
            "temporal": {"interval": [[times[0], times[-1]] if times else [None, None]]},
        },
        "links": [_link("self", COLLECTION), _link("root", COLLECTION), *([_link("item", ITEM)] if times else [])],
        "assets": assets,
    }
    _write(scene, "collection", collection)
    if times:
        item = {
            "type": "Feature",
            "stac_version": "1.1.0",
            "stac_extensions": _extensions(assets),
            "id": scene.id,
            "collection": collection["id"],
            "geometry": outline,
            "bbox": box,
            "properties": {
                "datetime": times[0] if times[0] == times[-1] else None,
                "start_datetime": times[0],
                "end_datetime": times[-1],
                "gsd": grid.cell_size,
            },
            "links": [
                _link("self", ITEM),
                *(_link(rel, COLLECTION) for rel in ("root", "parent", "collection")),
            ],
            "assets": assets,
        }
        _write(scene, "collection_item", item)


def _write(scene: Scene, product: str, document: JsonObject) -> None:
    href = PRODUCTS[product]
    write_text(scene.output(href), json.dumps(document, indent=1) + "\n")
    scene.products[product] = href


def _link(rel: str, href: str) -> JsonObject:
    """To a file of the same folder: relative, so that the folder can be moved."""
    kind = "application/geo+json" if href == ITEM else "application/json"
    return {"rel": rel, "href": f"./{Path(href).name}", "type": kind}


def _extensions(assets: JsonObject) -> list[str]:
    text = json.dumps(assets)
    prefixes = (("proj:", _PROJECTION), ("raster:", _RASTER), ("eo:", _EO))
    return [schema for prefix, schema in prefixes if f'"{prefix}' in text]


def _asset(name: str, path: Path, href: str) -> JsonObject:
    suffix = Path(href).suffix
    roles = ["overview", "thumbnail"] if name == "dsm_picture" else ["texture"] if name == "mesh_texture" else ["data"]
    asset: JsonObject = {"href": href, "type": _TYPES.get(suffix, "application/octet-stream"), "roles": roles}
    asset["title"] = _TITLES.get(name, name)
    return asset | (_raster(path) if suffix == ".tif" else {})


def _raster(path: Path) -> JsonObject:
    """What is true of a raster: where it lies, its numbers, its bands."""
    with opened(path) as data:
        code, above = horizontal(data.crs), vertical_of(data.crs)
        plain = code.startswith("EPSG:") and above is None
        about: JsonObject = {
            "proj:code": code if plain else None,
            "proj:shape": [data.height, data.width],
            "proj:transform": [float(v) for v in tuple(data.transform)[:6]],
            "proj:bbox": [float(v) for v in data.bounds],
            "raster:spatial_resolution": float(data.transform.a),
            "data_type": str(data.dtypes[0]),
        }
        if not plain:
            about["proj:wkt2"] = CRS.from_wkt(data.crs.to_wkt()).to_wkt("WKT2_2019")
        if data.nodata is not None:
            about["nodata"] = "nan" if np.isnan(data.nodata) else float(data.nodata)
        if data.units[0]:
            about["unit"] = data.units[0]
        lengths = str(data.tags().get("WAVELENGTHS_UM", "")).split()
        about["bands"] = [
            _band(str(text or f"band {k + 1}"), lengths[k] if len(lengths) == data.count else None)
            for k, text in enumerate(data.descriptions)
        ]
    return about


def _band(text: str, length: str | None) -> JsonObject:
    band: JsonObject = {"name": text}
    colour: Any = text.rpartition(" ")[2].lower()
    if colour in COMMON_NAMES:
        band["eo:common_name"] = colour
    if length is not None:
        band["eo:center_wavelength"] = float(length)
    return band


def _place(grid: Grid) -> tuple[JsonObject, list[float]]:
    """Outline and bounding box of a grid in degrees."""
    west, south, east, north = grid.bounds
    t = np.linspace(0.0, 1.0, 5)[:-1]
    x = np.concatenate([west + t * (east - west), 0 * t + east, east - t * (east - west), 0 * t + west])
    y = np.concatenate([0 * t + south, south + t * (north - south), 0 * t + north, north - t * (north - south)])
    lon, lat = (np.round(np.asarray(v), 7) for v in to_geographic(grid.crs, x, y))
    ring = [[float(a), float(b)] for a, b in zip(lon, lat)]
    return outline_on_globe([*ring, ring[0]])


__all__ = ["COLLECTION", "ITEM", "PRODUCTS", "write_collection"]

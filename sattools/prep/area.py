"""The area asked for: bounds on the command line or polygons of a vector file."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sattools.camera.ground import check_projected, from_geographic
from sattools.errors import InputError
from sattools.prep.layout import Bounds
from sattools.scene.jsonio import read_json
from sattools.scene.location import RemotePath
from sattools.scene.schema import shown
from sattools.scene.vectors import in_crs, is_geojson, polygons_in, read_features, read_polygons

log = logging.getLogger(__name__)
_SAME_M = 1.0
_AREAS = ("Polygon", "MultiPolygon")


def bounds_from_file(path: Path, crs: str) -> Bounds:
    """Bounds in `crs` [m] of all polygons of a GeoPackage, GeoJSON, shapefile, FlatGeobuf, KML or KMZ."""
    if isinstance(path, RemotePath) or is_geojson(path):
        return bounds_from_geojson(path, crs)
    boxes = np.array([shape.bounds for shape in read_polygons(path, crs)], dtype=np.float64)
    west, south = boxes[:, :2].min(axis=0)
    east, north = boxes[:, 2:].max(axis=0)
    return _box(np.array([west, east]), np.array([south, north]), str(path))


def bounds_from_geojson(path: Path, crs: str) -> Bounds:
    """Bounds in `crs` [m] of all polygons of a GeoJSON file; longitude and latitude unless the file names a CRS.

    Points and lines count where there are no polygons.

    The file may be remote, then as any vector file that GDAL reads from there.
    """
    if isinstance(path, RemotePath):
        return _from_afar(path, crs)
    document = read_json(path, "GeoJSON with the area of interest")
    places = _positions(document, _AREAS) or _positions(document)
    points = np.array(places, dtype=np.float64).reshape(-1, 2)
    if len(points) < 3 or not np.isfinite(points).all():
        raise InputError(f"{path}: found no polygon, expected GeoJSON with the area of interest")
    named = document.get("crs")
    for member in ("properties", "name"):
        named = named.get(member) if isinstance(named, dict) else None
    return _bounds_of(points, str(named or ""), crs, path)


def _bounds_of(points: np.ndarray, named: str, crs: str, path: Path) -> Bounds:
    if named and "CRS84" not in named and not named.endswith("4326"):
        return _transformed(points, named, crs, str(path))
    if np.abs(points[:, 0]).max() > 360 or np.abs(points[:, 1]).max() > 90:
        raise InputError(f"{path}: found coordinates that are no degrees, expected longitude and latitude (RFC 7946)")
    return _box(*from_geographic(crs, points[:, 0], points[:, 1]), str(path))


def _from_afar(path: RemotePath, crs: str) -> Bounds:
    """Bounds of a file on another machine or in an archive."""
    import shapely

    wanted = "an area of interest"
    found = read_features(path, wanted)
    shapes = [shape for shape in found.geometries if shape is not None and not shape.is_empty]
    if not shapes:
        raise InputError(f"{path}: found no polygon, expected {wanted}")
    areas = [shape for shape in map(polygons_in, shapes) if shape is not None]
    west, south, east, north = (float(v) for v in shapely.total_bounds(areas or shapes))
    corners = np.array([(west, south), (east, south), (east, north), (west, north)])
    return _bounds_of(corners, found.crs or "", crs, path)


def wanted_area(aoi: Path | None, masks: Sequence[Path], crs: str) -> Callable[[Bounds], Any]:
    """What is left of a rectangle in the polygons of the area of interest and outside of all masks.

    Args:
        aoi: vector file; None, or without polygons = everywhere.
        masks: vector files of polygons.
        crs: projected ground CRS [m].

    Returns:
        Function of bounds in ``crs``: the shapely geometry, or None where it is all of the rectangle.

    Raises:
        InputError: a file that cannot be read, masks without polygons.
    """
    import shapely

    inside = None if aoi is None else shapely.union_all(_polygons_of(aoi, crs))
    if aoi is not None and inside and not np.allclose(inside.bounds, bounds_from_file(aoi, crs), rtol=0, atol=_SAME_M):
        inside = None  # points and lines beside the polygons, or a CRS that only one of two readers knows
    outside = [shape for path in masks for shape in read_polygons(path, crs)]

    def within(bounds: Bounds) -> Any:
        box = shapely.box(*bounds)
        area = box if inside is None or inside.is_empty else inside.intersection(box)
        area = area.difference(shapely.union_all(outside)) if outside else area
        if area.is_empty:
            names = ", ".join(str(path) for path in (aoi, *masks) if path)
            raise InputError(f"{names}: found no ground that is left of the scene, expected some")
        return None if area.equals_exact(box, 1e-3, normalize=True) else area

    return within


def _polygons_of(path: Path, crs: str) -> list[Any]:
    try:
        return read_polygons(path, crs)
    except InputError as error:
        if isinstance(path, RemotePath):
            return []  # points and lines; what cannot be read has been told
        if not is_geojson(path):
            raise
        if _positions(read_json(path, "GeoJSON"), _AREAS):  # lines and points have bounds, too
            log.warning("%s (the box of all its places is taken)", error)
        return []


def bounds_from_numbers(numbers: Sequence[float], crs: str, given_crs: str | None) -> Bounds:
    """Bounds in `crs` from `--bounds W S E N`: in the CRS given with them, else in degrees.

    Args:
        numbers: west, south, east, north.
        crs: projected ground CRS [m].
        given_crs: in which they are given; None = degrees.
    """
    west, south, east, north = (float(v) for v in _four(numbers))
    if given_crs is None and 180 < west - east <= 360:  # across 180 degrees, as in the bbox of GeoJSON and STAC
        east += 360
    if not (np.isfinite([west, south, east, north]).all() and west < east and south < north):
        raise InputError(
            f"bounds: found {west:.9g} {south:.9g} {east:.9g} {north:.9g}, expected west < east and south < north"
        )
    if given_crs is not None:
        check_projected(given_crs)
        return west, south, east, north
    if max(abs(west), abs(east)) > 360 or max(abs(south), abs(north)) > 90:
        raise InputError("bounds: found numbers that are no degrees, expected --crs with bounds in metres")
    t = np.linspace(0, 1, 5)
    x, y = np.meshgrid(west + t * (east - west), south + t * (north - south))
    return _box(*from_geographic(crs, x.ravel(), y.ravel()), "bounds")


def exchanged_bounds(area: Path | Sequence[float], crs: str) -> Bounds | None:
    """Bounds in `crs` [m] of an area with its latitudes taken for longitudes and the other way round.

    None where that is no area either, or the area is not given in degrees.

    Args:
        area: vector file, or numbers as of `--bounds` (south, west, north, east, if they are exchanged).
        crs: projected ground CRS [m].
    """
    from pyproj.exceptions import ProjError

    try:
        first, second, last, other = _box_in_degrees(area) if isinstance(area, Path) else _four(area)
        return bounds_from_numbers((second, first, other, last), crs, None)
    except (InputError, ProjError):
        return None


def _four(numbers: Sequence[float]) -> Sequence[float]:
    if len(numbers) != 4:
        raise InputError(f"bounds: found {shown(list(numbers))}, expected four numbers: west, south, east, north")
    return numbers


def _box_in_degrees(path: Path) -> Sequence[float]:
    """The box of all that a vector file holds, latitudes being whatever they are."""
    import shapely

    found = read_features(path, "an area")
    source = found.crs or "EPSG:4326"
    if not len(found.geometries):
        raise InputError(f"{path}: found no feature, expected an area")
    return [float(v) for v in shapely.total_bounds(in_crs(found.geometries, source, "EPSG:4326"))]


def _transformed(points: np.ndarray, source: str, crs: str, path: str) -> Bounds:
    from pyproj import Transformer
    from pyproj.exceptions import CRSError

    try:
        transformer = Transformer.from_crs(source, crs, always_xy=True)
    except CRSError:
        raise InputError(f"{path}: found CRS {source!r}, expected a known one") from None
    return _box(*transformer.transform(points[:, 0], points[:, 1]), path)


def _box(x: np.ndarray, y: np.ndarray, source: str) -> Bounds:
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(f"{source}: found places that the scene's CRS does not reach, expected an area in the images")
    return float(np.min(x)), float(np.min(y)), float(np.max(x)), float(np.max(y))


def _positions(node: Any, kinds: Sequence[str] = ()) -> list[tuple[float, float]]:
    """All positions of a GeoJSON object, or those of geometries of some kinds."""
    if isinstance(node, dict):
        if "coordinates" in node:
            return _positions(node["coordinates"]) if not kinds or node.get("type") in kinds else []
        parts = node.get("features") or node.get("geometries") or [node.get("geometry")]
        return [p for part in parts for p in _positions(part, kinds)] if isinstance(parts, list) else []
    if isinstance(node, list) and node:
        if len(node) >= 2 and all(isinstance(v, int | float) and not isinstance(v, bool) for v in node[:2]):
            return [(float(node[0]), float(node[1]))]
        return [p for part in node for p in _positions(part)]
    return []


__all__ = ["bounds_from_file", "bounds_from_geojson", "bounds_from_numbers", "exchanged_bounds", "wanted_area"]

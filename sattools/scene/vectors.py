"""Features of vector files: the one place where they are read and encoded."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from sattools.errors import InputError
from sattools.scene.jsonio import read_json, reason

FORMATS = "GeoPackage, GeoJSON, shapefile or FlatGeobuf"
_MAGIC = (b"SQLite format 3\0", b"\0\0\x27\x0a", b"fgb\x03")  # GeoPackage, shapefile, FlatGeobuf
_LONGEST = 200  # characters of what GDAL says, which repeats coordinates by the page


def is_geojson(path: Path) -> bool:
    """Whether a file holds JSON, by its first character."""
    return _head(path).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


def is_vector(path: Path) -> bool:
    """Whether a file begins as one of `FORMATS`. Raises InputError where it cannot be read."""
    return is_geojson(path) or _head(path).startswith(_MAGIC)


def read_features(path: Path, expected: str) -> Any:
    """The features of a file's first layer, as a GeoDataFrame.

    Only files that begin as one of `FORMATS`: GDAL opens by content, and a VRT or WFS description under another name
    would make it read other files and hosts.

    Args:
        path: the file.
        expected: what it should hold, for messages.

    Raises:
        InputError: missing, of another format, or damaged.
    """
    import geopandas

    if is_geojson(path):
        read_json(path, "GeoJSON")  # its depth and numbers
    elif not _head(path).startswith(_MAGIC):
        raise InputError(f"{path}: found another format, expected {expected}: {FORMATS}")
    try:
        with warnings.catch_warnings():  # what GDAL repairs is missing afterwards, and that is told
            warnings.simplefilter("ignore", RuntimeWarning)
            return geopandas.read_file(path, engine="pyogrio")
    except Exception as error:  # GDAL's drivers raise a dozen kinds
        text = " ".join(str(error).split())[:_LONGEST]
        raise InputError(f"{path}: cannot be read ({text}), expected {expected}: {FORMATS}") from None


def read_polygons(path: Path, crs: str) -> list[Any]:
    """The polygons of a vector file, in a CRS.

    Args:
        path: GeoPackage, GeoJSON, shapefile or FlatGeobuf; its first layer is read.
        crs: projected ground CRS [m].

    Returns:
        Shapely polygons and multipolygons, in the file's order.

    Raises:
        InputError: missing, of another format, without a CRS, or without polygons.
    """
    frame = read_features(path, "polygons")
    if getattr(frame, "crs", None) is None:
        raise InputError(f"{path}: found no coordinate reference system, expected one")
    try:
        frame = frame.to_crs(crs)
    except Exception as error:  # of pyproj, shapely and numpy
        text = " ".join(str(error).split())[:_LONGEST]
        raise InputError(f"{path}: cannot be brought to {crs[:80]} ({text}), expected polygons there") from None
    kinds = ("Polygon", "MultiPolygon")
    shapes = [
        shape for shape in frame.geometry if shape is not None and shape.geom_type in kinds and not shape.is_empty
    ]
    if not shapes:
        raise InputError(f"{path}: found no polygon, expected some")
    return shapes


def geopackage(frame: Any, layer: str) -> bytes:
    """The bytes of a GeoPackage of a GeoDataFrame.

    Args:
        frame: its features.
        layer: name of the layer.
    """
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "layer.gpkg"
        frame.to_file(target, layer=layer, driver="GPKG", engine="pyogrio")
        return target.read_bytes()


def _head(path: Path) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read(512)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path}: found {reason(error)}, expected a readable {FORMATS}") from None


__all__ = ["FORMATS", "geopackage", "is_geojson", "is_vector", "read_features", "read_polygons"]

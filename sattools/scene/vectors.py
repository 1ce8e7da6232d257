"""Polygons of vector files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sattools.errors import InputError

# name's end -> how such a file begins: GDAL would open whatever it finds, documents that point elsewhere included
FORMATS = {
    ".gpkg": b"SQLite format 3",
    ".shp": b"\x00\x00\x27\x0a",
    ".fgb": b"fgb",
    ".geojson": b"{",
    ".json": b"{",
}


def read_polygons(path: Path, crs: str) -> list[Any]:
    """The polygons of a GeoPackage, Shapefile, FlatGeobuf or GeoJSON file, in a CRS.

    Args:
        path: the file; its first layer is read.
        crs: projected ground CRS [m].

    Returns:
        Shapely polygons and multipolygons, in the file's order.

    Raises:
        InputError: missing, of another format, without a CRS, or without polygons.
    """
    import geopandas

    path = Path(path)
    begins = FORMATS.get(path.suffix.lower())
    if begins is None:
        raise InputError(f"{path}: found a name that ends in {path.suffix!r}, expected one of {', '.join(FORMATS)}")
    try:
        with open(path, "rb") as file:
            head = file.read(64)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), expected a vector file") from None
    if not head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(begins):
        raise InputError(f"{path}: found other content than a {path.suffix} file's, expected polygons")
    try:
        frame = geopandas.read_file(path, engine="pyogrio")
        if getattr(frame, "crs", None) is None:
            raise InputError(f"{path}: found no coordinate reference system, expected one")
        frame = frame.to_crs(crs)
    except InputError:
        raise
    except Exception as error:  # GDAL's drivers raise a dozen kinds
        text = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: cannot be read ({text}), expected a vector file with polygons") from None
    shapes = [
        s for s in frame.geometry if s is not None and s.geom_type in ("Polygon", "MultiPolygon") and not s.is_empty
    ]
    if not shapes:
        raise InputError(f"{path}: found no polygon, expected some")
    return shapes


__all__ = ["FORMATS", "read_polygons"]

"""Geometries of KML files, of all their folders, as text or packed (KMZ).

They are read without GDAL: not every build of it has a driver, and those that do take folders for layers, of which one
would be read.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sattools.errors import InputError
from sattools.scene.jsonio import TEXT_LIMIT, read_bytes
from sattools.scene.xmlio import find_all, local_name, xml_root

_ZIP = b"PK\x03\x04"
_MAIN = "doc.kml"  # of an archive with several, whose others are linked from it
_DEPTH = 8  # of geometries within geometries


def is_kml(head: bytes) -> bool:
    """Whether a file that begins so is KML, or an archive that may hold some."""
    return head.startswith(_ZIP) or (head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<") and b"<kml" in head)


def read_kml(path: Path) -> tuple[list[Any], list[str]]:
    """Shapely geometries of all placemarks in degrees, WGS84, None = one without; and their names.

    Args:
        path: the file.

    Raises:
        InputError: malformed, without KML, or places that are none.
    """
    data = read_bytes(path)
    root = xml_root(_unpacked(path) if data.startswith(_ZIP) else data, path, "KML")
    if local_name(root) != "kml":
        raise InputError(f"{path}: found XML with root <{local_name(root)}>, expected KML")
    marks = find_all(root, "Placemark")
    names = [next(((e.text or "").strip() for e in mark if local_name(e) == "name"), "") for mark in marks]
    return [_joined([shape for child in mark for shape in _shapes(path, child, 0)]) for mark in marks], names


def _unpacked(path: Path) -> bytes:
    """The main document of a KMZ archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if name.lower().endswith(".kml")]
            if not names:
                raise InputError(f"{path}: found a ZIP archive without KML, expected KMZ (or unpack it)")
            if len(names) > 1 and _MAIN not in names:
                found = ", ".join(sorted(names))[:200]
                raise InputError(f"{path}: found {found}, expected one KML file, or one of them to be {_MAIN}")
            with archive.open(_MAIN if _MAIN in names else names[0]) as file:
                data = file.read(TEXT_LIMIT + 1)  # whatever the archive says of its size
    except InputError:
        raise
    except Exception as error:  # of zipfile and of what unpacks for it
        text = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: found an archive that cannot be unpacked ({text}), expected KMZ") from None
    if len(data) > TEXT_LIMIT:
        raise InputError(f"{path}: found KML of more than {TEXT_LIMIT >> 20} MiB, expected less")
    return data


def _shapes(path: Path, element: Any, depth: int) -> Iterator[Any]:
    import shapely

    kind = local_name(element)
    if kind == "MultiGeometry" and depth < _DEPTH:
        for child in element:
            yield from _shapes(path, child, depth + 1)
    elif kind == "Polygon":
        outer = [_places(path, ring) for ring in find_all(element, "outerBoundaryIs")]
        inner = [_places(path, ring) for ring in find_all(element, "innerBoundaryIs")]
        if outer:
            yield _made(path, shapely.Polygon, outer[0], [hole for hole in inner if hole])
    elif kind in ("Point", "LineString", "LinearRing"):
        yield _made(path, shapely.Point if kind == "Point" else shapely.LineString, _places(path, element))


def _places(path: Path, element: Any) -> list[tuple[float, ...]]:
    """Longitudes and latitudes of all coordinates of an element, which separates places by blanks."""
    places: list[tuple[float, ...]] = []
    for text in " ".join(e.text or "" for e in find_all(element, "coordinates")).split():
        try:
            lon, lat = (float(number) for number in text.split(",")[:2])
        except ValueError:
            raise InputError(f"{path}: found the place {text[:40]!r}, expected longitude,latitude as in KML") from None
        places.append((lon, lat))
    return places


def _made(path: Path, kind: Any, *parts: Any) -> Any:
    try:
        return kind(*parts)
    except Exception as error:  # shapely's and GEOS's own kinds, for rings of two places
        text = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: found a {kind.__name__} that is none ({text}), expected KML") from None


def _joined(shapes: list[Any]) -> Any:
    """All geometries of a placemark as one; None where it has none."""
    import shapely

    if len(shapes) < 2:
        return shapes[0] if shapes else None
    if all(isinstance(shape, shapely.Polygon) for shape in shapes):
        return shapely.MultiPolygon(shapes)
    return shapely.GeometryCollection(shapes)


__all__ = ["is_kml", "read_kml"]

"""Outlines and boxes in degrees as GeoJSON has them, also across the antimeridian (RFC 7946, 3.1.9 and 5.2)."""

from __future__ import annotations

from collections.abc import Sequence

from sattools.scene.jsonio import JsonObject

Box = list[float]
_MEETING = 0.1  # of a cell that columns may be apart, or overlap, where a turn closes


def near_longitude(lon: float, other: float) -> float:
    """A longitude at most half a turn from another one.

    Args:
        lon: any longitude [degrees].
        other: the same.
    """
    return float(lon) - 360.0 * round((lon - other) / 360.0)


def whole_turn(span: tuple[float, float], onto: tuple[float, float]) -> float:
    """What to add to longitudes so that they lie on others: 0, -360 or 360; 0 where none of these does.

    Longitudes of some elevation models run from 0 to 360, and those of places at the antimeridian beyond 180 or -180.

    Args:
        span: the westernmost and the easternmost one [degrees].
        onto: those of the others.
    """
    (west, east), (left, right) = span, onto
    return next((turn for turn in (0.0, -360.0, 360.0) if west + turn < right and left < east + turn), 0.0)


def columns_of_turn(width: int, cell: float) -> int | None:
    """How many columns of a raster in degrees go around the globe; None where it does not, or they do not meet.

    Args:
        width: number of its columns; one more than a turn has, as rasters have whose cells' centres lie on both edges,
            is the first one again.
        cell: width of one [degrees].
    """
    count = round(360.0 / cell) if cell > 0 else 0
    return count if 0 < count <= width and abs(count * cell - 360.0) <= _MEETING * cell else None


def outline_on_globe(ring: Sequence[Sequence[float]]) -> tuple[JsonObject, Box]:
    """GeoJSON geometry of a closed ring, and its box; cut in two at the antimeridian where it crosses that.

    Args:
        ring: (longitude, latitude) of the corners, the first one again at the end [degrees]; longitudes may jump by a
            turn.

    Returns:
        A Polygon, or a MultiPolygon; (west, south, east, north), west > east where it crosses.
    """
    first = ring[0][0]
    lons = [near_longitude(place[0], first) for place in ring]
    lats = [float(place[1]) for place in ring]
    if not (min(lons) < -180.0 or max(lons) > 180.0):
        places = [[lon, lat] for lon, lat in zip(lons, lats, strict=True)]
        return {"type": "Polygon", "coordinates": [places]}, [min(lons), min(lats), max(lons), max(lats)]
    from shapely import affinity
    from shapely.geometry import Polygon, box
    from shapely.geometry.polygon import orient

    turn = 360.0 * round((min(lons) + max(lons)) / 720.0)
    shape = Polygon([(lon - turn, lat) for lon, lat in zip(lons, lats, strict=True)])
    parts = []
    for side in (-360.0, 0.0, 360.0):
        inside = shape.intersection(box(side - 180.0, -90.0, side + 180.0, 90.0))
        pieces = [piece for piece in getattr(inside, "geoms", [inside]) if piece.area > 0]
        parts += [orient(affinity.translate(piece, -side)) for piece in pieces]
    rings = [[[float(x), float(y)] for x, y in part.exterior.coords] for part in parts]
    bounds = [_wrapped(min(lons)), min(lats), _wrapped(max(lons)), max(lats)]
    if len(rings) == 1:  # all of it beyond the antimeridian, or one that only touches it
        edges = [x for x, _ in rings[0]]
        return {"type": "Polygon", "coordinates": rings}, [min(edges), min(lats), max(edges), max(lats)]
    return {"type": "MultiPolygon", "coordinates": [[part] for part in rings]}, bounds


def box_of_all(boxes: Sequence[Sequence[float]]) -> Box:
    """(west, south, east, north) of several, of which some may cross the antimeridian, as then does what is returned.

    Args:
        boxes: one or more of one place.
    """
    start = boxes[0][0]
    wests = [near_longitude(box[0], start) for box in boxes]
    widths = [(box[2] - box[0]) % 360.0 if box[2] < box[0] else box[2] - box[0] for box in boxes]
    west, east = min(wests), max(w + width for w, width in zip(wests, widths, strict=True))
    south, north = min(box[1] for box in boxes), max(box[3] for box in boxes)
    if west >= -180.0 and east <= 180.0:
        return [min(box[0] for box in boxes), south, max(box[2] for box in boxes), north]
    return [_wrapped(west), south, _wrapped(east), north]


def _wrapped(lon: float) -> float:
    """A longitude from -180 to 180 degrees."""
    return lon if -180.0 <= lon <= 180.0 else (lon + 180.0) % 360.0 - 180.0


__all__ = ["box_of_all", "columns_of_turn", "near_longitude", "outline_on_globe", "whole_turn"]

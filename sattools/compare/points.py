"""Comparison with laboratory or field samples at named points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sattools.errors import InputError
from sattools.scene.cells import FiledCells
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.tables import read_table
from sattools.scene.vectors import read_features

TEXT = ("name",)
PLACES = (("x", "y"), ("lon", "lat"))


@dataclass(frozen=True)
class Point:
    """A sample: name, place (in `crs`), and its values: ``reflectance_1`` ..., ``theta``, any product's name."""

    name: str
    x: float
    y: float
    crs: str | None
    values: Mapping[str, float]


Values = tuple[np.ndarray | FiledCells, Grid]
"""A map ``[B, H, W]`` and its grid."""


def filed(path: Path) -> Values:
    """A map in a file, of which single cells are read."""
    cells = FiledCells(path)
    return cells, cells.grid


def read_points(path: Path, *, values_needed: bool = True) -> list[Point]:
    """Samples from a CSV, GeoPackage, GeoJSON, shapefile or FlatGeobuf (KML has no numbers beside its places).

    A CSV has the columns ``name`` and ``x``, ``y`` (in the CRS of the maps) or ``lon``, ``lat`` (WGS84); all other
    columns with numbers are values. Of a vector file the point geometries and the attributes are taken. Capital letters
    of columns are small ones here, as formats and spreadsheets change them.

    Args:
        path: the file.
        values_needed: refuse a file of places alone.

    Raises:
        InputError: unreadable, without places, or without values that are needed.
    """
    points = _read_csv(path) if path.suffix.lower() == ".csv" else _read_vector(path)
    if not points:
        raise InputError(f"{path}: found no sample point, expected at least one")
    if values_needed and not any(point.values for point in points):
        raise InputError(f"{path}: found no value beside the places, expected columns such as reflectance_1 or theta")
    return points


def _read_csv(path: Path) -> list[Point]:
    points = []
    for number, row in enumerate(read_table(path, "sample points", TEXT), 1):
        place = next((pair for pair in PLACES if row.get(pair[0]) and row.get(pair[1])), None)
        if place is None:
            raise InputError(f"{path}: found no x, y or lon, lat in row {number}, expected one of them")
        numbers = {key: _number(value) for key, value in row.items() if key not in TEXT}
        if numbers[place[0]] is None or numbers[place[1]] is None:
            raise InputError(f"{path}: found {row[place[0]]!r}, {row[place[1]]!r} in row {number}, expected numbers")
        values = {k: v for k, v in numbers.items() if v is not None and k not in {n for pair in PLACES for n in pair}}
        crs = "EPSG:4326" if place[0] == "lon" else None
        points.append(
            Point(row.get("name") or str(number), float(numbers[place[0]]), float(numbers[place[1]]), crs, values)  # type: ignore[arg-type]
        )
    return points


def _number(text: str | None) -> float | None:
    try:
        value = float(text) if text else None
    except ValueError:
        return None
    return value if value is not None and np.isfinite(value) else None


def _read_vector(path: Path) -> list[Point]:
    found = read_features(path, "sample points in a CSV or vector file")
    if any(shape is None or shape.is_empty for shape in found.geometries):
        raise InputError(f"{path}: found features without a place, expected points")
    kinds = {shape.geom_type for shape in found.geometries}
    if kinds - {"Point"}:
        raise InputError(f"{path}: found {sorted(kinds)}, expected points")
    numeric = found.numeric()
    points = []
    for number, (place, row) in enumerate(zip(found.geometries, found.rows(), strict=True), 1):
        name = next((value for key, value in row.items() if key.lower() in TEXT and value is not None), number)
        values = {key.lower(): float(row[key]) for key in numeric if np.isfinite(row[key])}
        points.append(Point(str(name), float(place.x), float(place.y), found.crs, values))
    return points


def compare_points(
    points: list[Point], maps: Mapping[str, Values], shift: tuple[float, float] = (0.0, 0.0)
) -> list[JsonObject]:
    """Map values beside the samples' own.

    Args:
        points: samples; a value is named like its map, with ``_<band>`` (from 1) where that has several bands.
        maps: ``[B, H, W]`` and grid by name.
        shift: (east, north) by which the maps were moved to fit their reference [m].

    Returns:
        Per point: name, and per value ``map``, ``sample``, ``difference`` (None where the map has no value there).
    """
    table = []
    for point in points:
        row: dict[str, Any] = {"name": point.name, "values": {}}
        for key, sample in point.values.items():
            name, band = band_of(key, maps)
            if name is None:
                continue
            there = sampled(*maps[name], point, shift)
            map_value = float(there[band]) if there is not None and np.isfinite(there[band]) else None
            difference = None if map_value is None else map_value - sample
            row["values"][key] = {"map": map_value, "sample": sample, "difference": difference}
        table.append(row)
    return table


def sampled(
    array: np.ndarray | FiledCells, grid: Grid, point: Point, shift: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray | None:
    """Values ``[B]`` of the cell that a point lies in; None outside.

    Args:
        array: ``[B, H, W]``.
        grid: of it.
        point: the place.
        shift: (east, north) by which the map was moved to fit its reference [m].
    """
    east, north = _on(grid, point)
    col = int(np.floor((east - shift[0] - grid.left) / grid.cell_size))
    line = int(np.floor((grid.top - (north - shift[1])) / grid.cell_size))
    inside = 0 <= col < grid.width and 0 <= line < grid.height
    return np.asarray(array[:, line, col]) if inside else None


def with_values_of(points: list[Point], references: Mapping[str, Values]) -> list[Point]:
    """The points, with what reference maps say there wherever they have no such value of their own.

    Args:
        points: samples.
        references: ``[B, H, W]`` and grid by name.
    """
    filled = []
    for point in points:
        own = dict(point.values)
        for name, (array, grid) in references.items():
            there = sampled(array, grid, point)
            keys = [name] if array.shape[0] == 1 else [f"{name}_{band + 1}" for band in range(array.shape[0])]
            for key, value in zip(keys, [] if there is None else there, strict=False):
                if np.isfinite(value):
                    own.setdefault(key, float(value))
        filled.append(replace(point, values=own))
    return filled


def _on(grid: Grid, point: Point) -> tuple[float, float]:
    """(easting, northing) of a point in the grid's CRS."""
    if point.crs is None or point.crs == grid.crs:
        return point.x, point.y
    from sattools.camera.ground import from_geographic, to_geographic

    east, north = from_geographic(grid.crs, *to_geographic(point.crs, point.x, point.y))
    return float(east), float(north)


def band_of(key: str, maps: Mapping[str, Values]) -> tuple[str | None, int]:
    """Name of the map and number of its band, from 0, that a value's name means; None where there is no such map."""
    if key in maps and maps[key][0].shape[0] == 1:
        return key, 0
    stem, _, number = key.rpartition("_")
    if stem in maps and number.isdigit() and 1 <= int(number) <= maps[stem][0].shape[0]:
        return stem, int(number) - 1
    return None, 0


__all__ = ["Point", "Values", "band_of", "compare_points", "filed", "read_points", "sampled", "with_values_of"]

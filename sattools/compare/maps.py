"""Parameter maps against their references, block by block."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from sattools.compare.metrics import MAP_FIGURES, MapErrors
from sattools.compare.truth import grid_on_ground
from sattools.errors import InputError, counted
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import raster_bands, raster_grid, read_around, read_raster
from sattools.scene.regrid import reproject_map
from sattools.scene.stored import cut
from sattools.scene.warped import read_warped

SHOWN = 1_000_000  # cells of a picture: more would not be seen
Pair = tuple[np.ndarray, np.ndarray]


def compare_map(name: str, path: Path, reference: Path, shift: tuple[float, float]) -> tuple[JsonObject, Pair]:
    """Figures of a parameter map, and some values of it and its reference, ``[N]`` each.

    Args:
        name: of the map, for messages.
        path: its file.
        reference: file on any grid; the map is brought onto that, or onto square cells in metres of about its size.
        shift: (east, north) by which the surface was moved to fit its reference [m]: a map lies where its surface lies.

    Returns:
        `sattools.compare.metrics.map_errors`, with nothing but ``n`` = 0 where the map has no value at all; values of
        cells at even distances, NaN where one has none.

    Raises:
        InputError: another number of bands, or nothing in common.
    """
    found, wanted = raster_bands(path), raster_bands(reference)
    if found != wanted:
        raise InputError(f"{reference}: found {counted(wanted, 'bands')}, expected {found} as in {name}")
    grid, as_stored = grid_on_ground(reference, raster_grid(path).crs)
    step = math.ceil(math.sqrt(max(1.0, wanted * grid.width * grid.height / SHOWN)))
    errors = MapErrors()
    shown: list[Pair] = []
    for round_ in range(MapErrors.ROUNDS):
        for rows, cols in cut(grid.shape):
            there = grid.part(rows, cols)
            own = (read_raster(reference, there)[0] if as_stored else read_warped(reference, there)).astype(np.float32)
            carried = _carried(path, there.moved(-shift[0], -shift[1]), found)
            errors.add(round_, carried, own)
            if round_ == 0:
                some = (slice(None), slice(-rows.start % step, None, step), slice(-cols.start % step, None, step))
                shown.append((carried[some].ravel(), own[some].ravel()))
    pair = np.concatenate([p for p, _ in shown]), np.concatenate([r for _, r in shown])
    if not errors.count and not _known(path):  # nothing was determined, so nothing is claimed, and nothing can be wrong
        return dict.fromkeys(MAP_FIGURES) | {"n": 0}, pair
    return errors.figures(), pair


def _carried(path: Path, where: Grid, bands: int) -> np.ndarray:
    found = read_around(path, where)
    if found is None:
        return np.full((bands, *where.shape), np.nan, np.float32)
    return reproject_map(*found, where, means=True)


def _known(path: Path) -> bool:
    grid = raster_grid(path)
    return any(np.isfinite(read_raster(path, grid.part(*block))[0]).any() for block in cut(grid.shape))


__all__ = ["Pair", "compare_map"]

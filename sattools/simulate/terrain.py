"""A world over a given surface model: real relief, made-up colours."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sattools.camera.ground import check_metres
from sattools.errors import InputError
from sattools.scene.grid import Grid
from sattools.scene.members import HEIGHT_LIMITS_M
from sattools.scene.raster import read_raster
from sattools.simulate.materials import albedo_map, code, grain
from sattools.simulate.world import BUILDING, GROUND, TREES, WATER, World

log = logging.getLogger(__name__)
STEP_M = 1.5  # neighbours that differ by more are parted by a wall, others joined by a slope
ROOFS = ("gravel", "membrane", "tar", "tiles", "slate", "metal")
OPEN_GROUND = ("grass", "soil", "pavement")
CODES = (GROUND, TREES, BUILDING, WATER)  # of class maps

CLIFF_M, STEEPEST = 1000.0, 4.0  # no cliff is higher, no longer slope steeper than that many metres per metre


def build_terrain(
    heights: np.ndarray, grid: Grid, classes: np.ndarray | None, cell_size: float, rng: np.random.Generator
) -> World:
    """World of a DSM [H, W] in metres on `grid`, cut into cells of about `cell_size` metres.

    Unknown heights take the nearest known one. Slopes are joined linearly, steps of more than 1.5 m stay walls.
    Colours are drawn by class (2 ground, 5 trees, 6 building, 9 water; everything is ground without `classes`).
    Raises InputError where no height is known.

    Args:
        heights: ``[H, W]`` [m].
        grid: of the heights.
        classes: ``[H, W]`` class codes, or None.
        cell_size: edge of a cell [m].
        rng: random numbers.
    """
    known = np.isfinite(heights)
    if not known.any():
        raise InputError("DSM: found no height within the scene, expected some")
    if not known.all():
        from scipy.ndimage import distance_transform_edt

        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        heights = heights[tuple(nearest)]
    factor = max(1, round(grid.cell_size / cell_size))
    cell = grid.cell_size / factor
    surface, slope_x, slope_y = _joined(heights.astype(np.float64), grid.cell_size, factor)
    if classes is None:
        classes = np.full(heights.shape, GROUND, np.uint8)
    codes, tint = _materials(classes, _stepped(heights, grid.cell_size), rng)
    fine_classes, fine_codes, fine_tint = (_repeated(a, factor) for a in (classes.astype(np.uint8), codes, tint))
    wall = np.full((*surface.shape, 3), 0.3, np.float32)
    wall[fine_classes == TREES] = (0.05, 0.08, 0.035)
    return World(
        grid.middle,
        0.0,
        cell,
        surface.astype(np.float32),
        slope_x.astype(np.float32),
        slope_y.astype(np.float32),
        fine_classes,
        albedo_map(fine_codes, fine_tint, cell, rng),
        wall,
        (fine_classes == BUILDING).astype(np.uint8),
    )


def _repeated(array: np.ndarray, factor: int) -> np.ndarray:
    return array.repeat(factor, axis=0).repeat(factor, axis=1)


def _joined(heights: np.ndarray, cell: float, factor: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height and slopes of the fine cells: bilinear between cells where the relief is smooth, level plates at steps."""
    from scipy.ndimage import map_coordinates

    rows, columns = heights.shape
    at_rows = (np.arange(rows * factor) + 0.5) / factor - 0.5
    at_columns = (np.arange(columns * factor) + 0.5) / factor - 0.5
    smooth = map_coordinates(heights, np.meshgrid(at_rows, at_columns, indexing="ij"), order=1, mode="nearest")
    stepped = _repeated(_stepped(heights, cell), factor)
    slope_y, slope_x = np.gradient(smooth, cell / factor)
    surface = np.where(stepped, _repeated(heights, factor), smooth)
    return surface, np.where(stepped, 0.0, slope_x), np.where(stepped, 0.0, slope_y)


def _stepped(heights: np.ndarray, cell: float) -> np.ndarray:
    """Cells [H, W] bool beside a wall: more than 1.5 m between neighbours, and steeper than any slope (56°)."""
    from scipy.ndimage import maximum_filter, minimum_filter

    return np.asarray(maximum_filter(heights, 3) - minimum_filter(heights, 3) > STEP_M + 3 * cell)


def _materials(classes: np.ndarray, stepped: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Material code and tint of every cell: patches of open ground, one roof for each level of a building."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter, label

    patches = np.stack([gaussian_filter(grain(classes.shape, 1.0, rng), 6.0) for _ in OPEN_GROUND])
    codes = np.array([code(name) for name in OPEN_GROUND], np.uint8)[patches.argmax(axis=0)]
    tint = np.ones(classes.shape, np.float32)
    codes[classes == TREES] = code("leaves")
    codes[classes == WATER] = code("water")
    roof = classes == BUILDING
    buildings, count = label(roof & ~stepped)
    if count:  # the cells along walls belong to the nearest roof
        nearest = distance_transform_edt(buildings == 0, return_distances=False, return_indices=True)
        buildings = buildings[tuple(nearest)]
    roofs = np.array([code(name) for name in rng.choice(ROOFS, count + 1)], np.uint8)
    tints = rng.uniform(0.8, 1.25, count + 1).astype(np.float32)
    codes[roof], tint[roof] = roofs[buildings[roof]], tints[buildings[roof]]
    return codes, tint


def check_heights(path: str, heights: np.ndarray) -> None:
    """Raise InputError for heights [m] that no surface of the Earth has: rays would be followed for ever."""
    known = heights[np.isfinite(heights)]
    low, high = HEIGHT_LIMITS_M
    if known.size and (known.min() < low or known.max() > high):
        raise InputError(f"{path}: found heights from {known.min():g} to {known.max():g} m, expected some of the Earth")


def _check_relief(path: str, heights: np.ndarray, width_m: float) -> None:
    """Raise InputError for relief that no place has: oblique images of it would be far larger than the scene.

    Args:
        path: of the DSM.
        heights: ``[H, W]`` within the scene [m].
        width_m: of the scene with what lies around it [m].
    """
    known = heights[np.isfinite(heights)]
    highest = CLIFF_M + STEEPEST * width_m
    if known.size and np.ptp(known) > highest:
        raise InputError(
            f"{path}: found {np.ptp(known):.0f} m between the lowest and the highest place of {width_m:g} m of ground, "
            f"expected at most {highest:.0f} m (feet, or a wrong no-data value?)"
        )


@dataclass(frozen=True)
class GivenSurface:
    """The part of a DSM that a scene is made of, with its surroundings.

    Attributes:
        grid: of the scene.
        wide: of the scene and what lies around it.
        whole: of the file.
        index: rows and columns of the file that fill ``wide``.
        heights: ``[H, W]`` on ``wide`` [m]; NaN = unknown.
    """

    grid: Grid
    wide: Grid
    whole: Grid
    index: tuple[np.ndarray, np.ndarray]
    heights: np.ndarray


def read_surface(path: str, size_m: float, margin_m: float) -> GivenSurface:
    """The middle of a DSM. Raises InputError where a scene cannot be made of it.

    Args:
        path: of the DSM.
        size_m: edge of the scene, where the DSM is large enough [m].
        margin_m: what is around it [m].
    """
    heights, whole = read_raster(Path(path))
    check_metres(path, whole.crs, whole.bounds)
    check_heights(path, heights)
    grid, wide, (rows, columns) = window(whole, size_m, margin_m)
    part = heights[0][np.ix_(rows, columns)]
    _check_relief(path, part, wide.width * wide.cell_size)
    if not np.isfinite(part).any():
        raise InputError(f"{path}: found no height within the scene, expected some")
    return GivenSurface(grid, wide, whole, (rows, columns), part)


def read_classes(path: str, dsm: str, surface: GivenSurface) -> np.ndarray:
    """Class codes ``[H, W]`` of a given surface. Raises InputError for a file that is no class map of it.

    Args:
        path: of the class map.
        dsm: of the surface.
        surface: read from there.
    """
    codes, grid = read_raster(Path(path))
    if grid != surface.whole:
        raise InputError(f"{path}: found {grid}, expected the grid of {dsm}: {surface.whole}")
    found = codes[0][np.ix_(*surface.index)]
    if not np.isin(found, CODES).any():
        raise InputError(f"{path}: found none of the classes {', '.join(map(str, CODES))}, expected a class map")
    return np.asarray(found)


def window(grid: Grid, size_m: float, margin_m: float) -> tuple[Grid, Grid, tuple[np.ndarray, np.ndarray]]:
    """The square of at most `size_m` in the middle of `grid`, and the grid that has `margin_m` more on every side.

    Third: the rows and columns of `grid` that fill the wider one; beyond its edge they run backwards, as in a mirror.
    Raises InputError where `grid` is smaller than 16 m.

    Args:
        grid: ground grid.
        size_m: edge of the square [m].
        margin_m: more on every side [m].
    """
    cells = min(round(size_m / grid.cell_size), grid.width, grid.height)
    if cells * grid.cell_size < 16:
        raise InputError(f"DSM: found an extent of {cells * grid.cell_size:.0f} m, expected 16 m or more")
    top, left = (grid.height - cells) // 2, (grid.width - cells) // 2
    margin = math.ceil(margin_m / grid.cell_size)

    def part(row: int, column: int, count: int) -> Grid:
        size = grid.cell_size
        return Grid(grid.crs, grid.left + column * size, grid.top - row * size, size, count, count)

    wide = cells + 2 * margin
    index = _mirrored(top - margin, wide, grid.height), _mirrored(left - margin, wide, grid.width)
    return part(top, left, cells), part(top - margin, left - margin, wide), index


def tell_unknown(path: str, surface: GivenSurface) -> None:
    """Say how much of a scene a DSM leaves open: images and truth have the nearest heights there.

    Args:
        path: of the DSM.
        surface: read from there.
    """
    scene, around = surface.grid, (surface.wide.height - surface.grid.height) // 2
    known = np.isfinite(surface.heights[around : around + scene.height, around : around + scene.width])
    if not known.all():
        share = float(f"{100 * (1 - known.mean()):.2g}")
        log.warning(
            "%s: no height in %g %% of the scene, which has the nearest one there, and the truth too", path, share
        )


def _mirrored(start: int, count: int, size: int) -> np.ndarray:
    folded = np.arange(start, start + count) % (2 * size)
    return np.where(folded < size, folded, 2 * size - 1 - folded)

"""Reference surfaces: the layout of the 2019 IEEE GRSS Data Fusion Contest, or any georeferenced DSM."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sattools.camera.ground import check_metres, utm_crs
from sattools.compare.doubts import check_heights
from sattools.compare.heights import CLASSES, WATER
from sattools.compare.options import CompareOptions, parse_region
from sattools.errors import InputError, SceneError
from sattools.scene.datums import horizontal
from sattools.scene.document import Scene
from sattools.scene.grid import Grid
from sattools.scene.jsonio import read_text
from sattools.scene.opening import opened
from sattools.scene.placement import bounds_of_file, crs_of, has_grid
from sattools.scene.raster import raster_grid, read_image, read_raster
from sattools.scene.stored import cut, map_like, new_map, pieces
from sattools.scene.warped import ground_grid, read_warped

log = logging.getLogger(__name__)

DFC2019_CRS = {"JAX": "EPSG:32617", "OMA": "EPSG:32615"}  # Jacksonville and Omaha; the TIFFs carry none
CORRECTED_CLASSES = ("JAX_004", "JAX_260")  # their first class map misses water; users of the contest mask with _v2
HEIGHT_LIMITS_M = (-1000.0, 9500.0)  # anything else is some file's idea of "no data"
UNLABELLED = 65
_MEANT = {code: name for name, codes in CLASSES.items() for code in codes} | {WATER: "water"}


@dataclass(frozen=True)
class Truth:
    """A reference surface.

    Attributes:
        name: for messages and tables.
        protocol: `dfc2019` or `dsm`.
        grid: ground grid of both arrays.
        heights: [H, W] float32 in metres, NaN = not known; from `open_reference`, a map that is read by rows.
        classes: [H, W] uint8 class codes (2 ground, 5 trees, 6 building, 9 water, 17 bridge, 65 unlabelled), or None.
        region: part of the reference that is used, for the report.
        path: its file, for messages.
    """

    name: str
    protocol: str
    grid: Grid
    heights: np.ndarray
    classes: np.ndarray | None = None
    region: str | None = None
    path: Path | None = None

    @property
    def source(self) -> str:
        """The file's name, else the reference's own."""
        return str(self.path or self.name)

    def scored(self) -> np.ndarray:
        """[H, W] heights [m] of the cells that are scored, known and not water; NaN elsewhere."""
        scored = map_like(self.heights, self.grid.shape, np.float32)
        for rows in pieces(self.grid.shape):
            heights = self.heights[rows]
            scored[rows] = heights if self.classes is None else np.where(self.classes[rows] != WATER, heights, np.nan)
        return scored

    def mask_text(self) -> str:
        """What is scored, in words."""
        text = "cells with a reference height"
        if self.classes is not None:
            text += f" that are not water (class {WATER})"
        return text + (f", region {self.region}" if self.region else "")

    def within(self, region: str) -> Truth:
        """The same reference, known only inside `region`: west, east, north, south (a half) or `W,S,E,N` in its CRS.

        Raises InputError for a region that it cannot read, or without a cell of the reference.
        """
        rows_in, cols_in = _region(self.grid, region)
        heights = map_like(self.heights, self.grid.shape, np.float32)
        for rows in pieces(self.grid.shape):
            inside = rows_in[rows, None] & cols_in[None]
            heights[rows] = np.where(inside, self.heights[rows], np.float32(np.nan))
        return replace(self, heights=heights, region=region)


def _region(grid: Grid, region: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows ``[H]`` and columns ``[W]`` bool whose cells' centres lie in a region; InputError where none does."""
    west, south, east, north = grid.bounds
    middle_x, middle_y = grid.middle
    halves = {
        "west": (west, south, middle_x, north),
        "east": (middle_x, south, east, north),
        "south": (west, south, east, middle_y),
        "north": (west, middle_y, east, north),
    }
    found = parse_region(region)
    box = halves[found] if isinstance(found, str) else found
    x, y = grid.x(), grid.y()
    rows, cols = (y >= box[1]) & (y <= box[3]), (x >= box[0]) & (x <= box[2])
    if not (rows.any() and cols.any()):
        raise InputError(f"region: found no reference cell in {region!r}, expected a part of {grid.bounds}")
    return rows, cols


def read_dfc2019(folder: Path | str, aoi: str) -> Truth:
    """Truth of one contest tile, e.g. `JAX_068`: `<AOI>_DSM.tif`, `_DSM.txt`, `_CLS.tif` or `_CLS_v2.tif`.

    `_DSM.txt` holds the easting of the left edge, the northing of the *bottom* edge, the size in cells and the cell
    size. Raises InputError for missing or contradictory files.
    """
    folder = Path(folder)
    check_tile(folder, aoi)
    heights = _heights(folder / f"{aoi}_DSM.tif")
    grid = _dfc2019_grid(folder / f"{aoi}_DSM.txt", heights.shape, _dfc2019_crs(folder / f"{aoi}_DSM.tif", aoi))
    path = folder / f"{aoi}_CLS.tif"
    corrected = folder / f"{aoi}_CLS_v2.tif"
    if corrected.exists() and (aoi in CORRECTED_CLASSES or not path.exists()):
        path = corrected
    classes = read_image(path)[0]
    if classes.shape != heights.shape:
        raise InputError(f"{path}: found {classes.shape} cells, expected {heights.shape} as in {aoi}_DSM.tif")
    return Truth(aoi, "dfc2019", grid, heights, _class_codes(classes, path), path=folder / f"{aoi}_DSM.tif")


def check_tile(folder: Path, aoi: str | None) -> None:
    """Raise InputError where a folder is none, or has nothing of a tile.

    Args:
        folder: of the contest's truth.
        aoi: the tile; None = any.
    """
    name = aoi or "NAME"
    expected = f"expected a folder with {name}_DSM.tif, {name}_DSM.txt and {name}_CLS.tif"
    if folder.is_file():
        raise InputError(f"{folder}: found a file, {expected} (--dsm takes a file)")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, {expected}")
    others = sorted(path.name.removesuffix("_DSM.tif") for path in folder.glob("*_DSM.tif"))
    if not ((folder / f"{aoi}_DSM.tif").exists() if aoi else others):
        found = f"tiles {', '.join(others)[:200]} (--aoi NAME takes one)" if others else "no tile"
        raise InputError(f"{folder}: found {found}, {expected}")


def read_reference(dsm: Path | str, classes: Path | str | None = None) -> Truth:
    """Any georeferenced DSM as reference, with an optional class map in any grid.

    Its own cells are kept where they are square, in metres on the ground. One in degrees, feet or of a web map, turned
    or of oblong cells comes onto square ones of about that size, bilinear, classes by the nearest; holes neither grow
    nor shrink.

    A tile of the contest, `<AOI>_DSM.tif` with `<AOI>_DSM.txt` and a class map beside it or without a georeference of
    its own, is read by `read_dfc2019`, its class map included. Raises InputError.
    """
    truth = open_reference(dsm, classes)
    codes = None if truth.classes is None else np.asarray(truth.classes)
    return replace(truth, heights=np.asarray(truth.heights), classes=codes)


def open_reference(
    dsm: Path | str, classes: Path | str | None = None, folder: Path | None = None, crs: str | None = None
) -> Truth:
    """`read_reference` without holding all of a large one: its maps are read by rows.

    Args:
        dsm: the file.
        classes: class map, or None.
        folder: for temporary files; None = the system's.
        crs: projected CRS [m] onto which a reference in degrees or feet comes; None = UTM.

    Raises:
        InputError: as `read_reference`.
    """
    dsm = Path(dsm)
    if tile := _tile_of(dsm, classes):
        return read_dfc2019(dsm.parent, tile)
    check_heights(dsm, one_band=False)
    grid, own = grid_on_ground(dsm, crs)
    heights, codes = new_map(grid.shape, np.float32, folder), None
    for rows, cols in cut(grid.shape):
        heights[rows, cols] = _heights_on(dsm, grid.part(rows, cols), own)
    if classes is not None:
        codes, common, told = new_map(grid.shape, np.uint8, folder), False, False
        for rows, cols in cut(grid.shape):
            there = read_warped(Path(classes), grid.part(rows, cols), nearest=True)[0]
            common = common or bool(np.isfinite(there).any())
            part = _class_codes(there, Path(classes))
            codes[rows, cols], told = part, told or bool(np.isin(part, list(_MEANT)).any())
        if not common:
            raise InputError(f"{classes}: found no class where {dsm} lies, expected a class map of the same ground")
        if not told:  # it may be right, of a desert that nobody has classified
            meant = ", ".join(f"{code} {name}" for code, name in _MEANT.items())
            log.warning("%s: found none of the classes %s: all cells are scored alike, water too", classes, meant)
    return Truth(dsm.stem, "dsm", grid, heights, codes, path=dsm)


def read_truth(
    options: CompareOptions, scene: Scene | None = None, folder: Path | None = None, crs: str | None = None
) -> Truth:
    """The reference that the options name, else the truth that a simulated scene brings along.

    Args:
        options: of the stage.
        scene: that is scored, or None.
        folder: for temporary files, if large maps are to be read by rows (`open_reference`); None = the system's.
        crs: onto which a reference in degrees comes [m]; None = the scene's, else UTM.
    """
    crs = scene.grid.crs if crs is None and scene and scene.grid else crs
    if options.truth and options.dsm:
        raise InputError("found both --truth and --dsm, expected one of them")
    if options.truth:
        aoi = options.aoi or (scene.id if scene else None)
        if aoi is None:
            raise InputError("found --truth without a scene, expected --aoi NAME as well")
        truth = read_dfc2019(options.truth, aoi)
    elif options.dsm:
        truth = open_reference(options.dsm, options.classes, folder, crs)
    elif scene and "truth_dsm" in scene.products:
        classes = scene.products.get("truth_classes")
        own = scene.path(classes) if classes else None
        truth = open_reference(scene.path(scene.products["truth_dsm"]), own, folder)
    else:
        of = f"scene {scene.id}: " if scene else ""
        raise InputError(f"{of}found no reference, expected --truth DIR or --dsm FILE")
    return truth.within(options.region) if options.region else truth


def check_dsm(dsm: Path, classes: Path | str | None) -> None:
    """Raise InputError where a file can be told to be no reference for `open_reference` without reading its heights.

    Args:
        dsm: the file.
        classes: class map, or None.
    """
    if _tile_of(dsm, classes) is None:
        check_heights(dsm, one_band=False)
        crs_on_ground(dsm)
    if classes is not None:
        crs_on_ground(Path(classes))


def _tile_of(dsm: Path, classes: Path | str | None) -> str | None:
    """The tile of the contest that a file is read as, None where it is read as any other raster."""
    if classes is not None or not (dsm.name.endswith("_DSM.tif") and dsm.with_suffix(".txt").exists()):
        return None
    aoi = dsm.name.removesuffix("_DSM.tif")
    return aoi if _has_classes(dsm.parent, aoi) or not _georeferenced(dsm) else None


def grid_on_ground(dsm: Path, crs: str | None) -> tuple[Grid, bool]:
    """The grid of a reference, and whether it is that of the file's own cells.

    Args:
        dsm: the file.
        crs: projected CRS [m] onto which one that does not count metres on the ground comes; None = UTM.

    Raises:
        InputError: without a georeference, or unreadable.
    """
    own = crs_on_ground(dsm)
    if own is not None and has_grid(dsm):
        return raster_grid(dsm), True
    try:
        return ground_grid(dsm, lambda lon, lat: own or crs or utm_crs(lon, lat)), False
    except SceneError as error:
        raise InputError(f"{dsm}: {error}") from None


def crs_on_ground(path: Path) -> str | None:
    """The CRS of a raster that counts metres on the ground; None where its own counts others, as degrees or feet.

    Args:
        path: the file.

    Raises:
        InputError: without a georeference, or unreadable.
    """
    with opened(path) as data:
        crs, bounds = crs_of(data, path), bounds_of_file(data)
    try:
        check_metres(str(path), crs, bounds)
    except InputError:
        return None
    return crs


def _heights_on(dsm: Path, where: Grid, own: bool) -> np.ndarray:
    """Heights ``[h, w]`` [m] of a reference on a part of its `grid_on_ground`."""
    if own:
        return known_heights(read_raster(dsm, where)[0][0])
    return warped_heights(dsm, where)


def warped_heights(path: Path, where: Grid, *, means: bool = False) -> np.ndarray:
    """Heights ``[h, w]`` [m] on a grid, NaN = none, of a raster of any cells, turned or oblong ones among them.

    Args:
        path: the file.
        where: grid in any CRS.
        means: see `sattools.scene.regrid.reproject_map`.

    Raises:
        InputError: unreadable, or without a CRS.
        SceneError: no transformation between the two CRS is known.
    """
    return read_warped(path, where, lambda array: known_heights(array[:1]), means=means)[0]


def _has_classes(folder: Path, aoi: str) -> bool:
    return any((folder / f"{aoi}_{name}.tif").exists() for name in ("CLS", "CLS_v2"))


def _georeferenced(path: Path) -> bool:
    with opened(path) as data:
        return data.crs is not None


def _heights(path: Path) -> np.ndarray:
    return known_heights(read_image(path)[0])


def known_heights(heights: np.ndarray) -> np.ndarray:
    """`heights` in metres as float32, NaN where they cannot be heights on Earth but some file's "no data"."""
    heights = heights.astype(np.float32)
    low, high = HEIGHT_LIMITS_M
    return np.where((heights > low) & (heights < high), heights, np.float32(np.nan))


def _class_codes(classes: np.ndarray, path: Path) -> np.ndarray:
    known = np.isfinite(classes)
    wrong = classes[known & ((classes < 0) | (classes > 255) | (classes != np.round(classes)))]
    if wrong.size:
        raise InputError(f"{path}: found {wrong[0]:g}, expected class codes, whole numbers from 0 to 255")
    return np.where(known, classes, UNLABELLED).astype(np.uint8)


def _dfc2019_crs(dsm: Path, aoi: str) -> str:
    with opened(dsm) as data:
        if data.crs is not None:
            return horizontal(data.crs)
    try:
        return DFC2019_CRS[aoi[:3]]
    except KeyError as error:
        known = " or ".join(f"{prefix}_*" for prefix in DFC2019_CRS)
        raise InputError(f"{dsm}: found no CRS and the area {aoi!r}, expected {known}") from error


def _dfc2019_grid(path: Path, shape: tuple[int, ...], crs: str) -> Grid:
    try:
        left, bottom, size, cell_size = (float(value) for value in read_text(path).split())
        if not np.isfinite([left, bottom, size, cell_size]).all():
            raise ValueError
    except InputError:
        raise
    except ValueError as error:
        raise InputError(
            f"{path}: found other text, expected four numbers: easting, northing, size, cell size"
        ) from error
    height, width = shape
    if (height, width) != (int(size), int(size)):
        raise InputError(f"{path}: found a size of {size:.0f} cells, expected {height} x {width} as in the DSM")
    return Grid(crs, left, bottom + size * cell_size, cell_size, width, height)

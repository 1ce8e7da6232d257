"""The stage `change`: two surfaces of one place become maps and polygons of what has changed."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sattools.camera.ground import check_projected, check_scale, to_geographic
from sattools.change.detect import HeightChange, Region, cell_sigma, find_regions, sums
from sattools.change.options import ChangeOptions
from sattools.compare.picture import difference_picture
from sattools.compare.registration import register, search_margin, shifted
from sattools.compare.truth import known_heights
from sattools.errors import InputError
from sattools.progress import Progress, silent
from sattools.scene import Grid, Scene
from sattools.scene.datums import difference as datums_differ
from sattools.scene.dependencies import check_current
from sattools.scene.files import all_or_nothing, check_outputs, write_bytes, write_text
from sattools.scene.jsonio import JsonObject
from sattools.scene.location import location
from sattools.scene.raster import heights_above, read_raster, write_cog
from sattools.scene.regrid import reproject_map
from sattools.scene.validity import MEASURED
from sattools.scene.vectors import Features, geopackage, read_polygons

log = logging.getLogger(__name__)
HEIGHT, SIGNIFICANCE, ALBEDO = "height_change.tif", "significance.tif", "albedo_change.tif"
POLYGONS, PICTURE, TABLE = "changes.gpkg", "height_change.png", "change.json"


@dataclass(frozen=True)
class Surface:
    """One date.

    Attributes:
        name: of the scene or file.
        height: ``[H, W]`` [m]; NaN where nothing was measured.
        std: ``[H, W]`` [m], or None.
        albedo: ``[C, H, W]``, or None.
        confidence: ``[H, W]`` of the matching, 0 to 1, or None.
        grid: of all of them.
        files: that were read.
    """

    name: str
    height: np.ndarray
    std: np.ndarray | None
    albedo: np.ndarray | None
    confidence: np.ndarray | None
    grid: Grid
    files: tuple[Path, ...]

    @property
    def surface(self) -> Path:
        """The raster of heights: beside the scene's document, or all there is."""
        return self.files[min(1, len(self.files) - 1)]


def read_surface(source: str) -> Surface:
    """The exported surface of a scene document, or a raster of heights [m].

    Raises:
        InputError: neither can be read.
        SceneError: a scene without an exported DSM, or whose DSM is older than its fit.
    """
    path = location(source)
    if path.suffix.lower() != ".json":
        array, grid = read_raster(path)
        return Surface(path.stem, known_heights(array[0]).astype(np.float32), None, None, None, grid, (path,))
    scene = Scene.from_file(path)
    if "dsm" not in scene.products:
        raise InputError(f"{path}: found no product 'dsm', expected a scene after `sattools export`")
    check_current(scene, "export")
    files = {name: scene.path(scene.products[name]) for name in scene.products}
    height, grid = read_raster(files["dsm"])
    measured = height[0].astype(np.float32)
    if "validity" in files:
        validity, _ = read_raster(files["validity"])
        measured = np.where(validity[0] == MEASURED, measured, np.float32(np.nan))
    std = _beside(files, "dsm_std", grid)
    albedo = _beside(files, "albedo", grid)
    confidence = None
    if "prior_confidence" in files:
        own, own_grid = read_raster(files["prior_confidence"])
        confidence = reproject_map(own[0].astype(np.float32), own_grid, grid)
    names = ("dsm", "dsm_std", "albedo", "validity", "prior_confidence")
    used = tuple(files[name] for name in names if name in files)
    return Surface(scene.id, measured, None if std is None else std[0], albedo, confidence, grid, (path, *used))


def change(
    before: str, after: str, options: ChangeOptions, progress: Progress = silent, overwrite: bool = False
) -> JsonObject:
    """Compare two dates; writes maps, polygons, a picture and a table into ``options.out``.

    Args:
        before: scene document or raster of the earlier date.
        after: of the later one; it is brought onto the earlier one's grid.
        options: see `ChangeOptions`.
        progress: told the share done and what is being done.
        overwrite: replace outputs that are there.

    Returns:
        The table: shift, scatter, regions with area, mean, volume and p-value.

    Raises:
        InputError, SceneError: a surface that cannot be read, two that have nothing in common, or an earlier one whose
            CRS does not count metres.
        OutputExistsError: outputs that are there.
    """
    progress(0.0, "reading")
    old, new = read_surface(before), read_surface(after)
    _check_metres(old)
    folder = Path(options.out)
    names = [HEIGHT, SIGNIFICANCE, POLYGONS, PICTURE, TABLE, *([ALBEDO] if _same_bands(old, new) else [])]
    inputs = [*old.files, *new.files, *([Path(options.polygons)] if options.polygons else [])]
    check_outputs([folder / name for name in names], inputs, overwrite)
    note = datums_differ({old.name: heights_above(old.surface), new.name: heights_above(new.surface)})
    if note:
        log.warning("%s, unless --register takes it out", note)
    progress(0.2, "registering")
    moved, shift = _onto(new, old, options)
    difference = moved["height"] - old.height
    if not np.isfinite(difference).any():
        raise InputError(f"{new.name}: found no measured height in common with {old.name}, expected overlap")
    std = _together(old.std, moved.get("std"), np.hypot)
    confidence = _together(old.confidence, moved.get("confidence"), np.fmin)
    sigma = cell_sigma(difference, std)
    heights = HeightChange(difference, sigma, old.grid.cell_size, options.correlation, confidence)
    progress(0.6, "regions")
    labels, regions = find_regions(heights, options)
    table: JsonObject = {"before": old.name, "after": new.name, "shift_m": [round(v, 4) for v in shift]}
    table |= _table(heights, regions, options)
    if options.polygons:
        table["polygons"] = _per_polygon(Path(options.polygons), old.grid, heights)
    progress(0.8, "writing")
    with all_or_nothing():
        _write_map(folder / HEIGHT, difference, "m", "height, later minus earlier", (old, new))
        significance = difference / heights.sigma
        _write_map(folder / SIGNIFICANCE, significance, "1", "height change in standard deviations", (old, new))
        if ALBEDO in names and old.albedo is not None:
            brighter = _albedo_change(old.albedo, moved["albedo"], labels)
            _write_map(folder / ALBEDO, brighter, "1", "albedo, later minus earlier", (old, new))
        difference_picture(difference, old.grid, f"{old.name} to {new.name}: change of height", folder / PICTURE)
        write_bytes(folder / POLYGONS, _geopackage(labels, regions, old.grid))
        write_text(folder / TABLE, json.dumps(table, indent=1) + "\n")
    progress(1.0, "done")
    return table


def _check_metres(earlier: Surface) -> None:
    """Raise InputError where the map that all is measured on has no metres: areas and volumes would be none."""
    grid = earlier.grid
    west, south, east, north = grid.bounds
    try:
        check_projected(grid.crs)
        check_scale(grid.crs, *(float(v) for v in to_geographic(grid.crs, (west + east) / 2, (south + north) / 2)))
    except InputError as error:
        raise InputError(f"{earlier.surface}: {error}") from None


def _beside(files: dict[str, Path], name: str, grid: Grid) -> np.ndarray | None:
    if name not in files:
        return None
    array, own = read_raster(files[name])
    if own != grid:
        raise InputError(f"{files[name]}: found another grid than the DSM's, expected one export")
    return array.astype(np.float32)


def _write_map(path: Path, array: np.ndarray, units: str, about: str, dates: tuple[Surface, Surface]) -> None:
    tags = {"SOFTWARE": "sattools", "BEFORE": dates[0].name, "AFTER": dates[1].name}
    described = [about] if array.ndim == 2 else [f"{about}, band {k + 1}" for k in range(len(array))]
    write_cog(path, array.astype(np.float32), dates[0].grid, units=units, tags=tags, descriptions=described)


def _same_bands(old: Surface, new: Surface) -> bool:
    return old.albedo is not None and new.albedo is not None and len(old.albedo) == len(new.albedo)


def _onto(
    new: Surface, old: Surface, options: ChangeOptions
) -> tuple[dict[str, np.ndarray], tuple[float, float, float]]:
    """Maps of the later date on the earlier one's grid, registered, and the shift (east, north, up) [m]."""
    margin = search_margin(old.grid.shape) if options.register in ("ncc", "nuth-kaab") else 0
    wide = old.grid.widened(margin)
    height = reproject_map(new.height, new.grid, wide)
    if not np.isfinite(height).any():
        raise InputError(f"{new.name}: found no height within {old.name}, expected overlap")
    found = register(height, old.height, options.register, margin)
    maps = {"height": shifted(height, found.columns, found.rows, margin)}
    # the mean height difference, which registration takes out, contains the changes; the median does not
    offset = float(np.nanmedian(maps["height"] - old.height)) if options.register != "none" else 0.0
    maps["height"] = maps["height"] - offset
    for name in ("std", "albedo", "confidence"):
        array = getattr(new, name)
        if array is not None:
            layers = reproject_map(array[None] if array.ndim == 2 else array, new.grid, wide)
            moved = np.stack([shifted(layer, found.columns, found.rows, margin) for layer in layers])
            maps[name] = moved[0] if array.ndim == 2 else moved
    east, north, _ = found.metres(old.grid.cell_size)
    return maps, (east, north, -offset)


def _together(old: np.ndarray | None, new: np.ndarray | None, how: np.ufunc) -> np.ndarray | None:
    """Both dates' maps in one; what only one of them has."""
    if old is None or new is None:
        return old if new is None else new
    return np.asarray(how(old, new))


def _albedo_change(old: np.ndarray, new: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Later minus earlier albedo ``[C, H, W]``, brightness and contrast of the later one matched where nothing changed.

    Haze, season and exposure change all colours alike.
    """
    same = (labels == 0) & np.isfinite(old).all(axis=0) & np.isfinite(new).all(axis=0)
    out = np.full_like(old, np.nan)
    for k in range(len(old)):
        if not same.any():
            break
        low = np.percentile(old[k][same], [16, 50, 84]), np.percentile(new[k][same], [16, 50, 84])
        gain = (low[0][2] - low[0][0]) / max(low[1][2] - low[1][0], 1e-6)
        out[k] = (new[k] - low[1][1]) * gain + low[0][1] - old[k]
    return out


def _table(heights: HeightChange, regions: list[Region], options: ChangeOptions) -> JsonObject:
    known = heights.difference[np.isfinite(heights.difference)]
    return {
        "registration": options.register,
        "common_share": round(float(np.isfinite(heights.difference).mean()), 4),
        "nmad_m": round(1.4826 * float(np.median(np.abs(known - np.median(known)))), 4),
        "confidence": options.confidence,
        "regions": [_row(asdict(region)) for region in regions],
    }


def _row(values: dict[str, Any]) -> JsonObject:
    return {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in values.items()}


def _per_polygon(path: Path, grid: Grid, heights: HeightChange) -> list[JsonObject]:
    """Change and volume of every polygon of a vector file, holes in the surfaces left out."""
    from rasterio.features import rasterize

    rows = []
    for k, shape in enumerate(read_polygons(path, grid.crs)):
        inside = rasterize([(shape, 1)], out_shape=grid.shape, transform=grid.transform, dtype="uint8") > 0
        known = (inside & np.isfinite(heights.difference)).sum() / max(1, inside.sum())
        values = asdict(sums(inside, heights))
        finite = {name: value if np.isfinite(value) else None for name, value in values.items()}
        rows.append({"number": k, "known_share": round(float(known), 4), **_row(finite)})
    return rows


def _geopackage(labels: np.ndarray, regions: list[Region], grid: Grid) -> bytes:
    """GeoPackage of the regions, with their figures."""
    from rasterio.features import shapes
    from shapely.geometry import MultiPolygon, shape

    pieces: dict[int, list[Any]] = {}
    for geometry, value in shapes(labels, mask=labels > 0, connectivity=8, transform=grid.transform):
        pieces.setdefault(int(value), []).append(shape(geometry))
    rows = [{**asdict(r), "kind": "risen" if r.mean_m > 0 else "sunk"} for r in regions]
    outlines = [MultiPolygon(pieces[region.label]) for region in regions]
    names = rows[0] if rows else ("label", "kind")
    columns = {name: np.array([row[name] for row in rows], object if name == "kind" else None) for name in names}
    return geopackage(Features(outlines, columns, grid.crs), "changes", "MultiPolygon")


__all__ = ["Surface", "change", "read_surface"]

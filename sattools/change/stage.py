"""The stage `change`: two surfaces of one place become maps and polygons of what has changed."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from sattools.camera.ground import ground_area
from sattools.change.dates import register_dates
from sattools.change.detect import (
    LEAST_SIGMA_M,
    HeightChange,
    Region,
    cell_sigma,
    find_regions,
    nearby_scatter,
    scatter_of,
    sums,
)
from sattools.change.options import ChangeOptions
from sattools.change.surfaces import Surface, check_surface, order_of_bands, read_surface
from sattools.compare.picture import difference_picture
from sattools.errors import counted
from sattools.progress import Progress, silent
from sattools.scene import Grid
from sattools.scene.cog import CogWriter
from sattools.scene.datums import difference as datums_differ
from sattools.scene.files import all_or_nothing, check_outputs, locked, remove, write_bytes, write_text
from sattools.scene.folders import make_folder, without_empty_folders
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import heights_above
from sattools.scene.stored import pieces
from sattools.scene.vectors import Features, geopackage, numbered_polygons, read_polygons

log = logging.getLogger(__name__)
HEIGHT, SIGNIFICANCE, ALBEDO = "height_change.tif", "significance.tif", "albedo_change.tif"
POLYGONS, PICTURE, TABLE = "changes.gpkg", "height_change.png", "change.json"
WIDE = 4.0  # times the scatter side by side: no errors of matching, whose correlation is that of the option


@without_empty_folders()
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
        InputError, SceneError: a surface that cannot be read, two that have nothing in common, or one whose
            coordinates its CRS does not reach.
        OutputExistsError: outputs that are there.
    """
    progress(0.0, "reading")
    old, new, names = _begun(before, after, options, overwrite)
    folder = Path(options.out)
    apart = _datums(old, new)
    for text in apart:
        log.warning("%s", text)
    progress(0.2, "registering")
    make_folder(folder)
    found = register_dates(old, new, options.register, folder)
    heights = HeightChange(
        found.difference, cell_sigma(found.difference, found.together("std", np.hypot), options.noise),
        old.grid.cell_size, options.correlation, found.together("confidence", np.fmin),
        ground_area(old.grid.crs, old.grid.bounds),
    )  # fmt: skip
    progress(0.6, "regions")
    labels, regions = find_regions(heights, options)
    unsure = [surface for surface in (old, new) if regions and "confidence" not in surface.layers]
    moved = found.shift_m[2]
    notes = [*found.notes, *_mostly_changed(heights, regions, options, moved), *_other_bands(old, new)]
    notes += map(_noise_alone, unsure)
    for text in notes:
        log.warning("%s", text)
    table: JsonObject = {"before": old.name, "after": new.name, "shift_m": [round(v, 4) for v in found.shift_m]}
    table["notes"] = [*apart, *notes]
    table["registration"] = found.found.method
    table |= _table(heights, regions, options)
    if options.polygons:
        table["polygons"] = _per_polygon(Path(options.polygons), old.grid, heights)
    progress(0.8, "writing")
    # another one may have written there since it was checked
    with locked(folder), all_or_nothing([], overwrite):
        _write_map(folder / HEIGHT, heights.difference.__getitem__, ("m", "height, later minus earlier"), (old, new))
        _write_map(
            folder / SIGNIFICANCE, lambda rows: heights.difference[rows] / heights.sigma[rows],
            ("1", "height change in standard deviations"), (old, new),
        )  # fmt: skip
        if ALBEDO in names:
            brighter = found.albedo_change(labels)
            words = old.band_names("albedo") or [str(k + 1) for k in range(old.bands("albedo"))]
            bands = [f"band {word}" if word.isdecimal() else word for word in words]
            _write_map(folder / ALBEDO, brighter, ("1", "albedo, later minus earlier"), (old, new), bands)
        else:
            remove(folder / ALBEDO)  # of other dates, which nothing would tell from these
        title = f"{old.name} to {new.name}: change of height"
        difference_picture(heights.difference, old.grid, title, folder / PICTURE, "later minus earlier")
        write_bytes(folder / POLYGONS, _geopackage(labels, regions, old.grid))
        write_text(folder / TABLE, json.dumps(table, indent=1) + "\n")
    progress(1.0, "done")
    return table


def check_start(before: str, after: str, options: ChangeOptions, overwrite: bool = False) -> Grid:
    """The grid of `before`; raises what `change` would raise before its work, with the arguments of it."""
    return _begun(before, after, options, overwrite)[0].grid


def _begun(before: str, after: str, options: ChangeOptions, overwrite: bool) -> tuple[Surface, Surface, list[str]]:
    """Both dates and the names of what will be written, once all is checked that needs no work."""
    for source in (before, after):
        check_surface(source)
    new = read_surface(after)
    old = read_surface(before, new.grid.crs)
    names = [HEIGHT, SIGNIFICANCE, POLYGONS, PICTURE, TABLE, *([ALBEDO] if order_of_bands(old, new) else [])]
    polygons = [Path(options.polygons)] if options.polygons else []
    for path in polygons:
        read_polygons(path, old.grid.crs)
    inputs = [*old.files, *new.files, *polygons]
    check_outputs([Path(options.out) / name for name in dict.fromkeys([*names, ALBEDO])], inputs, overwrite)
    return old, new, names


def _datums(old: Surface, new: Surface) -> list[str]:
    """What to say where dates, which may have one name, are known to have heights above different things."""
    files = {f"{old.name} before": old.layers["height"], f"{new.name} after": new.layers["height"]}
    note = datums_differ({name: heights_above(file) for name, file in files.items()})
    return [f"{note}, unless --register takes it out"] if note else []


def _noise_alone(surface: Surface) -> str:
    """What p-values of a surface are worth that does not say where it was matched surely."""
    return (
        f"{surface.layers['height']}: found heights without the confidence of their matching, so where matching "
        "failed, along the rim of what the images show above all, looks like a change, and p-values are about noise "
        "alone (the document of a scene with a prior brings it along)"
    )


def _mostly_changed(
    heights: HeightChange, regions: Sequence[Region], options: ChangeOptions, moved: float
) -> list[str]:
    """What to say where most of the area has changed: that is then taken for noise, or for what has not.

    Args:
        heights: the change.
        regions: found in it.
        options: see `ChangeOptions`.
        moved: what registration has added to the later heights [m].
    """
    notes = []
    none = "--register none leaves heights as they are, if both are above the same datum"
    scatter = scatter_of(heights.difference)
    if options.noise is None and 2 * scatter > options.min_height:
        nearby = nearby_scatter(heights.difference, max(1, round(options.correlation / heights.cell_size)))
        if scatter > WIDE * max(nearby, LEAST_SIGMA_M):
            notes.append(
                f"differences scatter by {scatter:.2g} m, side by side by {nearby:.2g} m: most of the area seems to "
                f"have changed, which is taken for noise, and what has changed by less than {2 * scatter:.2g} m for "
                f"none; --noise says what unchanged ground has (such as {max(nearby, LEAST_SIGMA_M):.1g}), and {none}"
            )
    still = [region for region in regions if abs(region.mean_m - moved) < options.min_height <= abs(moved)]
    if still:
        area = sum(region.area_m2 for region in still)
        notes.append(
            f"most of the area has changed by {-moved:+.1f} m, which registration takes out: {area:.0f} m2 that have "
            f"not are told as changed by about {moved:+.1f} m; {none}"
        )
    return notes


def _write_map(
    path: Path,
    read: Callable[[slice], np.ndarray],
    about: tuple[str, str],
    dates: tuple[Surface, Surface],
    bands: Sequence[str] = ("",),
) -> None:
    """Write what some rows hold, ``[h, W]`` or ``[B, h, W]``; ``about``: unit, and what it is; ``bands``: names."""
    tags = {"SOFTWARE": "sattools", "BEFORE": dates[0].name, "AFTER": dates[1].name}
    unit, name = about
    described = [name] if len(bands) == 1 else [f"{name}, {band}" for band in bands]
    grid = dates[0].grid
    with CogWriter(path, grid, bands=len(bands), units=unit, tags=tags, descriptions=described) as out:
        for rows in pieces(grid.shape):
            out.write(np.asarray(read(rows), np.float32), rows)


def _other_bands(old: Surface, new: Surface) -> list[str]:
    """Why there is no map of the change of albedo although both dates have one."""
    if order_of_bands(old, new) or not (old.bands("albedo") and new.bands("albedo")):
        return []
    said = (", ".join(one.band_names("albedo")) or counted(one.bands("albedo"), "bands") for one in (old, new))
    return [f"albedo: found {' before and '.join(said)} after, expected the same bands: no map of its change"]


def _table(heights: HeightChange, regions: list[Region], options: ChangeOptions) -> JsonObject:
    height, width = heights.shape
    return {
        "common_share": round(heights.area_m2 / heights.cell_area / (height * width), 4),
        "nmad_m": round(scatter_of(heights.difference), 4),
        **({} if options.noise is None else {"noise_m": options.noise}),
        "confidence": options.confidence,
        "regions": [_row(_figures(region)) for region in regions],
    }


def _figures(region: Region) -> JsonObject:
    return {name: value for name, value in asdict(region).items() if name != "box"}


def _row(values: dict[str, Any]) -> JsonObject:
    return {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in values.items()}


def _per_polygon(path: Path, grid: Grid, heights: HeightChange) -> list[JsonObject]:
    """Change and volume of every polygon of a vector file, by its place there, holes in the surfaces left out."""
    from rasterio.features import rasterize

    table = []
    for k, shape in numbered_polygons(path, grid.crs).items():
        rows, cols = _around(grid, shape.bounds)
        part = grid.part(rows, cols)
        inside = rasterize([(shape, 1)], out_shape=part.shape, transform=part.transform, dtype="uint8") > 0
        known = (inside & np.isfinite(heights.difference[rows, cols])).sum() / max(1, inside.sum())
        known *= _share_within(shape, grid)  # of what lies beyond the maps nothing is known
        values = asdict(sums(inside, heights, (rows, cols)))
        finite = {name: value if np.isfinite(value) else None for name, value in values.items()}
        table.append({"number": k, "known_share": round(float(known), 4), **_row(finite)})
    return table


def _share_within(shape: Any, grid: Grid) -> float:
    """Share of a polygon's area that lies on the grid."""
    from shapely.geometry import box

    return float(shape.intersection(box(*grid.bounds)).area) / shape.area if shape.area > 0 else 1.0


def _around(grid: Grid, bounds: tuple[float, float, float, float]) -> tuple[slice, slice]:
    """Rows and columns around a box, at least one of each."""
    west, south, east, north = bounds
    cols = np.clip([(west - grid.left) // grid.cell_size, (east - grid.left) // grid.cell_size + 1], 0, grid.width)
    rows = np.clip([(grid.top - north) // grid.cell_size, (grid.top - south) // grid.cell_size + 1], 0, grid.height)
    first_row, first_col = min(int(rows[0]), grid.height - 1), min(int(cols[0]), grid.width - 1)
    return slice(first_row, max(int(rows[1]), first_row + 1)), slice(first_col, max(int(cols[1]), first_col + 1))


def _geopackage(labels: np.ndarray, regions: list[Region], grid: Grid) -> bytes:
    """GeoPackage of the regions, with their figures."""
    from rasterio.features import shapes
    from shapely.geometry import MultiPolygon, shape

    outlines = []
    for region in regions:
        top, bottom, left, right = region.box
        rows, cols = slice(top, bottom), slice(left, right)
        own = np.asarray(labels[rows, cols] == region.label, np.uint8)
        found = shapes(own, mask=own > 0, connectivity=8, transform=grid.part(rows, cols).transform)
        outlines.append(MultiPolygon([shape(geometry) for geometry, _ in found]))
    table = [{**_figures(r), "kind": "risen" if r.mean_m > 0 else "sunk"} for r in regions]
    kinds = {"label": np.int64, "kind": object}  # numbers else, the same where nothing has changed
    names = [*(field.name for field in fields(Region) if field.name != "box"), "kind"]
    columns = {name: np.array([row[name] for row in table], kinds.get(name, np.float64)) for name in names}
    return geopackage(Features(outlines, columns, grid.crs), "changes", "MultiPolygon")


__all__ = ["Surface", "change", "check_start", "read_surface"]

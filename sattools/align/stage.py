"""The stage `align`: a scene is moved onto a reference, cameras, surface and maps alike."""

from __future__ import annotations

import csv
import io
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from sattools.align.estimate import ControlPoint, Shift, shift_to_dem, shift_to_points
from sattools.align.options import AlignOptions
from sattools.camera.ground import from_geographic, to_geographic
from sattools.camera.rpc import RPC
from sattools.compare.truth import known_heights
from sattools.errors import InputError, SceneError
from sattools.export.products.collection import PRODUCTS as CATALOGUE
from sattools.export.products.names import FILES
from sattools.export.validity import MEASURED
from sattools.progress import Progress, silent
from sattools.scene import Asset, Grid, Scene
from sattools.scene.dependencies import MADE, STAGES, check_current, drop, files_of, latest, names_of, record
from sattools.scene.files import check_outputs
from sattools.scene.jsonio import JsonObject, read_text
from sattools.scene.location import location
from sattools.scene.opening import opened
from sattools.scene.raster import raster_vertical, read_raster, write_cog

HEIGHTS = ("dsm", "dtm", "prior_dsm")
CAMERAS = {"rpc": "_RPC.TXT", "colours_rpc": "_COLOURS_RPC.TXT"}  # of an item: asset -> end of its file's name
ON_THE_GROUND = ("shadow", "s_net", "tau", "beta")  # assets of images that are maps of the ground
MADE_OF_MAPS = sorted(
    {name for files in FILES.values() for name, href in files.items() if not href.endswith(".tif")} | CATALOGUE.keys()
)
COLUMNS = ("z", "item", "column", "row")


@dataclass(frozen=True)
class Move:
    """A raster that is moved.

    Attributes:
        source: file.
        href: of the moved one.
        up: what is added to its numbers [m].
    """

    source: Path
    href: str
    up: float


def align(scene: Scene, options: AlignOptions, progress: Progress = silent, overwrite: bool = False) -> JsonObject:
    """Move a scene onto a reference; the files from before stay, the scene names the moved ones below ``align/``.

    Cameras are moved on the ground, so that images, surface and maps still belong together and every later command
    works in the reference's frame. Scores are dropped; a network (which knows its heights only as weights) as well.

    Args:
        scene: with an exported DSM; is changed.
        options: see `AlignOptions`.
        progress: told the share done.
        overwrite: replace files of an alignment that was interrupted.

    Returns:
        Shift and residuals, for the history.

    Raises:
        SceneError: the scene has no DSM.
        InputError: the reference cannot be used, or the shift is too large.
    """
    if options.to is None:
        raise InputError("align: found no --to, expected a raster of heights or a CSV of control points")
    if "dsm" not in scene.products:
        raise SceneError(f"scene {scene.id}: found no DSM, expected one made by `sattools export`")
    check_current(scene, "export")
    reference = Path(location(options.to))
    progress(0.0, "registering")
    grid = scene.require_grid()
    shift = _shift(scene, reference, options)
    if not np.hypot(np.hypot(shift.east, shift.north), shift.up) <= options.max_shift:
        raise InputError(
            f"{reference}: found a shift of {shift.east:.1f}, {shift.north:.1f}, {shift.up:.1f} m, expected at most "
            f"{options.max_shift:g} m (--max-shift); are the vertical datums the same?"
        )
    progress(0.3, "moving")
    records = {stage: latest(scene, stage) for stage in STAGES}
    dropped = drop(scene, "compare")
    folder = f"align/{1 + sum(entry.get('command') == 'align' for entry in scene.history)}"
    moves, cameras = _moves(scene, folder, shift), _moved_cameras(scene, grid, shift)
    outputs = [move.href for move in moves.values()] + [f"{folder}/{name}" for name in (*cameras, "model.safetensors")]
    check_outputs([scene.path(href) for href in outputs], [*files_of(scene), reference], overwrite)
    dropped += _move_model(scene, f"{folder}/model.safetensors", shift)
    for (item_id, name), move in moves.items():
        _write_moved(scene, move, shift)
        if item_id is None:
            scene.products[name] = move.href
    # what was made of the maps before they moved; another `export` makes it anew
    dropped += [name for name in MADE_OF_MAPS if scene.products.pop(name, None) is not None]
    for item in scene.items:
        item.assets.pop("depth", None)  # heights along its pixels, of the prior
        item.assets.pop("confidence", None)
        for name in ON_THE_GROUND:
            if (item.id, name) in moves:
                item.assets[name] = replace(item.assets[name], href=moves[item.id, name].href)
        for asset, end in CAMERAS.items():
            if f"{item.id}{end}" in cameras:
                href = f"{folder}/{item.id}{end}"
                cameras[f"{item.id}{end}"].write(scene.output(href))
                item.assets[asset] = Asset(href, "text/plain", ["metadata"])
    scene.grid = grid.moved(shift.east, shift.north)
    if scene.height_range_m:
        low, high = scene.height_range_m
        scene.height_range_m = (low + shift.up, high + shift.up)
    progress(1.0, "aligned")
    return {"shift": asdict(shift), "dropped": sorted(dropped), MADE: _recorded(scene, records)}


def _shift(scene: Scene, reference: Path, options: AlignOptions) -> Shift:
    if reference.suffix.lower() == ".csv":
        cameras = {i.id: RPC.from_file(scene.path(i.assets["rpc"].href)) for i in scene.items if "rpc" in i.assets}
        crs = scene.require_grid().crs
        return shift_to_points(read_control_points(reference, crs), cameras, crs)
    heights, grid = read_raster(scene.path(scene.products["dsm"]))
    height = heights[0].astype(np.float32)
    if "validity" in scene.products:
        validity, _ = read_raster(scene.path(scene.products["validity"]))
        height = np.where(validity[0] == MEASURED, height, np.float32(np.nan))
    onto, onto_grid = read_raster(reference)
    try:
        return shift_to_dem(height, grid, known_heights(onto[0]), onto_grid, options.method)
    except (InputError, SceneError) as error:
        raise InputError(f"{reference}: {error}") from None


def read_control_points(path: Path, crs: str) -> list[ControlPoint]:
    """Control points of a CSV; see `AlignOptions.to` for its columns.

    Args:
        path: the file.
        crs: of ``x`` and ``y``; ``lon``, ``lat`` are brought to it.

    Raises:
        InputError: unreadable, a column is missing, or a number is none.
    """
    points = []
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path))))
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read ({error}), expected a CSV of control points") from None
    for number, row in enumerate(rows, 1):
        place = ("x", "y") if row.get("x") else ("lon", "lat")
        missing = [name for name in (*place, *COLUMNS) if not row.get(name)]
        if missing:
            raise InputError(f"{path}: found no {missing[0]} in row {number}, expected x, y or lon, lat and {COLUMNS}")
        try:
            x, y, z, column, line = (float(row[name]) for name in (*place, "z", "column", "row"))
        except ValueError:
            raise InputError(f"{path}: found a place that is no number in row {number}, expected numbers") from None
        if not np.isfinite([x, y, z, column, line]).all():
            raise InputError(f"{path}: found a place that is not finite in row {number}, expected numbers")
        if place[0] == "lon":
            x, y = (float(v) for v in from_geographic(crs, x, y))
        points.append(ControlPoint(row.get("name") or str(number), x, y, z, row["item"], column, line))
    if not points:
        raise InputError(f"{path}: found no control point, expected some")
    return points


def _moves(scene: Scene, folder: str, shift: Shift) -> dict[tuple[str | None, str], Move]:
    """All maps of the ground that move, by image (None = of the scene) and name."""
    moves: dict[tuple[str | None, str], Move] = {}
    made = set().union(*(names_of(stage) for stage in STAGES.values()))  # a reference that the scene brings stays
    for name, href in scene.products.items():
        if name in made and Path(href).suffix == ".tif":
            up = shift.up if name in HEIGHTS else 0.0
            moves[None, name] = Move(scene.path(href), f"{folder}/{name}.tif", up)
    for item in scene.items:
        for name in ON_THE_GROUND:
            if name in item.assets:
                href = f"{folder}/{name}/{item.id}.tif"
                moves[item.id, name] = Move(scene.path(item.assets[name].href), href, 0.0)
    return moves


def _moved_cameras(scene: Scene, grid: Grid, shift: Shift) -> dict[str, RPC]:
    """The cameras that see at p + shift what they saw at p, by the names of their files."""
    west, south, east, north = grid.bounds
    x, y = (west + east) / 2, (south + north) / 2
    (lon0, lat0), (lon1, lat1) = to_geographic(grid.crs, x, y), to_geographic(grid.crs, x + shift.east, y + shift.north)
    return {
        f"{item.id}{end}": RPC.from_file(scene.path(item.assets[asset].href)).moved(
            float(lon1 - lon0), float(lat1 - lat0), shift.up
        )
        for item in scene.items
        for asset, end in CAMERAS.items()
        if asset in item.assets
    }


def _move_model(scene: Scene, href: str, shift: Shift) -> list[str]:
    """Write the moved model; names of the products that are dropped as they cannot be moved."""
    if "model" not in scene.products:
        return []
    from sattools.fit.model import FittedModel

    model = FittedModel.load(scene.path(scene.products["model"]))
    if model.field != "surface":
        return [name for name in STAGES["fit"].products if scene.products.pop(name, None) is not None]
    moved = replace(
        model,
        grid=model.grid.moved(shift.east, shift.north),
        height=model.height + shift.up,
        z_ref=model.z_ref + shift.up,
    )
    moved.save(scene.output(href))
    scene.products["model"] = href
    return []


def _write_moved(scene: Scene, move: Move, shift: Shift) -> None:
    array, grid = read_raster(move.source)
    with opened(move.source) as data:
        tags = {name: text for name, text in data.tags().items() if name != "AREA_OR_POINT"}
        units, names, nodata = data.units[0], [text or "" for text in data.descriptions], data.nodata
    if move.up:
        array = (array + move.up).astype(array.dtype)
    there = grid.moved(shift.east, shift.north)
    vertical = raster_vertical(move.source)
    out = scene.output(move.href)
    write_cog(out, array, there, nodata=nodata, units=units, tags=tags, descriptions=names, vertical=vertical)


def _recorded(scene: Scene, records: dict[str, JsonObject | None]) -> dict[str, JsonObject]:
    """What the stages before have made, as it is now: moving makes nothing out of date."""
    made: dict[str, JsonObject] = {}
    items = {item.id: item for item in scene.items}
    for stage, entry in records.items():
        if entry is not None and stage != "compare":
            made |= record(scene, stage, [items[name] for name in entry["items"] if name in items])
    return made


__all__ = ["align", "read_control_points"]

"""The stage `align`: a scene is moved onto a reference, cameras, surface and maps alike."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sattools.align.estimate import UNLIKE, point_residuals, shift_to_points, wrong_points
from sattools.align.options import AlignOptions
from sattools.align.reference import check_reference, holds_points, read_control_points
from sattools.align.shift import Shift
from sattools.align.surface import SurfaceFiles, shift_to_raster
from sattools.camera.ground import from_geographic, to_geographic
from sattools.camera.rpc import RPC
from sattools.errors import InputError, MissingProductError, SceneError
from sattools.export.products.collection import PRODUCTS as CATALOGUE
from sattools.export.products.names import FILES
from sattools.progress import Progress, silent, subprogress
from sattools.scene import Asset, Grid, Scene
from sattools.scene.cog import CogWriter
from sattools.scene.datums import difference as datums_differ
from sattools.scene.dependencies import MADE, STAGES, check_current, drop, files_of, latest, names_of, record
from sattools.scene.files import check_outputs, write_text
from sattools.scene.jsonio import JsonObject
from sattools.scene.location import location
from sattools.scene.memory import give_back
from sattools.scene.opening import opened
from sattools.scene.raster import heights_above, raster_grid, raster_vertical, read_raster
from sattools.scene.stored import cut

log = logging.getLogger(__name__)
HEIGHTS = ("dsm", "dtm", "prior_dsm", "prior_surroundings")
CAMERAS = {"rpc": "_RPC.TXT", "colours_rpc": "_COLOURS_RPC.TXT"}  # of an item: asset -> end of its file's name
ON_THE_GROUND = ("shadow", "s_net", "tau", "beta")  # assets of images that are maps of the ground
MADE_OF_MAPS = sorted(
    {name for files in FILES.values() for name, href in files.items() if not href.endswith(".tif")}
    | {"dsm_picture", *CATALOGUE}
)
TRANSFORM = "transform.json"
MAX_TILT = 0.02  # beyond, normals would have to turn, and no satellite's camera is off like that [m/m]
STEP_DEG = 1e-3  # of the derivative of places on the ground


@dataclass(frozen=True)
class Move:
    """A raster that is moved.

    Attributes:
        source: file.
        href: of the moved one.
        heights: its numbers are heights, which rise.
    """

    source: Path
    href: str
    heights: bool


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
    moves, folder = _begun(scene, options, overwrite)
    assert options.to is not None  # `_begun` has looked
    reference = location(options.to)
    progress(0.0, "registering")
    grid = scene.require_grid()
    records = {stage: latest(scene, stage) for stage in STAGES}
    shift, about = _shift(scene, reference, options, subprogress(progress, 0.0, 0.3))
    give_back()  # what was held of both surfaces, before maps are written
    _check(shift, reference, options)
    progress(0.3, "moving")
    dropped = drop(scene, "compare")
    cameras = _moved_cameras(scene, grid, shift)
    dropped += _move_model(scene, f"{folder}/model.safetensors", shift)
    give_back()
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
        edges = [(slice(0, 1), slice(n - 1, n)) for n in grid.shape]
        rise = np.array([shift.rise(grid.part(row, col)) for row in edges[0] for col in edges[1]])
        scene.height_range_m = (low + float(rise.min()), high + float(rise.max()))
    transform = {"crs": grid.crs, "matrix": shift.matrix().tolist(), "method": options.method, **asdict(shift), **about}
    write_text(scene.output(f"{folder}/{TRANSFORM}"), json.dumps(transform, indent=1) + "\n")
    progress(1.0, "aligned")
    stayed = _not_moved(dropped)
    for text in stayed:
        log.warning("%s: %s", scene.id, text)
    notes = [shift.text("px" if "residuals" in about else "m"), *about.get("notes", []), *stayed]
    figures = {"shift": asdict(shift), "transform": f"{folder}/{TRANSFORM}", "notes": notes}
    return {**figures, "dropped": sorted(dropped), MADE: _recorded(scene, records)}


def check_start(scene: Scene, options: AlignOptions, overwrite: bool = False) -> None:
    """What `align` looks at before its work, for a dry run; arguments and errors as of it."""
    _begun(scene, options, overwrite)


def check_options(options: AlignOptions, crs: str = "EPSG:4326") -> Path:
    """What `check_start` can tell without a scene; the reference.

    Args:
        options: see `AlignOptions`.
        crs: the scene's; any where it is not known yet.

    Raises:
        InputError: options that do not go with each other, or a reference that is none.
    """
    if options.to is None:
        raise InputError("found no --to, expected a raster of heights or ground control points")
    if options.tilt and options.method in ("nuth-kaab", "z"):
        raise InputError(f"found --tilt with --method {options.method}, expected --method means or icp")
    reference = location(options.to)
    check_reference(reference, crs)
    if holds_points(reference) and (options.tilt or options.method == "z"):
        what = "--tilt" if options.tilt else "--method z"
        raise InputError(f"{reference}: found control points, expected a raster of heights for {what}")
    return reference


def _begun(scene: Scene, options: AlignOptions, overwrite: bool) -> tuple[dict[tuple[str | None, str], Move], str]:
    """The maps that will move and the folder of the moved ones, once all is checked that needs no work."""
    reference = check_options(options, scene.require_grid().crs)
    if holds_points(reference) and options.method != "auto":
        log.warning("%s: control points, for which --method %s does nothing", reference, options.method)
    if "dsm" not in scene.products:
        raise MissingProductError(f"scene {scene.id}: found no DSM, expected one made by `sattools export`")
    check_current(scene, "export")
    folder = f"align/{1 + sum(entry.get('command') == 'align' for entry in scene.history)}"
    moves = _moves(scene, folder)
    files = [f"{item.id}{end}" for item in scene.items for asset, end in CAMERAS.items() if asset in item.assets]
    named = [f"{folder}/{name}" for name in (*files, "model.safetensors", TRANSFORM)]
    outputs = [move.href for move in moves.values()] + named
    check_outputs([scene.path(href) for href in outputs], [*files_of(scene), reference], overwrite)
    return moves, folder


def _check(shift: Shift, reference: Path, options: AlignOptions) -> None:
    tilt = np.hypot(shift.tilt_east, shift.tilt_north)
    if not tilt <= MAX_TILT:
        raise InputError(
            f"{reference}: found a tilt of {np.ceil(1e4 * tilt) / 1e4:g} m/m ({shift.tilt_east:.4f} eastwards, "
            f"{shift.tilt_north:.4f} northwards), expected at most {MAX_TILT:g}: are both of the same ground?"
        )
    flat = np.hypot(shift.east, shift.north)
    if not np.hypot(flat, shift.up) <= options.max_shift:
        same = "vertical datums the same" if flat <= abs(shift.up) else "places in the CRS that they are said to be in"
        raise InputError(
            f"{reference}: found a shift of {shift.east:.1f}, {shift.north:.1f}, {shift.up:.1f} m, expected at most "
            f"{options.max_shift:g} m (--max-shift); are the {same}?"
        )


@contextmanager
def _named(reference: Path) -> Iterator[None]:
    """Errors inside, of arrays and points that have no name, begin with that of their file."""
    try:
        yield
    except (InputError, SceneError) as wrong:
        said = str(wrong).removeprefix("reference: ")
        raise InputError(said if said.startswith(f"{reference}:") else f"{reference}: {said}") from None


def _shift(scene: Scene, reference: Path, options: AlignOptions, progress: Progress) -> tuple[Shift, JsonObject]:
    """The shift, and what else there is to say of it: residuals of control points, a warning about datums."""
    grid = scene.require_grid()
    if holds_points(reference):
        cameras = {i.id: RPC.from_file(scene.path(i.assets["rpc"].href)) for i in scene.items if "rpc" in i.assets}
        points = read_control_points(reference, grid.crs)
        with _named(reference):
            shift = shift_to_points(points, cameras, grid.crs)
        before = point_residuals(points, cameras, grid.crs)
        after = point_residuals(points, cameras, grid.crs, np.array([shift.east, shift.north, shift.up]))
        residuals = [
            {"name": p.name, "item": p.item, "before_px": b.round(3).tolist(), "after_px": a.round(3).tolist()}
            for p, b, a in zip(points, before, after, strict=True)
        ]
        wrong = [
            f"control point {p.name} in {p.item} is {np.hypot(*r):.1f} px off and was given next to no weight"
            for p, r, bad in zip(points, after, wrong_points(after), strict=True)
            if bad
        ]
        for message in wrong:
            log.warning("%s: %s", scene.id, message)
        return shift, {"method": "points", "residuals": residuals, "notes": wrong}
    dsm = scene.path(scene.products["dsm"])
    text = datums_differ({"the DSM": heights_above(dsm), "the reference": heights_above(reference)})
    if text is not None:
        log.warning("%s: %s", scene.id, text)
    files = SurfaceFiles(dsm, _product(scene, "validity"), _product(scene, "dsm_error95"))
    with _named(reference):
        shift, method = shift_to_raster(files, reference, options, progress)
    notes = [] if text is None else [text]
    if shift.left > UNLIKE:
        notes.append(
            f"{reference}: what is left between it and the surface varies {shift.left:.1f} times as much as the "
            "surface itself: are they heights of the same ground in metres?"
        )
        log.warning("%s: %s", scene.id, notes[-1])
    return shift, {"method": method, **({"notes": notes} if notes else {})}


def _product(scene: Scene, name: str) -> Path | None:
    return scene.path(scene.products[name]) if name in scene.products else None


def _moves(scene: Scene, folder: str) -> dict[tuple[str | None, str], Move]:
    """All maps of the ground that move, by image (None = of the scene) and name."""
    moves: dict[tuple[str | None, str], Move] = {}
    # a reference that the scene brings stays, and scores are dropped
    made = set().union(*(names_of(stage) for name, stage in STAGES.items() if name != "compare"))
    for name, href in scene.products.items():
        if name in made and Path(href).suffix == ".tif":
            moves[None, name] = Move(scene.path(href), f"{folder}/{name}.tif", name in HEIGHTS)
    for item in scene.items:
        for name in ON_THE_GROUND:
            if name in item.assets:
                href = f"{folder}/{name}/{item.id}.tif"
                moves[item.id, name] = Move(scene.path(item.assets[name].href), href, False)
    return moves


def _moved_cameras(scene: Scene, grid: Grid, shift: Shift) -> dict[str, RPC]:
    """The cameras that see at the moved place what they saw before, by the names of their files."""
    x, y = grid.middle
    (lon0, lat0), (lon1, lat1) = to_geographic(grid.crs, x, y), to_geographic(grid.crs, x + shift.east, y + shift.north)

    def moved(rpc: RPC) -> RPC:
        if shift.tilted:
            rpc = rpc.tilted(*to_geographic(grid.crs, shift.x, shift.y), _per_degree(grid.crs, shift))
        return rpc.moved(float(lon1 - lon0), float(lat1 - lat0), shift.up)

    return {
        f"{item.id}{end}": moved(RPC.from_file(scene.path(item.assets[asset].href)))
        for item in scene.items
        for asset, end in CAMERAS.items()
        if asset in item.assets
    }


def _per_degree(crs: str, shift: Shift) -> tuple[float, float]:
    """The tilt as a rise along longitude and latitude [m/degree]."""
    lon, lat = to_geographic(crs, shift.x, shift.y)
    lons, lats = lon + np.array([-1, 1, 0, 0]) * STEP_DEG, lat + np.array([0, 0, -1, 1]) * STEP_DEG
    x, y = from_geographic(crs, lons, lats)
    rise = shift.tilt_east * x + shift.tilt_north * y
    return float(rise[1] - rise[0]) / (2 * STEP_DEG), float(rise[3] - rise[2]) / (2 * STEP_DEG)


def _move_model(scene: Scene, href: str, shift: Shift) -> list[str]:
    """Write the moved model; names of the products that are dropped as they cannot be moved."""
    if "model" not in scene.products:
        return []
    from sattools.fit.stored import StoredModel, StreamedModel

    stored = StoredModel.open(scene.path(scene.products["model"]))
    about, grid = stored.about, stored.grid
    if about.field != "surface":
        return [name for name in STAGES["fit"].products if scene.products.pop(name, None) is not None]
    there = grid.moved(shift.east, shift.north)
    if not stored.plain:  # a reflectance model has maps of its own
        import torch

        model = stored.load()
        height = model.height + torch.from_numpy(shift.rise(grid)).to(model.height.dtype)
        replace(model, grid=there, z_ref=about.z_ref + shift.up, height=height).save(scene.output(href))
    else:

        def maps(rows: slice) -> dict[str, np.ndarray]:
            part = stored.maps(rows, slice(0, grid.width))
            height = part.height + shift.rise(grid.part(rows, slice(0, grid.width))).astype(part.height.dtype)
            return {"height": height, "height_std": part.height_std, "albedo": part.albedo, **part.images}

        about = replace(about, grid=there, z_ref=about.z_ref + shift.up)
        images, strip = tuple(sorted(stored.image_maps)), stored.strips()[0].stop
        StreamedModel(about, stored.colours(), stored.bands, images, maps, strip).save(scene.output(href))
    scene.products["model"] = href
    return []


def _not_moved(dropped: Sequence[str]) -> list[str]:
    """What to say of products that lie where they were: somebody may have handed them on."""
    files = sorted(set(dropped) & set(MADE_OF_MAPS) - {"dsm_picture", *CATALOGUE})
    notes = []
    if files:
        told = "not moved, and no products any more; `sattools export --overwrite --products ...` makes them anew"
        notes.append(f"{', '.join(files)}: {told}")
    if "model" in dropped:
        notes.append("model: not moved, as it is a network's, and no product any more; `sattools fit` makes one anew")
    return notes


def _write_moved(scene: Scene, move: Move, shift: Shift) -> None:
    grid = raster_grid(move.source)
    with opened(move.source) as data:
        tags = {name: text for name, text in data.tags().items() if name != "AREA_OR_POINT"}
        about: dict[str, Any] = {
            "bands": data.count, "dtype": data.dtypes[0], "units": data.units[0], "nodata": data.nodata,
            "descriptions": [text or "" for text in data.descriptions], "vertical": raster_vertical(move.source),
        }  # fmt: skip
    with CogWriter(scene.output(move.href), grid.moved(shift.east, shift.north), tags=tags, **about) as out:
        for rows, cols in cut(grid.shape):
            array, part = read_raster(move.source, grid.part(rows, cols), stored=True)
            if move.heights:
                array = np.where(array == about["nodata"], array, array + shift.rise(part)).astype(array.dtype)
            out.write(array, rows, cols)


def _recorded(scene: Scene, records: dict[str, JsonObject | None]) -> dict[str, JsonObject]:
    """What the stages before have made, as it is now: moving makes nothing out of date."""
    made: dict[str, JsonObject] = {}
    items = {item.id: item for item in scene.items}
    for stage, entry in records.items():
        if entry is not None and stage != "compare":
            own = {key: entry[key] for key in ("implicit",) if key in entry}
            made |= record(scene, stage, [items[name] for name in entry["items"] if name in items], **own)
    return made


__all__ = ["align", "check_options", "check_start"]

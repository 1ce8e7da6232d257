"""The prep stage: images with RPC cameras become a scene with corrected cameras, angles, heights and a grid."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from shapely.geometry import box

from sattools.camera.adjust import Adjustment, adjust
from sattools.camera.ground import check_ground_crs, check_scale, utm_crs
from sattools.camera.tiepoints import TiePointImage, TiePointOptions, find_tie_points
from sattools.errors import InputError, SattoolsError
from sattools.prep.area import bounds_from_file, bounds_from_numbers, exchanged_bounds, wanted_area
from sattools.prep.blank import check_contents
from sattools.prep.camera_gate import check_corrections, check_height_unit, check_places_and_suns
from sattools.prep.colours import add_colours, hrefs, load_colours
from sattools.prep.earlier import left_by_earlier, remove_left
from sattools.prep.folders import input_files
from sattools.prep.gate import (
    check_cells,
    check_heights,
    check_metadata,
    check_pixel_sizes,
    check_pixels,
    check_sources,
)
from sattools.prep.images import SourceImage
from sattools.prep.large import GrayImages, read_grays, tie_points_by_windows
from sattools.prep.layout import (
    Bounds,
    common_bounds,
    cut_to_shown,
    ground_polygon,
    left_out,
    pixels_on_ground,
    with_rim,
)
from sattools.prep.loading import load_source
from sattools.prep.names import check_ids, common_name
from sattools.prep.options import PrepOptions
from sattools.prep.outputs import REPORTS, clouds_href, write_images, write_reports
from sattools.prep.pairs import IN_HISTORY, pair_table, repeated
from sattools.prep.places import check_places, cropped_to_area, middle_of, search_heights, show, sizes_read
from sattools.prep.sweeps import height_range, mask_clouds
from sattools.progress import Progress, silent, subprogress
from sattools.scene import Grid, Scene
from sattools.scene.area import AREA, write_area
from sattools.scene.dependencies import IMAGES, begin, image_digests, may_begin
from sattools.scene.grid import default_cell_size, finer_pixel
from sattools.scene.jsonio import JsonObject
from sattools.scene.location import location
from sattools.scene.runner import at_the_end
from sattools.scene.schema import meant
from sattools.views import GROUND_SHARE

log = logging.getLogger(__name__)


def prepare(
    images: Sequence[Path], options: PrepOptions, progress: Progress = silent, overwrite: bool = False
) -> tuple[Scene, JsonObject]:
    """Make a scene of images that show one place.

    Below `options.out/<scene id>`: `images/<item>.tif` (same pixels, corrected RPC tags, cropped to the area asked
    for), `rpc/<item>_RPC.TXT`, `tie_points.geojson`, `adjustment.json`, `adjustment.txt`. Everything is checked before
    anything is written.

    Args:
        images: files to read.
        options: of the stage.
        progress: told the share done and what is being done.
        overwrite: replace outputs that are there; what `prep` has written of images that are no more goes, too.

    Returns: the scene, and notes and figures for its history.
    Raises: InputError (one line, naming the file) for images that cannot be used; OutputExistsError.
    """
    images, ids, scene = _named(images, options)
    begin(scene, "prep", _outputs(ids, options), overwrite, read := _inputs(images, options))
    left = left_by_earlier(scene) if overwrite else []
    progress(0.0, "reading metadata")
    notes: list[str] = []
    sources, crs, asked = survey(images, ids, options, notes)
    wanted = _wanted(options, crs)
    colours = load_colours(options.colours, _folder(options.metadata), sources) if options.colours else []

    whole = read_grays(sources, subprogress(progress, 0.02, 0.1))
    check_pixels(sources, whole.grays)
    whole = whole.without_holes()
    result = _adjusted(sources, whole, crs, options, subprogress(progress, 0.1, 0.75))
    if options.correction == "none":
        notes.append("cameras were left as they are (correction none)")
    notes += result.notes
    roles = _roles(options, result, sources, notes)
    _warn(check_corrections(result, sources), notes)
    given = options.min_height, options.max_height
    heights = height_range(given, result, whole, crs, asked, subprogress(progress, 0.75, 0.85))
    _warn(check_heights(*heights, result.heights(), given != (None, None)), notes)
    if options.clouds == "mask":
        roles |= _clouded(mask_clouds(sources, result, whole, crs, asked, heights), notes)
        _check_left(roles, "are not covered by clouds (`--clouds keep` goes on with them)")
    ground = _ground_height(options, result, heights)
    scene.grid = _grid(options, sources, result, crs, (heights, ground), asked, edges=whole.edges(), notes=notes)
    scene.height_range_m = heights
    seen_at = ground, heights[0] + GROUND_SHARE * (heights[1] - heights[0])
    roles |= _outside(scene.grid, seen_at, sources, result, whole.edges(), notes)
    _check_left(roles, "show the area")
    used = [name for name, role in roles.items() if role == "train"]
    check_contents(sources, result.rpcs, whole, (scene.grid, ground), used)
    last = subprogress(progress, 0.85, 1.0)
    cameras = [rpc.cropped(-s.window[0], -s.window[1]) for rpc, s in zip(result.rpcs, sources, strict=True)]
    write_images(scene, sources, result, last, crop=asked is not None, copy=options.copy)
    for item in scene.items:
        item.properties["sattools:role"] = roles[item.id]
    if colours:
        _warn(add_colours(scene, sources, colours, cameras), notes)
    for source in sources:
        notes += [f"{source.id}: {r}" for r in source.notes]
    pairs = pair_table(result, scene.grid, heights)
    _warn(repeated(pairs, result, sources), notes)
    write_reports(scene, result, pairs)
    if (area := wanted(scene.grid.bounds)) is not None:
        write_area(scene, area)
    at_the_end(lambda: remove_left(left, scene, read))
    progress(1.0, "done")
    return scene, {
        "notes": notes,
        IMAGES: image_digests(scene),
        "adjustment": {
            "model": result.model,
            "median_before_px": round(result.median_before_px, 3),
            "median_after_px": round(result.median_after_px, 3),
            "outlier_views": [v.name for v in result.views if v.outlier],
            "pairs": pairs[:IN_HISTORY],
        },
    }


def _adjusted(
    sources: Sequence[SourceImage],
    whole: GrayImages,
    crs: str,
    options: PrepOptions,
    progress: Progress,
) -> Adjustment:
    """Cameras of the sources' windows, corrected by tie points unless the options forbid it."""
    cameras = [s.rpc.cropped(s.window[0], s.window[1]) for s in sources]
    model = "shift" if options.correction == "none" else options.correction
    sizes = [(s.window[3], s.window[2]) for s in sources]
    matching = subprogress(progress, 0.0, 0.45 / 0.65)
    heights = search_heights(sources, (options.min_height, options.max_height))
    try:
        if whole.reduced:
            tracks = tie_points_by_windows(sources, whole, crs, heights, matching)
        else:
            views = [TiePointImage(s.id, g, c) for s, g, c in zip(sources, whole.grays, cameras, strict=True)]
            seek = TiePointOptions(max_height_m=heights.half)
            tracks = find_tie_points(views, crs, seek, matching, z_ref=heights.middle)
        last = subprogress(progress, 0.45 / 0.65, 1.0)
        result = adjust(cameras, [s.id for s in sources], sizes, tracks, model, last)
    except SattoolsError:
        raise
    except (ValueError, ArithmeticError, cv2.error) as error:  # of linear algebra and of OpenCV, on absurd cameras
        text = " ".join(str(error).split())[:200]
        raise InputError(f"cameras: found no solution ({text}), expected the RPCs of these images") from error
    return result.left_alone(cameras) if options.correction == "none" else result


def check_inputs(images: Sequence[Path], options: PrepOptions, overwrite: bool = False) -> list[tuple[int, int]]:
    """All checks of `prepare` that need no pixels; raises what it would raise. Rows and columns that are read."""
    images, ids, scene = _named(images, options)
    may_begin(scene, "prep", _outputs(ids, options), overwrite, _inputs(images, options))
    sources, crs, asked = survey(images, ids, options, [])
    _wanted(options, crs)
    if options.colours:
        load_colours(options.colours, _folder(options.metadata), sources)
    return sizes_read(sources, crs, asked, (options.min_height, options.max_height))


def _named(images: Sequence[Path], options: PrepOptions) -> tuple[list[Path], list[str], Scene]:
    """The images' places and ids, and the scene that they will make, so far without them."""
    places = [location(p) for p in images]
    ids = check_ids(places)
    _check_options(options, ids)
    name = options.id or common_name(ids)
    return places, ids, Scene(name, Path(options.out) / name)


def survey(
    images: Sequence[Path], ids: Sequence[str], options: PrepOptions, notes: list[str]
) -> tuple[list[SourceImage], str, Bounds | None]:
    """All that can be said without reading pixels: the images that show the area, the ground CRS, the area asked for.

    Raises InputError for what cannot be used; warns of what is odd.

    Args:
        images: files to read.
        ids: their ids.
        options: of the stage.
        notes: gets what a user should know.
    """
    metadata_dir = _folder(options.metadata)
    sources = [load_source(p, i, metadata_dir) for p, i in zip(images, ids, strict=True)]
    check_sources(sources)
    _warn([*check_metadata(sources, metadata_dir), *check_places_and_suns(sources)], notes)
    _warn(check_height_unit(sources), notes)
    crs = _ground_crs(options, sources)
    given = (options.min_height, options.max_height)
    left: list[str] = []
    try:
        asked = _asked_bounds(options, crs)
        if asked is not None:
            sources = cropped_to_area(sources, crs, asked, given, left)
    except InputError as error:
        other = None if options.crs and options.bounds else exchanged_bounds(_area(options), crs)
        if other is None or not show(sources, crs, other, given):
            raise
        raise InputError(f"{error} (with its coordinates exchanged it is there: longitude comes first)") from None
    _warn(left, notes)
    if left and (own := _ground_crs(options, sources)) != crs:  # those of other places say nothing of the zone
        crs, asked = own, _asked_bounds(options, own)
        sources = cropped_to_area(sources, crs, asked, given, []) if asked else sources
    check_places(sources, crs, given)
    return sources, crs, asked


def _ground_crs(options: PrepOptions, sources: Sequence[SourceImage]) -> str:
    """The CRS that is asked for, or that of the images' place."""
    lon, lat = middle_of(sources)
    crs = check_ground_crs(options.crs) if options.crs else utm_crs(lon, lat)
    check_scale(crs, lon, lat)
    return crs


def _folder(metadata: str | None) -> Path | None:
    if metadata and not Path(metadata).is_dir():
        raise InputError(f"{metadata}: found no such folder, expected one with metadata files")
    return Path(metadata) if metadata else None


def _check_options(options: PrepOptions, ids: Sequence[str]) -> None:
    """Raise InputError for options that contradict each other or the images."""
    unknown = sorted(set(options.holdout) - set(ids))
    if unknown:
        raise InputError(
            f"holdout: found {unknown[0]!r}, expected one of {', '.join(ids[:4])} ...{meant(unknown[0], ids)}"
        )
    left = len(ids) - len(set(options.holdout))
    if left < 2:
        raise InputError(f"holdout: found {left} of {len(ids)} images left for training, expected at least 2")
    if options.min_height is not None and options.max_height is not None:
        check_heights(options.min_height, options.max_height, np.zeros(0), True)


def _warn(found: Sequence[str], notes: list[str]) -> None:
    """Remarks that the user sees at once."""
    for text in found:
        notes.append(text)
        log.warning("%s", text)


def _roles(
    options: PrepOptions, result: Adjustment, sources: Sequence[SourceImage], notes: list[str]
) -> dict[str, str]:
    """Role of every image; one without tie points is set aside, as its camera may be anything.

    Raises InputError where fewer than two are left to train on.
    """
    roles = {s.id: "test" if s.id in options.holdout else "train" for s in sources}
    for view in result.views:
        if not view.weak:
            continue
        if options.correction == "none":  # the user vouches for the cameras
            _warn([f"{view.name}: too few tie points to tell whether its camera is right"], notes)
            continue
        roles[view.name] = "unused"
        _warn([f"{view.name}: too few tie points with the other images, set aside (role unused)"], notes)
    _check_left(roles, "have enough tie points with others")
    return roles


def _clouded(ids: Sequence[str], notes: list[str]) -> dict[str, str]:
    """Roles of images that show next to nothing but clouds."""
    _warn([f"{name}: clouds hide the area, set aside (role unused)" for name in ids], notes)
    return dict.fromkeys(ids, "unused")


def _check_left(roles: Mapping[str, str], what: str) -> None:
    """Raise InputError where fewer than two images are left to train on."""
    left = [name for name, role in roles.items() if role == "train"]
    if len(left) < 2:
        raise InputError(
            f"images: found {len(left)} for training that {what}, expected at least 2 "
            "(do they show the same place, with their own RPCs?)"
        )


def _ground_height(options: PrepOptions, result: Adjustment, heights: tuple[float, float]) -> float:
    """Height [m] at which images are laid over the ground."""
    if (options.min_height, options.max_height) != (None, None):  # a range by hand may be wide: where the ground is
        return float(np.clip(np.median(result.heights()), *heights))
    return 0.5 * (heights[0] + heights[1])


def _outside(
    grid: Grid,
    heights: Sequence[float],
    sources: Sequence[SourceImage],
    result: Adjustment,
    edges: Sequence[NDArray[np.float64] | None],
    notes: list[str],
) -> dict[str, str]:
    """Roles of images that show nothing of the area, as tiles of a mosaic beside it: every fit would refuse them.

    At the heights of the ground at which fits look at them: at the ends of a wide range slanting views are far from it.
    """
    found = {}
    for source, rpc, edge in zip(sources, result.rpcs, edges, strict=True):
        window = (0, 0, source.window[2], source.window[3])
        shown = (ground_polygon(rpc, window, height, grid.crs, edge) for height in heights)
        if not all(polygon.intersects(box(*grid.bounds)) for polygon in shown):
            found[source.id] = "unused"
            _warn([f"{source.id}: shows nothing of the area, set aside (role unused)"], notes)
    return found


def _inputs(images: Sequence[Path], options: PrepOptions) -> list[Path]:
    """All files that will be read."""
    return input_files(images, options.metadata, [options.aoi, *options.mask], options.colours)


def _outputs(ids: Sequence[str], options: PrepOptions) -> list[str]:
    """All files that may be written; images that do not show the area are left out."""
    copies = [] if options.copy is False else [f"images/{i}.tif" for i in ids]
    copies += hrefs(ids) if options.colours else []
    copies += [clouds_href(i) for i in ids] if options.copy is not True and options.clouds == "mask" else []
    return [*REPORTS.values(), AREA, "scene.json", *copies, *(f"rpc/{i}_RPC.TXT" for i in ids)]


def _asked_bounds(options: PrepOptions, crs: str) -> Bounds | None:
    if options.aoi and options.bounds:
        raise InputError("area: found both --aoi and --bounds, expected one of them")
    if options.aoi:
        return bounds_from_file(location(options.aoi), crs)
    return bounds_from_numbers(options.bounds, crs, options.crs) if options.bounds else None


def _area(options: PrepOptions) -> Path | Sequence[float]:
    return location(options.aoi) if options.aoi else options.bounds or []


def _wanted(options: PrepOptions, crs: str) -> Callable[[Bounds], Any]:
    return wanted_area(location(options.aoi) if options.aoi else None, [location(name) for name in options.mask], crs)


def _grid(
    options: PrepOptions,
    sources: Sequence[SourceImage],
    result: Adjustment,
    crs: str,
    levels: tuple[tuple[float, float], float],
    asked: Bounds | None,
    *,
    edges: Sequence[NDArray[np.float64] | None],
    notes: list[str],
) -> Grid:
    rpcs, (heights, middle) = result.rpcs, levels  # the range of heights, and the ground's
    windows = [(0, 0, s.window[2], s.window[3]) for s in sources]
    shown = list(zip(rpcs, windows, edges, strict=True))
    polygons = [ground_polygon(r, w, middle, crs, edge) for r, w, edge in shown]
    covered = common_bounds(polygons)
    if covered is None:
        raise InputError(f"images: found no ground at {middle:.0f} m that half of them show, expected some they share")
    sizes, ups = pixels_on_ground(rpcs, [(rows, columns) for _, _, columns, rows in windows], middle)
    _warn(check_pixel_sizes(sizes, ups), notes)
    pixel = finer_pixel(sizes)
    cell = options.cell_size or default_cell_size(pixel)
    if asked is not None:
        at_ends = [[ground_polygon(r, w, h, crs, edge) for r, w, edge in shown] for h in heights]
        if (rest := cut_to_shown(asked, at_ends)) != asked:
            _warn(["less than half of the area lies where two images show it: cut to that"], notes)
            asked = rest
    else:
        _warn(left_out(covered, polygons, crs), notes)
    grid = Grid.from_bounds(crs, asked or with_rim(covered), cell)
    check_cells(grid, pixel)
    return grid


__all__ = ["PrepOptions", "check_inputs", "prepare"]

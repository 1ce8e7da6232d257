"""The prep stage: images with RPC cameras become a scene with corrected cameras, angles, heights and a grid."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sattools.camera import RPC
from sattools.camera.adjust import Adjustment, AdjustOptions, adjust
from sattools.camera.ground import check_projected, check_scale, ground_sample_distance, utm_crs
from sattools.camera.heights import estimate_height_range
from sattools.camera.tiepoints import View, find_tie_points
from sattools.errors import InputError, SattoolsError
from sattools.prep.area import bounds_from_geojson, bounds_from_numbers
from sattools.prep.gate import (
    check_cells,
    check_corrections,
    check_height_unit,
    check_heights,
    check_pixels,
    check_places_and_suns,
    check_sources,
)
from sattools.prep.images import Source, check_ids, load_source, read_gray, write_image
from sattools.prep.items import describe, tie_point_features
from sattools.prep.layout import (
    Bounds,
    common_bounds,
    crop_window,
    default_cell_size,
    ground_polygon,
    groups,
    outline,
)
from sattools.prep.options import PrepOptions
from sattools.progress import Progress, part, silent
from sattools.scene import Grid, Scene
from sattools.scene.dependencies import begin
from sattools.scene.files import write_text
from sattools.scene.location import RemotePath, location
from sattools.scene.schema import meant
from sattools.scene.sidecars import sidecars

log = logging.getLogger(__name__)
_BIAS_MARGIN_PX = 150  # raw cameras may be off by that much; the corrected ones need far less
_FINAL_MARGIN_PX = 16
_SEARCH_HEIGHT_M = 600.0
_REPORTS = {
    "adjustment": "adjustment.json",
    "adjustment_report": "adjustment.txt",
    "tie_points": "tie_points.geojson",
}


def prepare(
    images: Sequence[Path], options: PrepOptions, progress: Progress = silent, overwrite: bool = False
) -> tuple[Scene, dict[str, Any]]:
    """Make a scene of images that show one place.

    Below `options.out/<scene id>`: `images/<item>.tif` (same pixels, corrected RPC tags, cropped to the area asked
    for), `rpc/<item>_RPC.TXT`, `tie_points.geojson`, `adjustment.json`, `adjustment.txt`. Everything is checked before
    anything is written.

    Returns: the scene, and remarks and figures for its history.
    Raises: InputError (one line, naming the file) for images that cannot be used; OutputExistsError.
    """
    images = [location(p) for p in images]
    ids = check_ids(images)
    _check_options(options, ids)
    scene = Scene(options.id or common_name(ids), Path(options.out) / (options.id or common_name(ids)))
    begin(scene, "prep", _outputs(ids), overwrite, _inputs(images, options))
    progress(0.0, "reading metadata")
    remarks: list[str] = []
    sources, crs, asked = survey(images, ids, options, remarks)

    grays = []
    for k, source in enumerate(sources):
        progress(0.02 + 0.08 * k / len(sources), f"reading {source.id}")
        grays.append(read_gray(source))
    check_pixels(sources, grays)
    cameras = [s.rpc.cropped(s.window[0], s.window[1]) for s in sources]
    views = [View(s.id, g, c) for s, g, c in zip(sources, grays, cameras, strict=True)]
    model = "shift" if options.correction == "none" else options.correction
    sizes = [(g.shape[0], g.shape[1]) for g in grays]
    try:
        tracks = find_tie_points(views, crs, progress=part(progress, 0.1, 0.55))
        names = [s.id for s in sources]
        result = adjust(cameras, names, sizes, tracks, AdjustOptions(model=model), part(progress, 0.55, 0.75))
    except SattoolsError:
        raise
    except (ValueError, ArithmeticError, cv2.error) as error:  # of linear algebra and of OpenCV, on absurd cameras
        text = " ".join(str(error).split())[:200]
        raise InputError(f"cameras: found no solution ({text}), expected the RPCs of these images") from error
    if options.correction == "none":
        remarks.append("cameras were left as they are (correction none)")
        result = replace(result, rpcs=cameras)
    remarks += result.remarks
    roles = _roles(options, result, sources, remarks)
    _warn(check_corrections(result, sources), remarks)
    heights = _height_range(options, result, grays, crs, asked, part(progress, 0.75, 0.85))
    given = options.min_height is not None or options.max_height is not None
    _warn(check_heights(*heights, result.heights(), given), remarks)
    grid = _grid(options, sources, result.rpcs, crs, heights, asked)

    scene.grid, scene.height_range_m = grid, heights
    full = [r.cropped(-s.window[0], -s.window[1]) for r, s in zip(result.rpcs, sources, strict=True)]
    for k, (source, rpc) in enumerate(zip(sources, full, strict=True)):
        progress(0.85 + 0.15 * k / len(sources), f"writing {source.id}")
        if asked is not None:
            source.window = crop_window(rpc, crs, grid.bounds, heights, source.size, _FINAL_MARGIN_PX)
            if min(source.window[2:]) < 1:
                raise InputError(f"{source.path}: found nothing of the area once its camera was corrected")
        camera = rpc.cropped(source.window[0], source.window[1])
        write_image(source, camera, scene.output(f"images/{source.id}.tif"))
        write_text(scene.output(f"rpc/{source.id}_RPC.TXT"), camera.to_rpc_txt())
        item = describe(source, camera, result.views[k], grid, heights)
        item.properties["sattools:role"] = roles[source.id]
        scene.items.append(item)
        remarks += [f"{source.id}: {r}" for r in source.remarks]
    _write_reports(scene, result)
    progress(1.0, "done")
    return scene, {
        "remarks": remarks,
        "adjustment": {
            "model": result.model,
            "median_before_px": round(result.median_before_px, 3),
            "median_after_px": round(result.median_after_px, 3),
            "outlier_views": [v.name for v in result.views if v.outlier],
        },
    }


def check_inputs(images: Sequence[Path], options: PrepOptions) -> None:
    """All checks of `prepare` that need no pixels; raises what it would raise."""
    images = [location(p) for p in images]
    ids = check_ids(images)
    _check_options(options, ids)
    survey(images, ids, options, [])


def survey(
    images: Sequence[Path], ids: Sequence[str], options: PrepOptions, remarks: list[str]
) -> tuple[list[Source], str, Bounds | None]:
    """All that can be said without reading pixels: the images that show the area, the ground CRS, the area asked for.

    Raises InputError for what cannot be used; warns of what is odd.
    """
    metadata_dir = Path(options.metadata) if options.metadata else None
    if metadata_dir is not None and not metadata_dir.is_dir():
        raise InputError(f"{metadata_dir}: found no such folder, expected one with metadata files")
    sources = [load_source(p, i, metadata_dir) for p, i in zip(images, ids, strict=True)]
    check_sources(sources)
    _warn(check_places_and_suns(sources), remarks)
    _warn(check_height_unit(sources), remarks)
    lon, lat = _middle(sources)
    crs = check_projected(options.crs) if options.crs else utm_crs(lon, lat)
    check_scale(crs, lon, lat)
    check_places(sources, crs)
    asked = _asked_bounds(options, crs)
    if asked is not None:
        sources = _cropped_to_area(sources, crs, asked, remarks)
    return sources, crs, asked


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


def _warn(found: Sequence[str], remarks: list[str]) -> None:
    """Remarks that the user sees at once."""
    for text in found:
        remarks.append(text)
        log.warning("%s", text)


def _roles(options: PrepOptions, result: Adjustment, sources: Sequence[Source], remarks: list[str]) -> dict[str, str]:
    """Role of every image; one without tie points is set aside, as its camera may be anything.

    Raises InputError where fewer than two are left to train on.
    """
    roles = {s.id: "test" if s.id in options.holdout else "train" for s in sources}
    for view in result.views:
        if not view.weak:
            continue
        if options.correction == "none":  # the user vouches for the cameras
            _warn([f"{view.name}: too few tie points to tell whether its camera is right"], remarks)
            continue
        roles[view.name] = "unused"
        _warn([f"{view.name}: too few tie points with the other images, set aside (role unused)"], remarks)
    left = [name for name, role in roles.items() if role == "train"]
    if len(left) < 2:
        raise InputError(
            f"images: found {len(left)} for training that have enough tie points with others, expected at least 2 "
            "(do they show the same place, with their own RPCs?)"
        )
    return roles


def common_name(ids: Sequence[str]) -> str:
    """What image names have in common, up to a separator; `scene` when that is nothing."""
    first, last = min(ids), max(ids)
    n = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), min(len(first), len(last)))
    head = first[:n]
    cut = max(head.rfind(s) for s in "_-.")
    return (head[:cut].rstrip("_-.") if cut > 0 else "") or "scene"


def check_places(sources: Sequence[Source], crs: str) -> None:
    """Raise InputError when images do not lie together, naming the one whose RPC is of another place."""
    polygons = []
    for s in sources:
        polygon = ground_polygon(s.rpc, s.window, s.rpc.alt_offset, crs)
        if polygon.is_empty:
            raise InputError(
                f"{s.path}: found an RPC that does not reach the image's pixels or the ground around the other images, "
                f"expected the RPC of this image (from {s.metadata.rpc_source})"
            )
        polygons.append(polygon)
    found = groups(polygons)
    if len(found) == 1:
        return
    if len(found[0]) == 1 or len(found[0]) == len(found[1]):
        raise InputError(
            f"{sources[found[1][0]].path}: found no overlap with {sources[found[0][0]].path}, "
            "expected images of one place"
        )
    stray = found[1][0]
    lon, lat = np.nanmean(outline(sources[stray].rpc, sources[stray].window, sources[stray].rpc.alt_offset), axis=0)
    distance = polygons[stray].distance(polygons[found[0][0]]) / 1000.0
    raise InputError(
        f"{sources[stray].path}: found its RPC at {lat:.4f} N {lon:.4f} E, {distance:.1f} km from the other images, "
        f"expected images that overlap (RPC from {sources[stray].metadata.rpc_source})"
    )


def _inputs(images: Sequence[Path], options: PrepOptions) -> list[Path]:
    """All files that will be read."""
    found = [Path(name) for name in (options.aoi,) if name]
    for image in images:
        folders = [*([Path(options.metadata)] if options.metadata else []), image.parent]
        local = [folder for folder in folders if not isinstance(folder, RemotePath) and folder.is_dir()]
        found += [image, *sidecars(image, local)]
    return [path for path in found if not isinstance(path, RemotePath)]


def _outputs(ids: Sequence[str]) -> list[str]:
    """All files that will be written; images that do not show the area are left out."""
    return [*_REPORTS.values(), "scene.json", *(href for i in ids for href in (f"images/{i}.tif", f"rpc/{i}_RPC.TXT"))]


def _middle(sources: Sequence[Source]) -> tuple[float, float]:
    """Longitude and latitude in the middle of the images."""
    centres = [s.rpc.localization((s.size[1] - 1) / 2, (s.size[0] - 1) / 2, s.rpc.alt_offset) for s in sources]
    lon, lat = np.nanmedian(np.array(centres), axis=0)
    if not (np.isfinite(lon) and np.isfinite(lat)):
        raise InputError(f"{sources[0].path}: found RPCs that do not reach the images' pixels, expected their own RPCs")
    return float(lon), float(lat)


def _asked_bounds(options: PrepOptions, crs: str) -> Bounds | None:
    if options.aoi and options.bounds:
        raise InputError("area: found both --aoi and --bounds, expected one of them")
    if options.aoi:
        return bounds_from_geojson(location(options.aoi), crs)
    return bounds_from_numbers(options.bounds, crs, options.crs) if options.bounds else None


def _cropped_to_area(sources: list[Source], crs: str, asked: Bounds, remarks: list[str]) -> list[Source]:
    """Sources with windows that surely hold the area; those that do not see it are left out."""
    kept = []
    for s in sources:
        low, high = s.rpc.altitude_range
        middle = 0.5 * (low + high)
        heights = max(low, middle - _SEARCH_HEIGHT_M), min(high, middle + _SEARCH_HEIGHT_M)
        window = crop_window(s.rpc, crs, asked, heights, s.size, _BIAS_MARGIN_PX)
        if window[2] < 64 or window[3] < 64:
            remarks.append(f"{s.id}: does not show the area, left out")
            continue
        s.window = window
        kept.append(s)
    if len(kept) < 2:
        w, south, e, n = asked
        raise InputError(
            f"area {w:.1f} {south:.1f} {e:.1f} {n:.1f} ({crs}): found {len(kept)} of {len(sources)} images that show "
            "it, expected an area inside the images"
        )
    return kept


def _height_range(
    options: PrepOptions,
    result: Adjustment,
    grays: Sequence[NDArray[np.float32]],
    crs: str,
    asked: Bounds | None,
    progress: Progress,
) -> tuple[float, float]:
    low, high = options.min_height, options.max_height
    if low is None or high is None:
        heights = result.heights()
        middle = float(np.median(heights))
        polygons = [
            ground_polygon(r, (0, 0, g.shape[1], g.shape[0]), middle, crs)
            for r, g in zip(result.rpcs, grays, strict=True)
        ]
        bounds = asked or common_bounds(polygons)
        if bounds is None:
            raise InputError("images: found no ground that two of them show, expected images that overlap")
        found = estimate_height_range(heights, grays, result.rpcs, crs, bounds, progress=progress)
        low, high = (found[0] if low is None else low), (found[1] if high is None else high)
    return round(float(low), 2), round(float(high), 2)


def _grid(
    options: PrepOptions,
    sources: Sequence[Source],
    rpcs: Sequence[RPC],
    crs: str,
    heights: tuple[float, float],
    asked: Bounds | None,
) -> Grid:
    middle = 0.5 * (heights[0] + heights[1])
    windows = [(0, 0, s.window[2], s.window[3]) for s in sources]
    polygons = [ground_polygon(r, w, middle, crs) for r, w in zip(rpcs, windows, strict=True)]
    covered = common_bounds(polygons)
    if covered is None:
        raise InputError("images: found no ground that half of them show, expected images that overlap")
    sizes = []
    for rpc, (_, _, width, height) in zip(rpcs, windows, strict=True):
        lon, lat = rpc.localization((width - 1) / 2, (height - 1) / 2, middle)
        sizes.append(ground_sample_distance(rpc, lon, lat, middle))
    pixel = float(np.median(sizes))
    cell = options.cell_size or default_cell_size(pixel)
    if asked is None:
        # A rim, so that the surface still covers the area when it is moved by some metres onto a reference.
        west, south, east, north = covered
        rim = 0.02 * max(east - west, north - south)
        asked = (west - rim, south - rim, east + rim, north + rim)
    grid = Grid.from_bounds(crs, asked, cell)
    check_cells(grid, pixel)
    return grid


def _write_reports(scene: Scene, result: Adjustment) -> None:
    write_text(scene.output(_REPORTS["adjustment"]), json.dumps(_no_nan(result.to_dict()), indent=1) + "\n")
    write_text(scene.output(_REPORTS["adjustment_report"]), result.to_text())
    write_text(scene.output(_REPORTS["tie_points"]), tie_point_features(result))
    scene.products |= _REPORTS


def _no_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _no_nan(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_no_nan(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


__all__ = ["PrepOptions", "check_inputs", "check_places", "common_name", "prepare"]

"""The compare stage: registration, error table, difference map."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sattools.compare.doubts import check_metres
from sattools.compare.gate import BESIDE, DIFFERENCE, ERRORS, PICTURE, begun, check_file, scatter_href
from sattools.compare.images import compare_views
from sattools.compare.maps import Pair, compare_map
from sattools.compare.options import CompareOptions, name_and_file
from sattools.compare.picture import PREDICTION, difference_picture, scatter_picture
from sattools.compare.surface import Comparison, FiledSurface, HeldSurface, Surface, compare_surface
from sattools.compare.text import to_json
from sattools.compare.truth import Truth, read_truth
from sattools.errors import InputError, SceneError
from sattools.progress import Progress, silent
from sattools.scene.cog import CogWriter
from sattools.scene.datums import difference as datums_differ
from sattools.scene.dependencies import begin
from sattools.scene.document import Scene
from sattools.scene.files import all_or_nothing, write_text
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.opening import opened
from sattools.scene.placement import bounds_of_file, crs_of
from sattools.scene.raster import heights_above
from sattools.scene.regrid import bounds_of
from sattools.scene.stored import pieces

log = logging.getLogger(__name__)
SMALL_PART = 0.5  # of a reference


@dataclass(frozen=True)
class Scored:
    """What `score` finds: the table, the surface, and per parameter some values found and their references ``[N]``."""

    figures: dict[str, Any]
    surface: Comparison
    maps: dict[str, Pair]


def compare_dsm(
    predicted: np.ndarray | Path | str,
    truth: Truth,
    grid: Grid | None = None,
    method: Literal["ncc", "nuth-kaab", "z", "none"] = "ncc",
    measured: np.ndarray | None = None,
) -> Comparison:
    """Score a DSM: a file, or an array [H, W] in metres (NaN = hole) with its `grid`, in any CRS.

    Args:
        predicted: the DSM.
        truth: the reference.
        grid: of an array.
        method: of the registration.
        measured: [H, W] bool, cells of the DSM that images really show; None = all that have a height.

    Raises:
        InputError: an array that is not of its grid's shape, or nothing can be compared.
    """
    if isinstance(predicted, np.ndarray):
        if grid is None:
            raise InputError("prediction: found an array without a grid, expected both")
        surface: Surface = HeldSurface(predicted, grid, measured)
    else:
        surface = FiledSurface(Path(predicted))
    result = compare_surface(surface, truth, method)
    return replace(result, difference=np.asarray(result.difference))


def compare(options: CompareOptions, scene: Scene, progress: Progress = silent, overwrite: bool = False) -> JsonObject:
    """Score a scene's DSM (and maps and views where asked for); writes `compare/difference.tif`, `.png`, `errors.json`.

    Returns the table; raises SceneError where the scene has no DSM.

    Args:
        options: of the stage.
        scene: the scene.
        progress: told the share done and what is being done.
        overwrite: replace outputs that are there.
    """
    hrefs, given = begun(options, scene)
    outputs = begin(scene, "compare", hrefs, overwrite, given)
    scored = score(options, scene, progress, scene.root)
    figures, result = scored.figures, scored.surface
    for name, (found, reference) in scored.maps.items():
        if scored.figures["parameters"][name]["n"]:
            scatter_picture(found, reference, name, scene.output(scatter_href(name)))
    progress(0.8, "difference map")
    _write_difference(result, outputs[DIFFERENCE], outputs[PICTURE])
    write_text(outputs[ERRORS], to_json(figures, indent=1) + "\n")
    scene.products |= {"difference": DIFFERENCE, "errors": ERRORS}
    progress(1.0, "done")
    return figures


def score(options: CompareOptions, scene: Scene, progress: Progress = silent, folder: Path | None = None) -> Scored:
    """Register and score an exported scene, its maps and views where asked for; writes nothing.

    Args:
        options: of the stage.
        scene: see `check_scene`.
        progress: told the share done and what is being done.
        folder: for temporary files; None = the system's.
    """
    truth = read_truth(options, scene, folder)
    path = scene.path(scene.products["dsm"])
    notes = [*_datums(path, options), *_small_part(path, truth)]
    progress(0.1, "registering")
    validity = scene.products.get("validity")
    surface = FiledSurface(path, scene.path(validity) if validity else None)
    surface.check()
    result = compare_surface(surface, truth, options.register, folder)
    figures: dict[str, Any] = {"scene": scene.id, **result.figures, **_checked(result, surface, truth, notes)}
    pairs = {}
    if options.map:
        progress(0.6, "parameter maps")
        figures["parameters"] = {}
        for name, reference in name_and_file(options.map, "--map").items():
            figures["parameters"][name], pairs[name] = _compare_map(scene, name, reference, result)
    if options.points:
        figures["points"], unknown = _compare_points(scene, Path(options.points), result)
        if unknown is not None:
            log.warning("%s", unknown)
            figures["notes"] = [*figures.get("notes", []), unknown]
    if options.views:
        progress(0.7, "views")
        figures |= compare_views(scene, options.lpips_weights)
    return Scored(figures, result, pairs)


def compare_file(options: CompareOptions, overwrite: bool = False) -> JsonObject:
    """Score the DSM file `options.predicted` without a scene; the difference map goes below `options.out` if given."""
    assert options.predicted is not None  # the caller chooses this function by it
    truth, surface = check_file(options, overwrite)
    notes = [*_datums(surface.path, options), *_small_part(surface.path, truth)]
    result = compare_surface(surface, truth, options.register)
    about = _checked(result, surface, truth, notes)
    if options.out:
        place = Scene(id="compare", root=Path(options.out))
        outputs = [place.output(name) for name in BESIDE]
        with all_or_nothing():
            _write_difference(result, *outputs)
    return {"predicted": options.predicted, **result.figures, **about}


def _checked(result: Comparison, surface: FiledSurface, truth: Truth, notes: Sequence[str]) -> JsonObject:
    """Notes for the table, with what speaks against the registration; InputError where a surface is not in metres."""
    check_metres(result.unit, surface.name, truth.source)
    for text in result.notes:
        log.warning("%s: %s", surface.name, text)
    both = [*notes, *result.notes]
    return {"notes": both} if both else {}


def _datums(predicted: Path, options: CompareOptions) -> list[str]:
    """A warning, and the same for the table, where both surfaces are known to be above different things."""
    if options.dsm is None:
        return []
    text = datums_differ({"the DSM": heights_above(predicted), "the reference": heights_above(Path(options.dsm))})
    if text is None:
        return []
    log.warning("%s (the mean is registered away unless --register none)", text)
    return [text]


def _small_part(dsm: Path, truth: Truth) -> list[str]:
    """A warning, and the same for the table, where a DSM lies on a small part of a reference that counts as a whole."""
    if truth.region:
        return []
    with opened(dsm) as data:
        own, around = crs_of(data, dsm), bounds_of_file(data)
    try:
        found = bounds_of(truth.grid.crs, own, around)
    except SceneError:  # told with both names where heights are brought there
        return []
    west, south, east, north = truth.grid.bounds
    box = max(west, found[0]), max(south, found[1]), min(east, found[2]), min(north, found[3])
    share = max(0.0, box[2] - box[0]) * max(0.0, box[3] - box[1]) / ((east - west) * (north - south))
    if not 0 < share < SMALL_PART:
        return []
    text = (
        f"the DSM lies on {100 * share:.2g} % of the reference, and completeness and filled holes are about all of it; "
        f"--region {','.join(f'{edge:.10g}' for edge in box)} scores that part"
    )
    log.warning("%s", text)
    return [text]


def _compare_points(scene: Scene, path: Path, result: Comparison) -> tuple[list[JsonObject], str | None]:
    """The samples' table, and a remark where not one of their values is of a map that the scene has."""
    from sattools.compare.points import band_of, compare_points, filed, read_points

    points = read_points(path)
    wanted = {key for point in points for key in point.values}
    names = [n for n in scene.products if any(key == n or key.rpartition("_")[0] == n for key in wanted)]
    maps = {name: filed(scene.path(scene.products[name])) for name in names}
    east, north, _ = result.registration.metres(result.grid.cell_size)
    table = compare_points(points, maps, (east, north))
    if any(band_of(key, maps)[0] for key in wanted):
        return table, None
    found, expected = ", ".join(sorted(wanted))[:200], f"some of maps that scene {scene.id} has (albedo_1, theta, ...)"
    return table, f"{path}: found values {found}, expected {expected}"


def _compare_map(scene: Scene, name: str, reference: Path, result: Comparison) -> tuple[JsonObject, Pair]:
    east, north, _ = result.registration.metres(result.grid.cell_size)
    return compare_map(name, scene.path(scene.products[name]), reference, (east, north))


def _write_difference(result: Comparison, tif: Path, png: Path) -> None:
    """Signed difference as a COG and as a picture.

    Args:
        result: of a comparison.
        tif: file to write.
        png: file to write.
    """
    title = f"{result.figures['reference']}: MAE {result.figures['mae']:.2f} m"
    tags = {"CONTENT": "registered prediction minus reference", "SOFTWARE": "sattools"}
    with CogWriter(tif, result.grid, units="m", tags=tags, descriptions=[f"height, {PREDICTION}"]) as out:
        for rows in pieces(result.grid.shape):
            out.write(result.difference[rows], rows)
    difference_picture(result.difference, result.grid, title, png)

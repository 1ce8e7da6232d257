"""The compare stage: registration, error table, difference map."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sattools.compare.doubts import check_metres
from sattools.compare.images import check_views, compare_views
from sattools.compare.maps import Pair, compare_map
from sattools.compare.options import CompareOptions, name_and_file
from sattools.compare.picture import PREDICTION, difference_picture, scatter_picture
from sattools.compare.surface import Comparison, FiledSurface, HeldSurface, Surface, compare_surface
from sattools.compare.text import to_json
from sattools.compare.truth import (
    Truth,
    check_dsm,
    check_tile,
    crs_on_ground,
    grid_on_ground,
    open_reference,
    read_dfc2019,
)
from sattools.errors import InputError, MissingProductError
from sattools.progress import Progress, silent
from sattools.scene.cog import CogWriter
from sattools.scene.datums import difference as datums_differ
from sattools.scene.dependencies import STAGES, begin, check_current, may_begin, names_of
from sattools.scene.document import Scene
from sattools.scene.files import all_or_nothing, check_outputs, write_text
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.location import is_remote
from sattools.scene.raster import heights_above
from sattools.scene.stored import pieces

log = logging.getLogger(__name__)
BESIDE = ("difference.tif", "difference.png")  # of a file that is scored without a scene
DIFFERENCE, PICTURE, ERRORS = "compare/difference.tif", "compare/difference.png", "compare/errors.json"


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


def compare(options: CompareOptions, scene: Scene, progress: Progress = silent, overwrite: bool = False) -> JsonObject:
    """Score a scene's DSM (and maps and views where asked for); writes `compare/difference.tif`, `.png`, `errors.json`.

    Returns the table; raises SceneError where the scene has no DSM.

    Args:
        options: of the stage.
        scene: the scene.
        progress: told the share done and what is being done.
        overwrite: replace outputs that are there.
    """
    hrefs, given = _begun(options, scene)
    outputs = begin(scene, "compare", hrefs, overwrite, given)
    scored = score(options, scene, progress, scene.root)
    figures, result = scored.figures, scored.surface
    for name, (found, reference) in scored.maps.items():
        if scored.figures["parameters"][name]["n"]:
            scatter_picture(found, reference, name, scene.output(_scatter_href(name)))
    progress(0.8, "difference map")
    _write_difference(result, outputs[DIFFERENCE], outputs[PICTURE])
    write_text(outputs[ERRORS], to_json(figures, indent=1) + "\n")
    scene.products |= {"difference": DIFFERENCE, "errors": ERRORS}
    progress(1.0, "done")
    return figures


def check_start(options: CompareOptions, scene: Scene, overwrite: bool = False) -> None:
    """What `compare` looks at before its work, for a dry run; arguments and errors as of `compare`.

    Args:
        options: of the stage.
        scene: is changed.
        overwrite: replace outputs that are there.
    """
    hrefs, given = _begun(options, scene)
    may_begin(scene, "compare", hrefs, overwrite, given)
    read_truth(options, scene, scene.root)


def check_ahead(
    options: CompareOptions, scene: Scene, overwrite: bool = False, made: Collection[str] | None = None
) -> None:
    """What `compare` will look at, of a scene whose maps are about to be made; arguments and errors as of `compare`.

    Args:
        options: of the stage.
        scene: is changed.
        overwrite: replace outputs that are there.
        made: hrefs of what `export` will write; None = nobody knows yet.
    """
    may_begin(scene, "compare", _hrefs(options), overwrite, given_files(options, scene))
    read_truth(options, scene, scene.root)
    _check_asked(options, replace(scene, items=[]), made)


def check_options(options: CompareOptions) -> None:
    """What `check_start` can tell without a scene: whether the files that the options name can be what they have to be.

    Args:
        options: of the stage; their files are there.

    Raises:
        InputError: a reference without heights, a folder without tiles, samples or weights that are none.
    """
    if options.truth:
        check_tile(Path(options.truth), options.aoi)
    if options.dsm:
        check_dsm(Path(options.dsm), options.classes)
    for path in name_and_file(options.map, "--map").values():
        crs_on_ground(path)
    if options.points:
        from sattools.compare.points import read_points

        read_points(Path(options.points))
    if options.views and options.lpips_weights:
        from sattools.compare.perceptual import read_weights

        read_weights(tuple(options.lpips_weights))


def given_files(options: CompareOptions, scene: Scene) -> list[Path]:
    """The files that the options name, beside the scene's own."""
    maps = name_and_file(options.map, "--map").values()
    given = [options.dsm, options.classes, options.points, *options.lpips_weights, *maps]
    tile = Path(options.truth).glob(f"{options.aoi or scene.id}_*") if options.truth else ()
    return [*(Path(path) for path in given if path), *tile]


def _hrefs(options: CompareOptions) -> list[str]:
    """What will be written."""
    return [DIFFERENCE, PICTURE, ERRORS, *(_scatter_href(name) for name in name_and_file(options.map, "--map"))]


def _begun(options: CompareOptions, scene: Scene) -> tuple[list[str], list[Path]]:
    """Hrefs of what will be written, and the files given beside the scene's; raises where the scene lacks some."""
    hrefs, given = _hrefs(options), given_files(options, scene)
    check_scene(scene)
    _check_asked(options, scene)
    return hrefs, given


def _check_asked(options: CompareOptions, scene: Scene, made: Collection[str] | None = ()) -> None:
    """Raise where a map, a sample or a rendered view that is to be scored is not there.

    Args:
        options: of the stage.
        scene: the scene.
        made: hrefs of maps that are about to be made; None = nobody knows which.
    """
    for name, path in name_and_file(options.map, "--map").items():
        if made is not None and name not in scene.products and f"export/{name}.tif" not in made:
            expected = ", ".join(_maps(scene, made)) or "those made by `sattools export`"
            raise MissingProductError(f"scene {scene.id}: found no product {name!r}, expected one of {expected}")
        if not is_remote(str(path)):
            if not path.exists():
                raise InputError(f"{path}: no such file, expected one for --map {name}")
            grid_on_ground(path, scene.grid.crs if scene.grid else None)
    if options.points:
        from sattools.compare.points import read_points

        read_points(Path(options.points))
    if options.views:  # last: on a pipe of dry runs they would be there
        check_views(scene)


def _maps(scene: Scene, made: Collection[str]) -> list[str]:
    """Names of the exported maps that a scene has or is about to have."""
    own = {name: href for name, href in scene.products.items() if name in names_of(STAGES["export"])}
    there = [name for name, href in own.items() if href.endswith(".tif")]
    ahead = [Path(href).stem for href in made if Path(href).match("export/*.tif")]
    return list(dict.fromkeys([*there, *ahead]))


def check_scene(scene: Scene) -> None:
    """Raises SceneError, StaleError: a scene without a DSM, or whose DSM is not of its last fit."""
    if "dsm" not in scene.products:
        raise MissingProductError(f"scene {scene.id}: found no DSM, expected one made by `sattools export`")
    check_current(scene, "export")


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
    notes = _datums(path, options)
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
    notes = _datums(Path(options.predicted), options)
    result = compare_surface(surface, truth, options.register)
    about = _checked(result, surface, truth, notes)
    if options.out:
        place = Scene(id="compare", root=Path(options.out))
        outputs = [place.output(name) for name in BESIDE]
        with all_or_nothing():
            _write_difference(result, *outputs)
    return {"predicted": options.predicted, **result.figures, **about}


def check_file(options: CompareOptions, overwrite: bool = False) -> tuple[Truth, FiledSurface]:
    """What `compare_file` looks at before its work: the reference and the surface that it scores.

    Args:
        options: of the stage.
        overwrite: replace outputs that are there.
    """
    assert options.predicted is not None
    surface = FiledSurface(Path(options.predicted))
    surface.check()
    truth = read_truth(options, crs=crs_on_ground(surface.path))
    if options.out:
        given = [options.predicted, options.dsm, options.classes]
        outputs = [Path(options.out) / name for name in BESIDE]
        check_outputs(outputs, [Path(path) for path in given if path], overwrite)
    return truth, surface


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


def _scatter_href(name: str) -> str:
    return f"compare/scatter_{name}.png"


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

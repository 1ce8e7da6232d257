"""What `compare` looks at before its work: the scene, the reference and whatever else its options name."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from sattools.compare.images import check_views
from sattools.compare.options import CompareOptions, name_and_file
from sattools.compare.surface import FiledSurface
from sattools.compare.truth import Truth, check_dsm, check_tile, crs_on_ground, grid_on_ground, read_truth
from sattools.errors import InputError, MissingProductError
from sattools.scene.dependencies import STAGES, check_current, may_begin, names_of
from sattools.scene.document import Scene
from sattools.scene.files import check_outputs
from sattools.scene.location import is_remote

BESIDE = ("difference.tif", "difference.png")  # of a file that is scored without a scene
DIFFERENCE, PICTURE, ERRORS = "compare/difference.tif", "compare/difference.png", "compare/errors.json"


def check_start(options: CompareOptions, scene: Scene, overwrite: bool = False) -> None:
    """What `compare` looks at before its work, for a dry run; arguments and errors as of `compare`.

    Args:
        options: of the stage.
        scene: is changed.
        overwrite: replace outputs that are there.
    """
    hrefs, given = begun(options, scene)
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


def check_scene(scene: Scene) -> None:
    """Raises SceneError, StaleError: a scene without a DSM, or whose DSM is not of its last fit."""
    if "dsm" not in scene.products:
        raise MissingProductError(f"scene {scene.id}: found no DSM, expected one made by `sattools export`")
    check_current(scene, "export")


def given_files(options: CompareOptions, scene: Scene) -> list[Path]:
    """The files that the options name, beside the scene's own."""
    maps = name_and_file(options.map, "--map").values()
    given = [options.dsm, options.classes, options.points, *options.lpips_weights, *maps]
    tile = Path(options.truth).glob(f"{options.aoi or scene.id}_*") if options.truth else ()
    return [*(Path(path) for path in given if path), *tile]


def begun(options: CompareOptions, scene: Scene) -> tuple[list[str], list[Path]]:
    """Hrefs of what will be written, and the files given beside the scene's.

    Args:
        options: of the stage.
        scene: that is scored.

    Raises:
        SceneError, InputError: the scene lacks what is to be scored, or a file that the options name is none.
    """
    hrefs, given = _hrefs(options), given_files(options, scene)
    check_scene(scene)
    _check_asked(options, scene)
    return hrefs, given


def _hrefs(options: CompareOptions) -> list[str]:
    """What will be written."""
    return [DIFFERENCE, PICTURE, ERRORS, *(scatter_href(name) for name in name_and_file(options.map, "--map"))]


def scatter_href(name: str) -> str:
    """Where the picture of a parameter map against its reference goes."""
    return f"compare/scatter_{name}.png"


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


__all__ = [
    "BESIDE",
    "DIFFERENCE",
    "ERRORS",
    "PICTURE",
    "begun",
    "check_ahead",
    "check_file",
    "check_options",
    "check_scene",
    "check_start",
    "given_files",
    "scatter_href",
]

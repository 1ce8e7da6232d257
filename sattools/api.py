"""The suite from Python: one function a command, all alike.

    import sattools

    scene = sattools.prepare(images)
    scene = sattools.export(sattools.fit(scene))
    scene.dsm().plot()

Every function takes a scene (a `Scene`, or the path of a `scene.json`) and the stage's options (its dataclass, or the
options as a dict, in which a text stands for a list of that one, and a number for a text; None = the defaults), does
what the command of that name does, history and files included, and returns the scene (`change`, which has two, its
table). A `Scene` that is given is the one that is changed and returned; of a path a new one is. ``progress=True``
shows a bar; any function of (share done, message) is told instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from sattools.align.options import AlignOptions
from sattools.change.options import ChangeOptions
from sattools.compare.options import CompareOptions
from sattools.errors import InputError
from sattools.export.options import ExportOptions
from sattools.fit.options import FitOptions
from sattools.prep.options import PrepOptions
from sattools.prior.options import PriorOptions
from sattools.progress import Progress, make_progress, silent
from sattools.radiometry.options import NormaliseOptions
from sattools.scene import Scene
from sattools.scene.called import by_a_program
from sattools.scene.given import flag_of, options_of
from sattools.scene.jsonio import JsonObject
from sattools.scene.runner import Step, run_first, run_on
from sattools.scene.schema import shown
from sattools.settings import specs, tell_without_effect
from sattools.simulate.options import SimulateOptions

SceneLike = Scene | str | PathLike[str]
Told = Progress | bool | None


def prepare(
    images: str | PathLike[str] | Sequence[str | PathLike[str]],
    options: PrepOptions | Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
    progress: Told = None,
) -> Scene:
    """Images with RPC cameras become a scene with adjusted cameras, as `sattools prep` does.

    Args:
        images: paths or addresses of images of one place; one that is a folder stands for the images in it, JPEG and
            PNG left out.
        options: see `sattools.prep.options.PrepOptions`.
        overwrite: replace outputs that are there; inputs are never replaced.
        progress: True = a bar, or a function of (share done, message).

    Raises:
        InputError: images that cannot be used.
        OutputExistsError: outputs are there and ``overwrite`` is False.
    """
    from sattools.prep.stage import prepare as stage
    from sattools.scene.location import image_locations

    own = options_of(PrepOptions, options)
    paths = image_locations(_paths(images))
    step = Step("prep", own, overwrite, _progress(progress, "prep"))
    with by_a_program():
        return run_first(step, lambda told: stage(paths, own, told, overwrite), paths)


def simulate(
    options: SimulateOptions | Mapping[str, Any] | None = None, *, overwrite: bool = False, progress: Told = None
) -> Scene:
    """A ray-traced scene with known truth, as `sattools simulate` makes it; arguments as of `prepare`.

    Args:
        options: of the simulation, or as a dict; None = the defaults.
        overwrite: replace outputs that are there.
        progress: see `prepare`.
    """
    from sattools.simulate.options import without_effect
    from sattools.simulate.stage import simulate as stage

    own = options_of(SimulateOptions, options)
    if isinstance(options, Mapping):
        tell_without_effect(without_effect(own, options).items())
    step = Step("simulate", own, overwrite, _progress(progress, "simulate"))
    with by_a_program():
        return run_first(step, lambda told: (stage(own, Path(own.out) / own.id, told, overwrite), None))


def normalise(
    scene: SceneLike,
    options: NormaliseOptions | Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
    progress: Told = None,
) -> Scene:
    """Digital numbers become linear radiance, as by `sattools normalise`; arguments as of `fit`.

    Args:
        scene: a scene or the path of its document.
        options: or as a dict; None = the defaults.
        overwrite: replace outputs that are there.
        progress: see `prepare`.
    """
    from sattools.radiometry.stage import normalise as stage

    return _run(stage, "normalise", scene, options_of(NormaliseOptions, options), overwrite, progress)


def match(
    scene: SceneLike,
    options: PriorOptions | Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
    progress: Told = None,
) -> Scene:
    """A rough surface by matching, as by `sattools prior`; arguments as of `fit`.

    Args:
        scene: a scene or the path of its document.
        options: or as a dict; None = the defaults.
        overwrite: replace outputs that are there.
        progress: see `prepare`.
    """
    from sattools.prior.stage import prior as stage

    return _run(stage, "prior", scene, options_of(PriorOptions, options), overwrite, progress)


def fit(
    scene: SceneLike,
    options: FitOptions | Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
    progress: Told = None,
) -> Scene:
    """Fit a surface or a volume by differentiable rendering, as `sattools fit` does.

    Args:
        scene: a scene, or the path of its document.
        options: see `sattools.fit.options.FitOptions`; a ``preset`` in a dict brings its values along.
        overwrite: replace a model that is there.
        progress: True = a bar, or a function of (share done, message).

    Raises:
        SceneError, InputError, OutputExistsError: as the command says in one line.
    """
    from sattools.fit.applicable import NEEDED, without_effect
    from sattools.fit.presets import with_preset
    from sattools.fit.stage import fit as stage

    given: Iterable[str] = NEEDED  # of a dataclass nobody knows which were; those that it has anyway ask for nothing
    if isinstance(options, Mapping):
        given = list(options)
        options_of(FitOptions, options)  # a preset that there is not is told like all else
        asked = (
            str(options.get(name, usual)) for name, usual in (("preset", "fast"), ("start", "surface"), ("field", ""))
        )
        options = {**with_preset(*asked), **options}
    own = options_of(FitOptions, options)
    tell_without_effect(without_effect(own, given))
    return _run(stage, "fit", scene, own, overwrite, progress)


def export(
    scene: SceneLike,
    options: ExportOptions | Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
    progress: Told = None,
) -> Scene:
    """Georeferenced files of a fitted scene, as by `sattools export`; arguments as of `fit`.

    Args:
        scene: a scene or the path of its document.
        options: or as a dict; None = the defaults.
        overwrite: replace outputs that are there.
        progress: see `prepare`.
    """
    from sattools.export.options import without_effect
    from sattools.export.stage import export as stage

    own = options_of(ExportOptions, options)
    tell_without_effect(without_effect(own, _given(options, own)))
    return _run(stage, "export", scene, own, overwrite, progress)


def compare(
    scene: SceneLike,
    options: CompareOptions | Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
    progress: Told = None,
) -> Scene:
    """Score a scene's surface, as `sattools compare` does; the figures are in ``scene.history[-1]["errors"]``.

    Arguments as of `fit`. Files without a scene are scored by `sattools.compare.compare_file`, several fits side by
    side by `sattools.compare.evaluation.evaluate`.

    Args:
        scene: a scene or the path of its document.
        options: or as a dict; None = the defaults.
        overwrite: replace outputs that are there.
        progress: see `prepare`.
    """
    from sattools.compare.options import without_effect
    from sattools.compare.stage import compare as stage

    own = options_of(CompareOptions, options)
    aside = next((name for name in ("predicted", "fit", "out") if getattr(own, name)), None)
    if aside is not None:
        others = "`sattools.compare.compare_file` scores a file, `sattools.compare.evaluation.evaluate` several fits"
        raise InputError(f"compare: found option {aside!r} beside a scene, expected it without ({others})")
    tell_without_effect(without_effect(own, _given(options, own)))
    step = Step("compare", own, overwrite, _progress(progress, "compare"))
    with by_a_program():
        return run_on(_scene(scene), step, lambda s, told: {"errors": stage(own, s, told, overwrite)})[0]


def align(
    scene: SceneLike,
    options: AlignOptions | Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
    progress: Told = None,
) -> Scene:
    """Move an exported scene onto a reference, as by `sattools align`; what it found is in ``scene.history[-1]``.

    Args:
        scene: a scene or the path of its document.
        options: or as a dict; ``to`` has to be given.
        overwrite: replace outputs that are there.
        progress: see `prepare`.

    Raises:
        InputError: no reference is given, it cannot be read, or nothing is found that goes with it.
        SceneError: a scene that is not exported.
    """
    from sattools.align.stage import align as stage

    own = options_of(AlignOptions, options)
    if own.to is None:
        raise InputError("AlignOptions: found no option 'to', expected a raster of heights or ground control points")
    return _run(stage, "align", scene, own, overwrite, progress)


def change(
    before: SceneLike,
    after: SceneLike,
    options: ChangeOptions | Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
    progress: Told = None,
) -> JsonObject:
    """What has risen or sunk between two exported scenes or rasters of heights, as by `sattools change`.

    Args:
        before: a scene, the path of its document, or that of a raster of heights [m].
        after: the same of the later date.
        options: or as a dict; maps and polygons are written to its ``out``.
        overwrite: replace outputs that are there.
        progress: see `prepare`.

    Returns:
        The table: shift, scatter, regions with area [m2], mean [m], volume [m3] and p-value.

    Raises:
        InputError, SceneError: a surface that cannot be read, or two that have nothing in common.
    """
    from sattools.change.stage import change as stage

    own = options_of(ChangeOptions, options)
    overwrite = flag_of(overwrite, "overwrite")
    for surface in (before, after):
        if not isinstance(surface, Scene | str | PathLike):
            expected = "expected a Scene, the path of a scene.json or that of a raster of heights"
            raise InputError(f"change: found {type(surface).__name__}, {expected}")
    one, other = (str(s.path("scene.json") if isinstance(s, Scene) else s) for s in (before, after))
    with by_a_program():
        return stage(one, other, own, _progress(progress, "change"), overwrite)


def _run(
    stage: Callable[..., JsonObject], command: str, scene: SceneLike, options: Any, overwrite: bool, progress: Told
) -> Scene:
    """A stage that changes a scene, as its command does it."""
    step = Step(command, options, overwrite, _progress(progress, command))
    with by_a_program():
        return run_on(_scene(scene), step, lambda s, told: stage(s, options, told, overwrite))[0]


def _given(options: Any, own: Any) -> list[str]:
    """Names of the options that a program gives: of a dataclass, in which all have values, those of another one.

    Args:
        options: as the program gives them.
        own: the same as their dataclass.
    """
    if isinstance(options, Mapping):
        return list(options)
    return [spec.name for spec in specs(type(own)) if getattr(own, spec.name) != spec.default]


def _paths(images: Any) -> list[str]:
    """Names of files, one or several. Raises InputError for anything else, such as pixels."""
    given = [images] if isinstance(images, str | PathLike) else images
    if not isinstance(given, Iterable) or isinstance(given, Mapping | bytes):
        raise InputError(f"prepare: found {type(images).__name__}, expected the paths of images")
    names = list(given)
    for name in names:
        if not isinstance(name, str | PathLike):
            raise InputError(f"prepare: found {type(name).__name__} in a list, expected the paths of images")
    return [str(name) for name in names]


def _scene(scene: SceneLike) -> Scene:
    if isinstance(scene, Scene):
        return scene
    if not isinstance(scene, str | PathLike):
        raise InputError(f"found {type(scene).__name__}, expected a Scene or the path of a scene.json")
    if str(scene).lstrip().startswith("{"):
        raise InputError(
            f"found {shown(str(scene))}, expected the path of a scene.json (`Scene.from_json` reads its text)"
        )
    return Scene.from_file(str(scene))


def _progress(told: Told, label: str) -> Progress:
    if callable(told):
        return told
    try:
        bar = told is not None and flag_of(told, "progress")
    except InputError:
        expected = "expected True, or a function of (share done, message)"
        raise InputError(f"progress: found {told!r}, {expected}") from None
    return make_progress("bar", label) if bar else silent


__all__ = ["align", "change", "compare", "export", "fit", "match", "normalise", "prepare", "simulate"]

"""`sattools compare`: score a DSM, maps and views against references."""

from __future__ import annotations

import sys
from copy import deepcopy
from typing import TYPE_CHECKING, Any

import click

from sattools.cli import plans
from sattools.cli.options import build, common_options, dataclass_options, print_config, scene_argument, typed
from sattools.cli.pipe import Run, announce, apply, progress_of, report_error, run_scenes, tell, waits
from sattools.compare.options import CompareOptions, without_effect
from sattools.errors import OutputExistsError, SattoolsError
from sattools.export.options import ExportOptions
from sattools.progress import Progress
from sattools.settings import tell_without_effect

if TYPE_CHECKING:
    from sattools.scene import Scene
    from sattools.scene.jsonio import JsonObject


@click.command("compare")
@scene_argument
@dataclass_options(CompareOptions)
@common_options
def command(scenes: tuple[str, ...], overwrite: bool, dry_run: bool, print_config: bool, **values: Any) -> None:
    """Score the scene's DSM against a reference: JSON on stdout, a table on stderr, a difference map in the scene.

    Either `--truth DIR` (contest layout), or `--dsm REF` with `--classes CLS`; a simulated scene brings its own truth.
    With `--predicted DSM` a file is scored and no scene is read. Of finer cells than the reference's the means over
    those are scored. With `--fit Lam=a/scene.json --fit Hpk=b/scene.json
    --out DIR` fits of one place are scored side by side: tables and figures, also for `sattools report DIR`.
    """
    options = build(CompareOptions, values)
    _check_usage(options, scenes)
    tell_without_effect(without_effect(options, typed(values)))
    if options.predicted is not None:
        _compare_file(options, overwrite, dry_run, print_config)
        return
    if options.fit:
        _compare_fits(options, overwrite, dry_run, print_config)
        return

    def work(scene: Scene, progress: Progress) -> JsonObject:
        from sattools.compare.stage import compare
        from sattools.compare.text import table

        figures = compare(options, scene, progress, overwrite)
        tell(table(figures))
        return {"errors": figures}

    def emit(scene: Scene, entry: JsonObject) -> str:
        from sattools.compare.text import to_json

        return to_json(entry["errors"])

    def before(scene: Scene) -> Scene:
        """The DSM is exported where a new fit has left it behind, as a stage that was left out is done."""
        from sattools.export.stage import export

        reason = _left_out(scene)
        if reason is None:
            return scene
        _check_with_export(options, deepcopy(scene), overwrite)
        tell(f"sattools compare: scene {scene.id}: {reason}; exporting it first")
        run = Run("export", ExportOptions(), overwrite=overwrite)
        return apply(run, scene, lambda scene, progress: export(scene, ExportOptions(), progress, overwrite))[0]

    def ahead() -> None:
        from sattools.compare.gate import check_options

        check_options(options)
        if not (options.truth or options.dsm) and waits():
            announce("compare", "no --truth or --dsm", "the scene has to bring its own truth, as those of simulate do")

    run = Run("compare", options, dry_run, print_config, overwrite)
    run_scenes(
        run,
        scenes,
        work,
        emit,
        "score the DSM",
        before,
        foreseen=plans.of_compare,
        check=lambda s: _check(options, s, overwrite),
        ahead=ahead,
    )


def _check(options: CompareOptions, scene: Scene, overwrite: bool) -> None:
    """What is in the way of scoring a scene, or of the export that comes first."""
    from sattools.compare.gate import check_ahead, check_start

    if _left_out(scene):
        _check_with_export(options, scene, overwrite)
        return
    if scene.origin is None and "dsm" not in scene.products:  # on a pipe of dry runs it would be there
        check_ahead(options, scene, overwrite)
    check_start(options, scene, overwrite)


def _check_with_export(options: CompareOptions, scene: Scene, overwrite: bool) -> None:
    """What is in the way of an export and of scoring what it makes, which must not replace what it is scored by."""
    from sattools.compare.gate import check_ahead, given_files
    from sattools.export.stage import check_start as check_export

    reason = _left_out(scene)
    try:
        made = check_export(scene, ExportOptions(), overwrite, given_files(options, scene))
    except OutputExistsError as error:  # which nobody has asked to replace
        raise OutputExistsError(f"{error} (it would be exported first: {reason})") from None
    check_ahead(options, scene, overwrite, made)


def _left_out(scene: Scene) -> str | None:
    """Why the DSM has to be exported first; None where it has not, or there is nothing to export."""
    from sattools.scene.dependencies import stale

    reason = stale(scene, "export") if "dsm" in scene.products else "no DSM of the last fit"
    return reason if "model" in scene.products else None


def _check_usage(options: CompareOptions, scenes: tuple[str, ...]) -> None:
    """Raise where options contradict each other or lack one, whatever the scenes and files hold."""
    if options.predicted is not None:
        _check_usage_of_file(options, scenes)
    elif options.out is not None and not options.fit:
        raise click.UsageError("found --out with a scene, whose results go into its own folder: expected it without")
    if options.fit and scenes:
        name = "SCENE" if scenes[0] == "-" else scenes[0]
        raise click.UsageError(f"found {scenes[0]} beside --fit, expected it as --fit NAME={name}, too, or not")
    if options.fit and options.out is None:
        raise click.UsageError("found --fit without --out, expected a folder for the tables and figures")
    if options.truth and options.dsm:
        raise click.UsageError("found both --truth and --dsm, expected one of them")


def _check_usage_of_file(options: CompareOptions, scenes: tuple[str, ...]) -> None:
    """The same of --predicted, beside which no scene brings a reference."""
    if options.fit:
        raise click.UsageError("found both --predicted and --fit, expected one of them")
    if unused := _unused(options, scenes):
        raise click.UsageError(f"found {unused} beside --predicted, which scores that file alone: expected one of them")
    if not (options.truth or options.dsm):
        raise click.UsageError("found no reference beside --predicted, expected --dsm FILE or --truth DIR --aoi NAME")
    if options.truth and options.aoi is None:
        raise click.UsageError("found --truth without a scene, expected --aoi NAME as well")


def _unused(options: CompareOptions, scenes: tuple[str, ...]) -> str | None:
    """What is of no use without a scene; None where nothing is."""
    given = {"a scene": scenes, "--map": options.map, "--points": options.points, "--views": options.views}
    return next((name for name, value in given.items() if value), None)


def _compare_file(options: CompareOptions, overwrite: bool, dry_run: bool, show: bool) -> None:
    from sattools.compare.gate import check_file
    from sattools.compare.stage import compare_file
    from sattools.compare.text import table, to_json

    if show:
        print_config("compare", options)
        return
    try:
        if dry_run:
            check_file(options, overwrite)
            click.echo(f"sattools compare: would score {options.predicted}", err=True)
            return
        figures = compare_file(options, overwrite)
    except SattoolsError as error:
        report_error("compare", error)
        sys.exit(1)
    tell(table(figures))
    click.echo(to_json(figures))


def _compare_fits(options: CompareOptions, overwrite: bool, dry_run: bool, show: bool) -> None:
    if show:
        print_config("compare", options)
        return
    from sattools.compare.evaluation import (
        MAP_COLUMNS,
        VIEW_COLUMNS,
        check_fits,
        evaluate,
        map_rows,
        markdown,
        view_rows,
    )
    from sattools.compare.text import to_json

    try:
        if dry_run:
            check_fits(options, overwrite)
            click.echo(f"sattools compare: would score {', '.join(options.fit)}", err=True)
            return
        result = evaluate(options, overwrite, progress_of("compare", "fits"))
    except SattoolsError as error:
        report_error("compare", error)
        sys.exit(1)
    tables = ((VIEW_COLUMNS, view_rows(result)), (MAP_COLUMNS, map_rows(result)))
    tell("\n".join(markdown(*table) for table in tables if table[1]).removesuffix("\n"))
    click.echo(to_json(result))

"""`sattools batch`: many scenes in many configurations."""

from __future__ import annotations

import io
import os
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sattools.batch.options import BatchOptions
from sattools.cli.documents import documents, parse
from sattools.cli.interrupts import checked
from sattools.cli.kinds import NamedPath, PathText
from sattools.cli.options import build, dataclass_options, read_toml, scene_argument
from sattools.cli.pipe import report_error, tell
from sattools.cli.streams import portable
from sattools.errors import SattoolsError, counted
from sattools.processors import cores
from sattools.progress import make_progress

if TYPE_CHECKING:
    from sattools.batch.configuration import Configuration
    from sattools.batch.queue import Batch
    from sattools.scene.jsonio import JsonObject

# options that say how a command runs, not what comes out of it
_HOUSEKEEPING = {"scenes", "images", "overwrite", "dry_run", "print_config", "out", "dfc2019"}
# what a table may not ask for, and what does it instead: the command would do no work, or other work
_ELSEWHERE = {
    "print-config": "`sattools {} --config {} --print-config`",
    "dry-run": "`sattools batch --dry-run`",
    "dfc2019": "`sattools batch --dfc2019 ROOT --aoi AREA` (scenes that are given are prepared already)",
}


@click.command("batch")
@scene_argument
@dataclass_options(BatchOptions)
@click.option(
    "--config",
    "configs",
    multiple=True,
    type=NamedPath(dir_okay=False, path_type=Path),
    help="TOML file = one configuration, with tables [prep], [normalise], [prior], [fit], [export], [align], "
    "[compare]; "
    "repeatable [default: the commands' defaults].",
)
@click.option("--overwrite", is_flag=True, help="Do again what an earlier run has finished.")
@click.option("--dry-run", is_flag=True, help="Say on stderr what would be done, do nothing.")
def command(scenes: tuple[str, ...], configs: tuple[Path, ...], overwrite: bool, dry_run: bool, **values: Any) -> None:
    """Fit, export and score every scene in every configuration, on this machine or on a Dask cluster.

    Scenes: documents on stdin, paths of scene.json, or areas of the contest (--dfc2019 ROOT --aoi JAX_004 --aoi ...).
    Writes table.csv, table.md, table.parquet (with pyarrow) and speed_error.png below --out. Called again it does
    only what is not done or has changed. Prints the finished scenes. A configuration with a table [align] moves every
    scene onto the reference that it names; --join makes one surface of all scenes.
    """
    options = build(BatchOptions, values)
    configurations = [configuration(path) for path in configs] or [configuration(None)]
    from sattools.batch.cluster import check_cluster
    from sattools.batch.gate import check_folder
    from sattools.batch.queue import make_plan
    from sattools.batch.stage import batch
    from sattools.cli.rehearsal import refusals

    root = click.get_current_context().find_root()
    most = root.params.get("threads") or cores()
    try:
        names = scenes if scenes or options.dfc2019 else ("-",)
        if "-" in names:  # what is in the way whatever scenes come, which may be hours later
            check_folder(replace(options, join=False), [], configurations, overwrite)
            check_cluster(options, most, 1, tiled=False, ahead=True)
        scenes_given = [parse(source, text) for source, text in (documents(names) if names else ())]
        if not scenes_given and not options.aoi:
            raise click.UsageError("expected scenes, or --dfc2019 ROOT --aoi AREA")
        if dry_run:
            check_folder(options, scenes_given, configurations, overwrite)
            plan = make_plan(options, scenes_given, configurations, overwrite, dry_run=True)
            if plan.jobs:
                check_cluster(options, most, len(plan.runs), bool(plan.tiled))
            plan.refuse(refusals(plan, scenes_given))
            _plan(plan)
            return
        progress = checked(make_progress(root.obj["progress"], "batch"))

        def emit(line: str) -> None:
            click.echo(portable(line))

        done = batch(options, scenes_given, configurations, most, progress, overwrite=overwrite, emit=emit)
    except SattoolsError as error:
        report_error("batch", error)
        sys.exit(1)
    tell(Path(options.out, "table.md").read_text(encoding="utf-8").removesuffix("\n"))
    for name, made in done.joined.items():
        if made is not None:
            tell(f"{Path(options.out, 'joined', name)}: {_seams(made)}")
    if done.errors:
        sys.exit(3 if done.results else 1)


def _plan(plan: Batch) -> None:
    """What a dry run says of a batch; ends with the status that the batch would have at best."""
    if plan.results:
        click.echo(f"sattools batch: {len(plan.results)} of {len(plan.rows)} are done", err=True)
    for job in plan.jobs:
        click.echo(f"sattools batch: would do {job.task.name} in {job.task.folder}", err=True)
    for pair, (_, error) in plan.errors.items():
        report_error("batch", SattoolsError(f"{'/'.join(pair)}: {error}"))
    if plan.errors:
        sys.exit(3 if plan.jobs or plan.results else 1)


def _seams(made: JsonObject) -> str:
    """What is said of joined scenes on a screen."""
    text = f"{counted(len(made['scenes']), 'scenes')} joined"
    if not made["seams"]:
        return f"{text}, none overlaps another"
    worst = max(made["seams"], key=lambda one: abs(one["median_m"]))
    return f"{text}; largest step {abs(worst['median_m']):.2f} m, between {worst['a']} and {worst['b']}"


def configuration(path: Path | None) -> Configuration:
    """A configuration checked by the commands' own parsers; the defaults where there is no file."""
    from sattools.batch.configuration import COMMANDS, Configuration
    from sattools.cli import main

    tables = read_toml(path) if path is not None else {}
    wrong = [name for name, table in tables.items() if name not in COMMANDS or not isinstance(table, dict)]
    if wrong:
        expected = ", ".join(f"[{name}]" for name in COMMANDS)
        raise click.BadParameter(f"{path}: found {wrong[0]!r}, expected the tables {expected}", param_hint="--config")
    for name, table in tables.items():
        for key in (key for key, value in table.items() if value is not False):
            if (instead := _ELSEWHERE.get(key.replace("_", "-"))) is not None:
                expected = instead.format(name, path)
                raise click.BadParameter(f"{path}: [{name}] found {key!r}, expected {expected}", param_hint="--config")
    resolved = {}
    parent = click.get_current_context().find_root()
    for name in COMMANDS:
        part = main.get_command(parent, name)
        assert part is not None  # all of them are commands of this suite
        arguments = ["--config", str(path)] if name in tables else []
        try:
            with part.make_context(name, arguments, parent=parent) as context:
                resolved[name] = {k: v for k, v in context.params.items() if k not in _HOUSEKEEPING}
        except click.UsageError as error:
            error.ctx = click.get_current_context()  # it is `batch` that was called wrongly
            raise
        if path is not None and name in tables:
            _check_together(name, part, path)
    if path is not None and "align" in tables and resolved["align"]["to"] is None:
        raise click.BadParameter(f"{path}: [align] found no 'to', expected a reference", param_hint="--config")
    placed = {name: _placed(main.get_command(parent, name), table) for name, table in tables.items()}
    return Configuration(path.stem if path else "default", placed, resolved)


def _placed(command: click.Command | None, table: dict[str, Any]) -> dict[str, Any]:
    """A table with files and folders by absolute paths: the workers of a cluster may be in any folder."""
    assert command is not None  # see `configuration`
    kinds = {param.name: param.type.kind for param in command.params if isinstance(param.type, PathText)}
    return {key: _absolute(value, kinds.get(key.replace("-", "_"))) for key, value in table.items()}


def _absolute(value: Any, kind: str | None) -> Any:
    from sattools.scene.location import is_remote

    if kind is None:
        return value
    if isinstance(value, list):
        return [_absolute(one, kind) for one in value]
    if kind == "NAME=FILE":
        name, equals, file = value.partition("=")
        return f"{name}={_absolute(file, 'file')}" if equals else value
    return value if is_remote(value) else os.path.abspath(value)


def _check_together(name: str, command: click.Command, path: Path) -> None:
    """Raise where a command refuses values of its table, or what they are together, which it else says hours later."""
    parent = click.get_current_context().find_root()
    scenes = [] if name == "prep" else ["SCENE"]  # which nobody opens
    arguments = [*scenes, "--config", str(path), "--print-config"]
    try:
        with redirect_stdout(io.StringIO()), command.make_context(name, arguments, parent=parent) as context:
            command.invoke(context)
    except click.UsageError as error:
        raise click.BadParameter(f"{path}: [{name}] {error.format_message()}", param_hint="--config") from None

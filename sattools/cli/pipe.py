"""Scenes in, scenes out: error handling, history and exit codes that all commands share.

A command calls `run_scenes` (it transforms scenes), `run_source` (it makes one) or `each_scene` (it only reads them).
Exit codes: 0 done, 1 failed, 2 usage, 3 some scenes failed and the others were passed on, 130/143 interrupted.
"""

from __future__ import annotations

import logging
import select
import sys
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sattools.cli import interrupts
from sattools.cli.commands import WORK
from sattools.cli.documents import documents, parse
from sattools.cli.inputs import check_inputs, check_inputs_before_waiting
from sattools.cli.options import WHOLE_DOCUMENT, print_config
from sattools.cli.safety import complain, quiet_stdout
from sattools.cli.streams import portable
from sattools.errors import MissingProductError, SattoolsError, SceneError, StaleError
from sattools.progress import Progress, make_progress

if TYPE_CHECKING:  # the document pulls in numpy, which --help can do without
    from sattools.scene import Scene
    from sattools.scene.runner import Step

log = logging.getLogger(__name__)
NOTHING = "(did the command before fail? dry runs of prep and simulate make none)"
Work = Callable[["Scene", Progress], dict[str, Any] | None]


@dataclass
class Run:
    """How a command was called."""

    command: str
    options: Any
    dry_run: bool = False
    print_config: bool = False
    overwrite: bool = False
    inputs: tuple[Path, ...] = ()  # of a command that makes a scene


def run_scenes(
    run: Run,
    scenes: tuple[str, ...],
    work: Work,
    emit: Callable[[Scene, dict[str, Any]], str] | None = None,
    plan: str = "",
    before: Callable[[Scene], Scene] | None = None,
    *,
    foreseen: Callable[[Scene], str] | None = None,
    check: Callable[[Scene], None] | None = None,
    ahead: Callable[[], None] | None = None,
) -> None:
    """Apply ``work`` to every scene and pass the results on as soon as they are done.

    Args:
        run: the call.
        scenes: paths of scene documents; empty or ``-`` = stdin, one scene per line.
        work: changes the scene; what it returns goes into the history entry.
        emit: makes the line for stdout from the scene and the history entry; None = the scene document.
        plan: for --dry-run, what would be done.
        before: does what the command needs and the scene has not.
        foreseen: what it will take: for --dry-run, and for the first line where people look on (`announce`).
        check: for --dry-run, raises what ``work`` would raise at its start; may change the scene.
        ahead: raises what of that the options alone tell, before the scene of a pipe is waited for.
    """
    if run.print_config:
        print_config(run.command, run.options)
        return

    def handle(scene: Scene) -> str:
        from sattools.scene.runner import check_place

        check_inputs(run.options)
        if not scene.root.is_dir():
            raise SceneError(f"scene {scene.id}: found no folder {scene.root}, expected the scene's root")
        check_place(scene)
        if run.dry_run:
            takes = f": {foreseen(scene)}" if foreseen else ""
            if check:
                _rehearse(run, scene, check)
            click.echo(f"sattools {run.command}: would {plan} for scene {scene.id} in {scene.root}{takes}", err=True)
            return _shown(scene, None)

        def planned(scene: Scene, progress: Progress) -> dict[str, Any] | None:
            if foreseen:
                announce(run.command, scene.id, foreseen(scene))
            return work(scene, progress)

        scene, entry = apply(run, before(scene) if before else scene, planned)
        return emit(scene, entry) if emit else _shown(scene, entry)

    try:
        check_inputs_before_waiting(run.options, scenes, ahead)
    except SattoolsError as error:
        report_error(run.command, error)
        sys.exit(1)
    if not run.dry_run and (scenes or ("-",))[0] == "-":
        _import_meanwhile(run.command)
    each_scene(run.command, scenes, handle)


def _import_meanwhile(command: str) -> None:
    """Import what a command works with while the one before it on the pipe works, which takes longer."""
    if command not in WORK or not waits():
        return
    import_module(WORK[command])
    if compiled := sys.modules.get("sattools.compiled"):
        compiled.get_ready()


def waits() -> bool:
    """Whether nothing has come on stdin yet that people do not type."""
    try:
        return not (sys.stdin.isatty() or select.select([sys.stdin], [], [], 0)[0])
    except (AttributeError, OSError, ValueError):  # no stdin, or none that can be asked
        return False


def _rehearse(run: Run, scene: Scene, check: Callable[[Scene], None]) -> None:
    """Raise what the run would raise before its work.

    But for what commands before it have not made, or not made anew: on a pipe they were dry runs, too.
    """
    from sattools.scene.runner import document_of

    document_of(scene, run.overwrite)
    try:
        check(deepcopy(scene))
    except (MissingProductError, StaleError):
        if scene.origin is not None:
            raise


def announce(command: str, label: str, plan: str) -> None:
    """What is begun: a line on a terminal, and with -v; in the scene's log in any case.

    Args:
        command: its name.
        label: of the scene, or what else it is about.
        plan: what is said.
    """
    log.info("%s %s: %s", command, label, plan)
    if is_watched():
        click.echo(f"sattools {command}: {label}: {plan}", err=True)


def _root() -> click.Context | None:
    """Of the command line; None where Python calls."""
    context = click.get_current_context(silent=True)
    return context.find_root() if context else None


def tell(text: str) -> None:
    """Say a result to people, on stderr: a table, a shift. Not with -q, by which errors alone are said.

    Args:
        text: lines; the last one is ended here.
    """
    root = _root()
    if root is None or not root.params.get("quiet"):
        click.echo(text, err=True)


def is_watched() -> bool:
    """Whether people look on: progress is a bar, and messages of all kinds are not shown anyway."""
    root = _root()
    if root is None or root.params.get("verbose"):
        return False
    mode = (root.obj or {}).get("progress")
    return mode == "bar" or (mode == "auto" and sys.stderr.isatty())


def each_scene(command: str, scenes: tuple[str, ...], handle: Callable[[Scene], str]) -> None:
    """Print what ``handle`` makes of every scene as soon as it is done; errors go to stderr, and exit codes follow.

    Args:
        command: its name.
        scenes: paths, or none for stdin.
        handle: gives the line to print.
    """
    done, failed = 0, 0
    seen: set[tuple[str, str]] = set()
    for source, text in documents(scenes):
        try:
            scene = parse(source, text)
            key = (str(scene.root), scene.id)
            if key in seen:
                raise SceneError(f"{source}: found scene id {scene.id!r} a second time, expected unique ids")
            seen.add(key)
            _print_line(handle(scene))
            done += 1
        except SattoolsError as error:
            failed += 1
            report_error(command, error)
    if done == failed == 0:
        report_error(command, SceneError(f"stdin: found nothing, expected scene documents, one per line {NOTHING}"))
        sys.exit(1)
    if failed:
        sys.exit(3 if done else 1)


def run_source(
    run: Run,
    make: Callable[[Progress], tuple[Scene, dict[str, Any] | None]],
    label: str,
    check: Callable[[], str] = lambda: "",
) -> None:
    """Make one scene and print it; --dry-run calls ``check``: it raises where the work would, and says what it takes.

    Args:
        run: how the command was called.
        make: gives the scene and its history entry.
        label: for the progress.
        check: see above.
    """
    if run.print_config:
        print_config(run.command, run.options)
        return
    try:
        check_inputs(run.options)
        if run.dry_run:
            plan = check()
            click.echo(f"sattools {run.command}: would make {label}{plan and f': {plan}'}", err=True)
            return
        from sattools.scene.runner import run_first

        scene = run_first(_step(run, label), make, run.inputs)
        _print_line(_shown(scene, scene.history[-1]))
    except SattoolsError as error:
        report_error(run.command, error)
        sys.exit(1)


def report_error(command: str, error: SattoolsError) -> None:
    """One line on stderr, but where the error is what an interrupt became on its way through other people's code."""
    if status := interrupts.status():
        sys.exit(status)
    complain(f"sattools {command}: error: {error}")


def apply(run: Run, scene: Scene, work: Work) -> tuple[Scene, dict[str, Any]]:
    """Run a stage on a scene; the scene and its new history entry.

    Args:
        run: how the command was called.
        scene: the scene.
        work: the stage.
    """
    from sattools.scene.runner import run_on

    return run_on(scene, _step(run, scene.id), work)


def _step(run: Run, label: str) -> Step:
    from sattools.scene.runner import Step

    return Step(run.command, run.options, run.overwrite, progress_of(run.command, label))


def progress_of(command: str, label: str) -> Progress:
    """Progress as `--progress` asks for it, that notices interrupts."""
    root = _root()
    mode = (root.obj or {}).get("progress", "none") if root else "none"
    return interrupts.checked(make_progress(mode, f"{command} {label}"))


def _shown(scene: Scene, entry: dict[str, Any] | None) -> str:
    """The document; for people at a terminal, unless they ask for it, a few lines in its place."""
    context = click.get_current_context(silent=True)
    if (context and context.meta.get(WHOLE_DOCUMENT)) or not sys.stdout.isatty():
        return scene.to_json()
    from sattools.scene.summary import brief

    return brief(scene, entry)


def _print_line(line: str) -> None:
    try:
        print(portable(line), flush=True)
    except OSError as error:
        quiet_stdout()
        if not isinstance(error, BrokenPipeError):  # nobody reads any more: stop quietly
            click.echo(f"sattools: error: stdout: cannot be written ({error.strerror})", err=True)
        sys.exit(1)


__all__ = [
    "NOTHING",
    "Run",
    "announce",
    "apply",
    "each_scene",
    "is_watched",
    "progress_of",
    "report_error",
    "run_scenes",
    "run_source",
    "tell",
    "waits",
]

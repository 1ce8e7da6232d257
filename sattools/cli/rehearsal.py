"""Commands that a batch would run, as dry runs one after the other, for what they would refuse."""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import click

from sattools.batch.plan import Task
from sattools.batch.queue import Batch
from sattools.scene.copies import absolute_copy
from sattools.scene.document import Scene


def refusals(plan: Batch, scenes: Sequence[Scene]) -> dict[tuple[str, str], str]:
    """(scene, configuration) -> why it would fail at its start.

    Of an area of the contest, whose scene is not made yet, it is known of `prep` alone.

    Args:
        plan: of a batch.
        scenes: of the batch.
    """
    found = {}
    for scene in scenes:
        for pair, task in plan.runs.items():
            if pair[0] == scene.id and (error := _rehearse(task, scene)):
                found[pair] = error
    for first in plan.jobs:
        if first.task.source is None and (error := _rehearse(first.task, None)):
            waiting = [job.task for job in plan.jobs if first in job.needs() and job.task.kind != "prep"]
            found |= {(task.scene, task.configuration): error for task in waiting}
    return found


def _rehearse(task: Task, scene: Scene | None) -> str | None:
    """Why a task would be refused before its work; None where nothing is in the way.

    As on a pipe of dry runs, nothing is asked for that a command before would have made.

    Args:
        task: of a batch.
        scene: that it begins with; None where its command makes the scene.
    """
    with tempfile.TemporaryDirectory() as folder:  # the task's own is not there yet, and shall not be
        config = Path(folder) / "config.toml"
        config.write_text(task.config, encoding="utf-8")
        root = Path(folder) / "scene"
        root.mkdir()
        text = absolute_copy(scene, root).to_json() if scene is not None else ""
        for name, *arguments in task.commands:
            given = ["-" if part == "{scene}" else part for part in arguments]
            status, text, said = _dry([name, *given, "--config", str(config), "--dry-run"], text)
            if status:
                return said[-1] if said else f"sattools {name}: would end with status {status}"
    return None


def _dry(arguments: list[str], text: str) -> tuple[int, str, list[str]]:
    """A command in this process: its status, what it prints, and the lines that it says."""
    from sattools.cli import main

    name, *rest = arguments
    parent = click.get_current_context().find_root()
    command = main.get_command(parent, name)
    assert command is not None  # a batch has none but those of this suite
    out, err, status = io.StringIO(), io.StringIO(), 0
    with _stdin(text), redirect_stdout(out), redirect_stderr(err):
        try:
            with command.make_context(name, rest, parent=parent) as context:
                command.invoke(context)
        except click.ClickException as error:
            return error.exit_code, "", [f"sattools {name}: error: {error.format_message()}"]
        except SystemExit as error:
            status = error.code if isinstance(error.code, int) else 1
    return status, out.getvalue(), err.getvalue().splitlines()


@contextmanager
def _stdin(text: str) -> Iterator[None]:
    before = sys.stdin
    sys.stdin = io.TextIOWrapper(io.BytesIO(text.encode()), encoding="utf-8")
    try:
        yield
    finally:
        sys.stdin = before


__all__ = ["refusals"]

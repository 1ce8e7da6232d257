"""The batch stage: every scene in every configuration, one table and one figure."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

from sattools.batch.cluster import Job, check_cluster, run, shares
from sattools.batch.configuration import Configuration
from sattools.batch.earlier import comparable_rows, tell_of_joined
from sattools.batch.figure import draw
from sattools.batch.gate import FIGURE, check_folder, joined_folder
from sattools.batch.join import FILES, join
from sattools.batch.options import BatchOptions
from sattools.batch.plan import (
    Task,
)
from sattools.batch.queue import Batch, make_plan
from sattools.batch.table import write_tables
from sattools.progress import Progress, silent
from sattools.scene.document import Scene
from sattools.scene.files import locked, remove_orphans
from sattools.scene.folders import make_folder
from sattools.scene.jsonio import JsonObject

log = logging.getLogger(__name__)


class _Running:
    """What is done of a batch, and what is told of it.

    Args:
        plan: of the batch; gets results and errors.
        out: folder of its tables.
        progress: share of the whole batch.
        emit: called with the scene document of every finished task.
    """

    def __init__(self, plan: Batch, out: Path, progress: Progress, emit: Callable[[str], None]) -> None:
        self.plan, self.out, self.progress, self.emit = plan, out, progress, emit
        self.total = len(plan.rows)
        begun = plan.results | plan.errors
        self.open = {f"{scene}/{name}": 0.0 for scene, name in plan.rows if (scene, name) not in begun}
        self.steps: dict[str, int] = {}  # of a run in tiles, once they are known

    def told(self, name: str, share: float, message: str) -> None:
        """Pass on what a task says of itself."""
        if name in self.open and name not in self.steps:
            self.open[name] = share
        done = self.total - len(self.open)
        text = f"{done} of {self.total} done, {name}: {message}"
        self.progress(min(1.0, (done + sum(self.open.values())) / max(1, self.total)), text)

    def finished(self, task: Task, result: JsonObject) -> list[Job]:
        """Note the result of a task; the jobs that follow from it."""
        plan, pair = self.plan, (task.scene, task.configuration)
        name = "/".join(pair)
        if task.kind in ("coarse", "split") and result["status"] == "done":
            try:
                more = plan.follow(task)
            except (OSError, ValueError) as error:
                result = {"status": "failed", "error": str(error)}
            else:
                self.steps[name] = len(more) + 1
                self.open[name] = 1 / self.steps[name]
                self.told(task.name, 1.0, result["status"])
                return more
        elif task.kind in ("prep", "tile"):  # a failed one fails the run that waits for it
            own = 1 / self.steps[name] if task.kind == "tile" and name in self.steps else 0.0
            self.open[name] = self.open.get(name, 0.0) + own
            self.told(task.name, 1.0, result["status"])
            return []
        self.open.pop(name, None)
        done = result["status"] == "done"
        if done:
            plan.results[pair] = result
        else:
            plan.errors[pair] = ("failed", result["error"])
            log.error("%s: %s", task.name, result["error"])
        write_tables(plan.table(), self.out)
        if done:
            self.emit(_line(result))
        self.told(task.name, 1.0, result["status"])
        return []


def batch(
    options: BatchOptions,
    scenes: Sequence[Scene],
    configurations: Sequence[Configuration],
    cores: int,
    progress: Progress = silent,
    *,
    overwrite: bool = False,
    emit: Callable[[str], None] = lambda line: None,
) -> Batch:
    """Run every scene in every configuration and write the table below `options.out`.

    A failed task does not stop the others; `Batch.errors` names it. What an earlier run has finished with the same
    inputs, options and version is taken from there.

    Args:
        options: the options of the batch.
        scenes: scenes to use beside the areas of `options.dfc2019`.
        configurations: sets of options; names differ.
        cores: CPU cores that may be used.
        progress: share of the whole batch.
        overwrite: do finished tasks again.
        emit: called with the scene document of every finished task as soon as it is there.
    """
    check_folder(options, scenes, configurations, overwrite)
    out = Path(options.out).absolute()
    make_folder(out)
    with locked(out):  # another batch would begin tiles anew that this one is about to join
        plan = make_plan(options, scenes, configurations, overwrite)
        plan.kept = comparable_rows(out, plan.rows, configurations)
        for pair, (_, error) in plan.errors.items():
            log.error("%s/%s: %s", *pair, error)
        for result in plan.results.values():
            emit(_line(result))
        before = set(plan.results)
        state = _Running(plan, out, progress, emit)
        log.info("%d tasks, %d of them done before", state.total, len(plan.results))
        try:
            if plan.jobs:
                share = shares(options, cores, len(state.open), bool(plan.tiled))
                if plan.forgotten:
                    check_cluster(options, cores, len(state.open), bool(plan.tiled))
                    plan.forget()
                run(plan.jobs, options, share, state.finished, state.told)
        finally:
            # commands die with their workers, a little later and in the middle of whatever they write
            remove_orphans(out, patience_s=10)
        rows = plan.table()
        write_tables(rows, out)
        # scenes of earlier calls may have no configuration in common with those of this one
        if not draw(rows, out / FIGURE):
            draw(rows[: len(rows) - len(plan.kept)], out / FIGURE)
        if options.join:
            plan.joined = {c.name: _join(plan, c.name, out) for c in configurations}
        else:
            tell_of_joined(out, set(plan.results) - before, configurations)
    return plan


def _join(plan: Batch, configuration: str, out: Path) -> JsonObject | None:
    """Join what a configuration has made of all scenes; see `join`. None where it has made nothing."""
    done = [plan.results[pair] for pair in plan.rows if pair[1] == configuration and pair in plan.results]
    scenes = [Scene.from_file(result["scene_json"]) for result in done]
    failed = [name for name, of in plan.rows if of == configuration and (name, of) not in plan.results]
    if scenes and failed:
        log.warning("%s: the joined surface is without %s, which failed", configuration, ", ".join(failed))
    folder = joined_folder(out, configuration)
    if scenes:
        return join(scenes, folder)
    if (folder / FILES[0]).exists():
        log.warning("%s: nothing to join; %s is still that of an earlier call", configuration, folder / FILES[0])
    return None


def _line(result: JsonObject) -> str:
    return Scene.from_file(result["scene_json"]).to_json()


__all__ = ["batch"]

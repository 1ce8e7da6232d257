"""The batch stage: every scene in every configuration, one table and one figure."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sattools.batch.cluster import Job, check_cluster, run, shares
from sattools.batch.configuration import Configuration
from sattools.batch.earlier import comparable_rows, tell_of_joined
from sattools.batch.figure import draw
from sattools.batch.gate import DIGESTS, FIGURE, check_folder, check_references, document_of, is_own, joined_folder
from sattools.batch.join import FILES, join
from sattools.batch.options import BatchOptions
from sattools.batch.plan import (
    Digests,
    Task,
    after_shared,
    coarse_task,
    pilot_tasks,
    prep_task,
    run_task,
    scene_content,
    shared_task,
    tile_tasks,
)
from sattools.batch.table import Row, failed_row, write_tables
from sattools.errors import InputError, SattoolsError, SceneError
from sattools.progress import Progress, silent
from sattools.scene.document import Scene, check_id
from sattools.scene.files import check_outputs, locked, remove_orphans, write_text
from sattools.scene.folders import make_folder
from sattools.scene.jsonio import JsonObject

log = logging.getLogger(__name__)


@dataclass
class Batch:
    """A planned batch.

    Attributes:
        jobs: what is still to be done, in order.
        results: (scene, configuration) -> result of a finished task.
        rows: (scene, configuration) in the table's order.
        errors: (scene, configuration) -> why there is no result.
        shared: key of a task -> it, and the runs that need what it makes.
        tiled: key of a coarse fit, or of the split after it, -> the run that joins its tiles, and its configuration.
        runs: (scene, configuration) -> the task of what is not finished, before its steps are shared or cut into tiles.
        kept: rows of earlier calls in the same folder, which are not of this one.
        joined: configuration -> what `join` says of its scenes; None where none is done.
        overwrite: what is finished is done again; forgotten: records of it, which `forget` removes.
    """

    jobs: list[Job] = field(default_factory=list)
    results: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)
    rows: list[tuple[str, str]] = field(default_factory=list)
    errors: dict[tuple[str, str], tuple[str, str]] = field(default_factory=dict)
    shared: dict[str, tuple[Task, list[Job]]] = field(default_factory=dict)
    tiled: dict[str, tuple[Job, Configuration]] = field(default_factory=dict)
    runs: dict[tuple[str, str], Task] = field(default_factory=dict)
    kept: list[Row] = field(default_factory=list)
    joined: dict[str, JsonObject | None] = field(default_factory=dict)
    overwrite: bool = False
    forgotten: set[Path] = field(default_factory=set)

    def earlier(self, task: Task) -> JsonObject | None:
        """What an earlier run has left of a task; None, and it is to be forgotten, where all is done again."""
        if self.overwrite:
            self.forgotten.add(task.record)
        return None if self.overwrite else task.result()

    def forget(self) -> None:
        """Remove the records of what is done again: not before nothing is in the way of that."""
        for record in self.forgotten:
            record.unlink(missing_ok=True)

    def share(self) -> None:
        """Let runs of one scene that differ only later on start from one prior."""
        for task, runs in self.shared.values():
            if len(runs) < 2:
                continue
            first = self.jobs.index(runs[0])
            before = () if self.earlier(task) is not None else (Job(task, runs[0].after),)
            for job in runs:
                self.jobs[self.jobs.index(job)] = replace(
                    job, task=after_shared(job.task, task), after=before or job.after
                )
            self.jobs[first:first] = before

    def follow(self, begun: Task) -> list[Job]:
        """The jobs that are left of a run in tiles: after the coarse fit its pilots and the split, then the tiles."""
        run, configuration = self.tiled[begun.key]
        if begun.kind == "coarse":
            pilots, split = pilot_tasks(run.task, begun)
            self.tiled[split.key] = (run, configuration)
            if split.result() is not None:
                return self.follow(split)
            before = tuple(Job(task, gpu=run.gpu) for task in pilots if task.result() is None)
            return [*before, Job(split, before, run.gpu)]
        tiles, joined = tile_tasks(run.task, begun, configuration)
        jobs = tuple(Job(task, gpu=run.gpu) for task in tiles if task.result() is None)
        return [*jobs, Job(joined, jobs, run.gpu)]

    def refuse(self, errors: dict[tuple[str, str], str]) -> None:
        """Take out what would fail at its start, and what would be done for nothing else.

        Args:
            errors: (scene, configuration) -> why.
        """
        self.errors |= {pair: ("failed", error) for pair, error in errors.items()}
        runs = [j for j in self.jobs if j.task.kind != "prep" and (j.task.scene, j.task.configuration) not in errors]
        needed = [before for job in runs for before in job.needs()]
        self.jobs = [job for job in self.jobs if job in runs or job in needed]

    def table(self) -> list[Row]:
        """The rows that are known by now, those of earlier calls last."""
        rows = []
        for pair in self.rows:
            if pair in self.results:
                rows.append(self.results[pair]["row"])
            elif pair in self.errors:
                rows.append(failed_row(*pair, *self.errors[pair]))
        return rows + self.kept


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
        if result["status"] == "done":
            plan.results[pair] = result
            self.emit(_line(result))
        else:
            plan.errors[pair] = ("failed", result["error"])
            log.error("%s: %s", task.name, result["error"])
        write_tables(plan.table(), self.out)
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


def make_plan(
    options: BatchOptions,
    scenes: Sequence[Scene],
    configurations: Sequence[Configuration],
    overwrite: bool = False,
    dry_run: bool = False,
) -> Batch:
    """What there is to do, and what is done already; with ``dry_run`` nothing is written.

    Args:
        options: of the batch.
        scenes: to use beside the areas.
        configurations: sets of options.
        overwrite: do finished tasks again.
        dry_run: write nothing.
    """
    names = [check_id(c.name, "--config") for c in configurations]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"--config: found two files named {sorted(twice)[0]!r}, expected different names")
    ids = [scene.id for scene in scenes] + list(options.aoi)
    twice = {name for name in ids if ids.count(name) > 1}
    if twice:
        raise SceneError(f"batch: found scene id {sorted(twice)[0]!r} twice, expected unique ids")
    if options.aoi and options.dfc2019 is None:
        raise InputError("--aoi: found no --dfc2019, expected the root of the contest's data")
    out = Path(options.out).absolute()
    plan = Batch(rows=[(scene, c.name) for scene in ids for c in configurations], overwrite=overwrite)
    digests = Digests(out / DIGESTS)
    if not dry_run:
        digests.save()  # from here on the folder is known as a batch's
    for scene in scenes:
        truth = scene.products.get("truth_dsm")
        for c in configurations:
            try:
                content = scene_content(scene, digests)
                source = _document(scene, out, dry_run)
                truth_path = scene.path(truth) if truth else None
                task = run_task(out, scene.id, source, content, c, truth=truth_path, digests=digests)
                _add(plan, Job(task, gpu=options.gpu), c, content)
            except SattoolsError as error:
                plan.errors[scene.id, c.name] = ("failed", str(error))
    for aoi in options.aoi:
        _add_area(plan, aoi, options, configurations, digests)
    known = {c.name: c for c in configurations}
    check_references([(run, known[run.configuration]) for run in plan.runs.values()])
    plan.share()
    if not dry_run:
        digests.save()
    return plan


def _add_area(
    plan: Batch,
    aoi: str,
    options: BatchOptions,
    configurations: Sequence[Configuration],
    digests: Digests,
) -> None:
    from sattools.prep.dfc2019 import find_images, find_truth, is_crop

    assert options.dfc2019 is not None
    root, out = Path(options.dfc2019).absolute(), Path(options.out).absolute()
    try:
        images, metadata = find_images(root, aoi, options.imagery)
    except InputError as error:
        plan.errors |= {(aoi, c.name): ("missing", str(error)) for c in configurations}
        return
    truth = find_truth(root, aoi)
    arguments = ["--metadata", str(metadata)] if metadata else []
    if truth is not None and not is_crop(images[0]):
        from sattools.compare.truth import read_dfc2019

        # the contest's tiles show more than the area that is scored
        grid = read_dfc2019(truth, aoi).grid
        arguments += ["--bounds", *(f"{value:.3f}" for value in grid.bounds), "--crs", grid.crs]
    for c in configurations:
        given = [*arguments]
        if c.tables.get("prep", {}).get("metadata"):
            given = [*given[2:]] if metadata else given
        prep = prep_task(out, aoi, images, given, c, digests)
        source = Path(prep.folder) / aoi / "scene.json"
        task = run_task(out, aoi, source, prep.key, c, truth=truth, digests=digests, prepared=True)
        earlier = plan.earlier(prep)
        before: tuple[Job, ...] = ()
        if earlier is None:
            before = (next((job for job in plan.jobs if job.task.key == prep.key), Job(prep)),)
        there = len(plan.jobs)
        if _add(plan, Job(task, before, options.gpu), c, prep.key) and before and before[0] not in plan.jobs:
            plan.jobs.insert(there, before[0])


def _add(plan: Batch, job: Job, configuration: Configuration, content: Any) -> bool:
    """Plan a run unless it is done before: as one job, or beginning with the coarse fit of its scene in tiles."""
    task = job.task
    earlier = plan.earlier(task)
    if earlier is not None:
        plan.results[task.scene, task.configuration] = earlier
        return False
    check_outputs([task.record], overwrite=True)  # before anything is done for it
    plan.runs[task.scene, task.configuration] = task
    if configuration.resolved.get("fit", {}).get("tile") in (None, 0, "auto"):  # auto: tiles within the run's own task
        plan.jobs.append(job)
        shared = shared_task(Path(task.folder).parents[2], task, content, configuration)
        if shared is not None:
            plan.shared.setdefault(shared.key, (shared, []))[1].append(job)
        return True
    coarse = coarse_task(task, content, configuration)
    plan.tiled[coarse.key] = (job, configuration)
    plan.earlier(replace(coarse, kind="split"))  # forgotten with it, where all is done again
    if plan.earlier(coarse) is None:
        plan.jobs.append(Job(coarse, job.after, job.gpu))
    else:
        plan.jobs += plan.follow(coarse)
    return True


def _document(scene: Scene, out: Path, dry_run: bool) -> Path:
    """A file with the scene's document: what came on stdin may not be the one in its folder."""
    path = document_of(scene, out)
    if not dry_run and not is_own(scene, out):
        write_text(path, scene.to_json() + "\n")
    return path


def _line(result: JsonObject) -> str:
    return Scene.from_file(result["scene_json"]).to_json()


__all__ = ["Batch", "batch", "make_plan"]

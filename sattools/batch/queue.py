"""What is to be done of a batch: its jobs in their order, and what earlier calls have left of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sattools.batch.cluster import Job
from sattools.batch.configuration import Configuration
from sattools.batch.gate import DIGESTS, check_references, document_of, is_own
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
    with_metadata,
)
from sattools.batch.table import Row, failed_row
from sattools.errors import InputError, SattoolsError, SceneError
from sattools.scene.document import Scene, check_id
from sattools.scene.files import check_outputs, write_text
from sattools.scene.jsonio import JsonObject


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
        overwrite: what is finished is done again; forgotten: tasks whose records `forget` removes.
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
    forgotten: list[Task] = field(default_factory=list)

    def earlier(self, task: Task) -> JsonObject | None:
        """What an earlier run has left of a task; None, and it is to be forgotten, where all is done again."""
        if self.overwrite:
            self.forgotten.append(task)
        return None if self.overwrite else task.result()

    def forget(self) -> None:
        """Remove the records of what is done again: not before nothing is in the way of that."""
        for task in self.forgotten:
            task.record.unlink(missing_ok=True)
            task.begun.unlink(missing_ok=True)

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
                content = with_metadata(scene_content(scene, digests), c, digests)
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
    try:
        arguments = [] if truth is None or is_crop(images[0]) else _scored_area(truth, aoi)
    except SattoolsError as error:
        plan.errors |= {(aoi, c.name): ("failed", str(error)) for c in configurations}
        return
    for c in configurations:
        try:
            prep = prep_task(out, aoi, images, arguments, c, metadata=metadata, digests=digests)
            content = with_metadata(prep.key, c, digests)
            source = Path(prep.folder) / aoi / "scene.json"
            task = run_task(out, aoi, source, content, c, truth=truth, digests=digests, prepared=True)
        except SattoolsError as error:
            plan.errors[aoi, c.name] = ("failed", str(error))
            continue
        earlier = plan.earlier(prep)
        before: tuple[Job, ...] = ()
        if earlier is None:
            before = (next((job for job in plan.jobs if job.task.key == prep.key), Job(prep)),)
        there = len(plan.jobs)
        if _add(plan, Job(task, before, options.gpu), c, content) and before and before[0] not in plan.jobs:
            plan.jobs.insert(there, before[0])


def _scored_area(truth: Path, aoi: str) -> list[str]:
    """Arguments of `prep`: the contest's tiles show more than the area that is scored."""
    from sattools.compare.truth import read_dfc2019

    grid = read_dfc2019(truth, aoi).grid
    return ["--bounds", *(f"{value:.3f}" for value in grid.bounds), "--crs", grid.crs]


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


__all__ = ["Batch", "make_plan"]

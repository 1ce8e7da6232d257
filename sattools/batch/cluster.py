"""Tasks on a Dask cluster: this machine's own, or any whose scheduler has an address."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

from sattools import system
from sattools.batch.launch import Launcher
from sattools.batch.options import BatchOptions
from sattools.batch.plan import Task
from sattools.batch.task import perform
from sattools.errors import InputError, SattoolsError
from sattools.scene.jsonio import JsonObject
from sattools.scene.memory import granted

log = logging.getLogger(__name__)
TOPIC = "sattools-batch"
_own = threading.local()  # of a thread of a worker: its launcher, as workers may do several tasks at a time
_REPORT_EVERY_S = 0.5
TASK_MB = 3500.0  # for which a worker is started, as machines have 4 GB a core; a task in tiles takes a fourth of it
_NO_DASK = "batch: found no Dask, expected the extra: pip install 'sattools[batch]'"

Told = Callable[[str, float, str], None]


@dataclass(frozen=True)
class Job:
    """A task and those that must be done before it."""

    task: Task
    after: tuple[Job, ...] = ()
    gpu: bool = False

    def needs(self) -> list[Job]:
        """All that must be done before it, near and far."""
        return [needed for before in self.after for needed in (before, *before.needs())]


Finished = Callable[[Task, dict[str, Any]], list[Job]]


@dataclass(frozen=True)
class Shares:
    """What a task may use; None = decided by the worker.

    Attributes:
        workers: tasks at a time.
        threads: of a task of which there may be as many as workers.
        alone: threads of one beside which only other runs are done, as the coarse fit of an area is.
        memory_mb: of a task.
        gpus: their numbers.
    """

    workers: int
    threads: int | None
    alone: int | None
    memory_mb: float | None
    gpus: list[str] = field(default_factory=list)

    def threads_of(self, task: Task) -> int | None:
        """Threads of a task."""
        return self.threads if task.kind == "tile" else self.alone


def shares(options: BatchOptions, cores: int, runs: int, tiled: bool) -> Shares:
    """Workers, and threads and memory of a task.

    As many tasks at a time as there are cores, as far as there are tasks and memory, which brings more than several
    threads for one (docs/batch.md). Cores that are left go to threads.

    Raises InputError where GPUs are asked for and none is found.

    Args:
        options: of the batch.
        cores: that may be used.
        runs: scenes times configurations to be done.
        tiled: whether some of them are cut into tiles, of which there are many.
    """
    if options.scheduler is not None:
        return Shares(0, options.task_threads, options.task_threads, options.memory_limit)
    gpus = _gpus() if options.gpu else []
    if options.gpu and not gpus:
        raise InputError("--gpu: found no GPU by nvidia-smi, expected one (or --scheduler with workers that have some)")
    try:
        import psutil
    except ImportError as error:
        raise SattoolsError(_NO_DASK) from error
    there = granted(psutil.virtual_memory().total) / 2**20
    fitting = int(there // (options.memory_limit or TASK_MB))
    workers = options.workers or len(gpus) or max(1, min(cores, fitting, cores if tiled else runs))
    memory = options.memory_limit or there / workers
    each, alone = (options.task_threads or max(1, cores // n) for n in (workers, max(1, min(workers, runs))))
    return Shares(workers, each, alone, memory, gpus)


def check_cluster(options: BatchOptions, cores: int, runs: int, tiled: bool, *, ahead: bool = False) -> None:
    """Raise what is in the way of starting tasks; arguments and errors as of `shares` and `run`.

    Args:
        options: of the batch.
        cores: that may be used.
        runs: scenes times configurations to be done.
        tiled: whether some of them are cut into tiles.
        ahead: the tasks are not at hand yet, and a scheduler may come as late as they do.
    """
    share = shares(options, cores, runs, tiled)
    if find_spec("distributed") is None:
        raise SattoolsError(_NO_DASK)
    if options.scheduler is not None and not ahead:
        with _client(options, share):
            pass


def run(jobs: list[Job], options: BatchOptions, share: Shares, finished: Finished, told: Told) -> None:
    """Do all jobs.

    `finished` is called for each as soon as it is done and gives the jobs that follow from it.

    Raises SattoolsError where Dask is not installed or the scheduler does not answer.

    Args:
        jobs: to do.
        options: of the batch.
        share: cores and memory of a task.
        finished: called with every task and its result; gives the jobs that follow.
        told: called with a task's name, its share done and a message.
    """
    try:
        from distributed import as_completed
    except ImportError as error:
        raise SattoolsError(_NO_DASK) from error
    with _client(options, share) as client:
        client.subscribe_topic(TOPIC, lambda event: told(*event[1]))
        _tell_of_workers(client, options)
        futures: dict[str, Any] = {}
        of_key: dict[str, Task] = {}

        def submit(job: Job) -> Any:
            futures[job.task.key] = client.submit(
                work,
                job.task,
                [futures[before.task.key] for before in job.after if before.task.key in futures],
                share,
                key=f"sattools-{job.task.key}",
                resources={"GPU": 1} if job.gpu else None,
                retries=options.retries,
                pure=False,
            )
            of_key[futures[job.task.key].key] = job.task
            return futures[job.task.key]

        waiting = as_completed([submit(job) for job in jobs])
        for future in waiting:
            task = of_key[future.key]
            if future.status == "finished":
                result = future.result()
            else:
                result = {"key": task.key, "status": "failed", "error": _lost(future)}
            for job in finished(task, result):
                waiting.add(submit(job))


def _tell_of_workers(client: Any, options: BatchOptions) -> None:
    """Say so where nobody is there yet who could begin: nothing else is heard from an idle cluster."""

    def resources(dask_scheduler: Any) -> list[dict[str, float]]:
        return [dict(worker.resources) for worker in dask_scheduler.workers.values()]

    if options.scheduler is None:
        return
    found = client.run_on_scheduler(resources)
    if not any(one.get("GPU") or not options.gpu for one in found):
        kind = "with the resource GPU=1 " if options.gpu else ""
        log.warning("--scheduler %s: found no worker %syet, waiting for one", options.scheduler, kind)


def _lost(future: Any) -> str:
    """Why a task has no result that it would have made itself."""
    error = future.exception() if future.status == "error" else None
    if error is None:
        return f"found it {future.status}, expected its result (is the Dask scheduler still there?)"
    return f"{type(error).__name__}: {error}"


def work(task: Task, before: list[JsonObject], share: Shares) -> JsonObject:
    """Runs on a worker.

    Args:
        task: to do.
        before: results of the tasks that it waits for.
        share: cores and memory of a task.
    """
    from time import monotonic

    from distributed import get_worker

    for earlier in before:
        if earlier["status"] != "done":
            return {"key": task.key, "status": "failed", "error": earlier["error"]}
    worker = get_worker()
    last = [monotonic() - _REPORT_EVERY_S]

    def report(fraction: float, message: str) -> None:
        if monotonic() - last[0] >= _REPORT_EVERY_S:
            last[0] = monotonic()
            worker.log_event(TOPIC, (task.name, fraction, message))

    gpu = share.gpus[int(worker.name) % len(share.gpus)] if share.gpus else None
    if not hasattr(_own, "launcher"):
        _own.launcher = Launcher()
    return perform(task, share.threads_of(task) or worker.state.nthreads, share.memory_mb, report, gpu, _own.launcher)


@contextmanager
def _client(options: BatchOptions, share: Shares) -> Iterator[Any]:
    import dask
    from distributed import Client, LocalCluster

    _silence()
    # a lost task may be the fault of the task: it is not tried for ever
    settings = {"distributed.scheduler.allowed-failures": options.retries}
    with dask.config.set(settings):
        if options.scheduler is not None:
            try:
                client = Client(options.scheduler, timeout=10)
            except (OSError, ValueError) as error:
                raise SattoolsError(f"--scheduler {options.scheduler}: found no Dask scheduler ({error})") from error
            with client:
                yield client
            return
        # the commands that a worker starts are watched one by one (`perform`): the worker itself needs next to nothing.
        # At Ctrl-C it is the batch that ends it
        with system.deaf():
            cluster = LocalCluster(
                n_workers=share.workers,
                threads_per_worker=1,
                processes=True,
                memory_limit=0,
                dashboard_address="127.0.0.1:0",
                worker_dashboard_address=None,
                scheduler_kwargs={"dashboard": False},
                resources={"GPU": 1} if share.gpus else None,
                silence_logs=50,
            )
        with cluster, Client(cluster) as client:
            yield client


def _silence() -> None:
    """Keep Dask's own messages, tracebacks of lost connections above all, for those who run the cluster (-vv)."""
    if logging.getLogger("sattools").level == logging.DEBUG:
        return
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]
    for name in ("distributed", *names, "tornado.application", "asyncio"):
        # its loggers have handlers and levels of their own
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _gpus() -> list[str]:
    """CUDA devices by the numbers that CUDA_VISIBLE_DEVICES takes."""
    if os.environ.get("CUDA_VISIBLE_DEVICES"):
        return os.environ["CUDA_VISIBLE_DEVICES"].split(",")
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    done = subprocess.run([program, "-L"], capture_output=True, text=True, check=False)
    return [
        str(number) for number, _ in enumerate(line for line in done.stdout.splitlines() if line.startswith("GPU "))
    ]


__all__ = ["Job", "Shares", "check_cluster", "run", "shares"]

"""What a worker does: the commands of one task, as processes of their own."""

from __future__ import annotations

import json
import os
import shlex
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sattools.batch.launch import Launcher, end
from sattools.batch.plan import Task
from sattools.batch.table import make_row
from sattools.errors import SattoolsError
from sattools.scene.files import write_text
from sattools.scene.jsonio import JsonObject

Report = Callable[[float, str], None]
_WATCH_S = 0.2


def perform(
    task: Task,
    threads: int,
    memory_mb: float | None,
    report: Report,
    gpu: str | None = None,
    launcher: Launcher | None = None,
) -> JsonObject:
    """Run a task unless it is done already; its result, also left in `Task.record`.

    Args:
        task: what to do.
        threads: CPU threads of every command.
        memory_mb: resident memory above which a command is stopped, or None.
        report: called with the share done and a message.
        gpu: the CUDA device that the commands see; None = all.
        launcher: starts the commands; None = one for this task.

    Returns:
        key, status (`done` or `failed`), scene_json, row (of a run), and for a failure the last line of the command.
    """
    earlier = task.result()
    if earlier is not None:
        return earlier
    result: dict[str, Any] = {"key": task.key, "name": task.name, "options": task.options}
    own = launcher or Launcher()
    goes_on = False
    try:
        finished = task.go_on()
        if finished is None:
            task.start()
        with open(Path(task.folder) / "attempts.jsonl", "a", encoding="utf-8") as file:
            # one short line at the end of a file: written in one piece
            file.write(json.dumps({"key": task.key, "pid": os.getpid(), "time": round(time.time(), 1)}) + "\n")
        for number, command in enumerate(task.commands):
            if number < (finished or 0):
                continue
            goes_on = number == finished

            def step(fraction: float, message: str, number: int = number) -> None:
                report((number + fraction) / len(task.commands), message)

            called = task.going_on(command) if goes_on else command
            given = [str(task.document) if part == "{scene}" else part for part in called]
            _run(task, given, _Means(threads, memory_mb, gpu, own), step)
        result |= {"status": "done", "scene_json": str(task.document)}
        if task.kind == "run":
            result["row"] = make_row(task.scene, task.configuration, task.document)
        write_text(task.record, json.dumps(result, indent=1) + "\n")
        task.begun.unlink(missing_ok=True)
    except (SattoolsError, OSError) as error:
        result |= {"status": "failed", "error": " ".join(str(error).split())}
        if goes_on:  # perhaps for what it went on with: the next run begins anew
            task.begun.unlink(missing_ok=True)
    finally:
        if launcher is None:
            own.close()
    return result


@dataclass(frozen=True)
class _Means:
    """What a command may use; see `perform`."""

    threads: int
    memory_mb: float | None
    gpu: str | None
    launcher: Launcher


def _run(task: Task, command: list[str], means: _Means, step: Report) -> None:
    """One command; raises SattoolsError with its last line where it fails."""
    call = ["--progress", "json", "--threads", str(means.threads), *command]
    memory_mb = means.memory_mb
    if memory_mb is not None:
        call += ["--max-memory", f"{memory_mb:.0f}"]
    call += ["--config", str(Path(task.folder) / "config.toml")]
    step(0.0, command[0])
    too_much, over = threading.Event(), threading.Event()

    def began(process: int) -> None:
        if memory_mb is not None:
            threading.Thread(target=_watch, args=(process, memory_mb, too_much, over), daemon=True).start()

    said, status = [""], 0
    try:
        with (
            open(Path(task.folder) / "log.txt", "a", encoding="utf-8") as log,
            closing(means.launcher.run(call, means.threads, means.gpu, began)) as lines,
        ):
            print("$", shlex.join(["sattools", *call]), file=log, flush=True)
            for line in lines:
                if isinstance(line, int):
                    status = line
                    break
                share = _progress(line)
                if share is not None:
                    step(*share)
                elif line.strip():
                    said.append(line.strip())
                    log.write(line)
                    log.flush()
    finally:
        over.set()
    if too_much.is_set():
        raise SattoolsError(f"sattools {command[0]}: needed more than {memory_mb:.0f} MB of memory and was stopped")
    if status:
        raise SattoolsError(said[-1] or f"sattools {command[0]}: ended with status {status} and said nothing")


def _progress(line: str) -> tuple[float, str] | None:
    if not line.startswith('{"progress"'):
        return None
    try:
        message = json.loads(line)
        return float(message["progress"]), str(message["message"])
    except (ValueError, KeyError, TypeError):
        return None


def _watch(process: int, limit_mb: float, too_much: threading.Event, over: threading.Event) -> None:
    """Stop a command that takes more memory than it may, before the machine has none left for the others."""
    import psutil

    with suppress(psutil.Error):
        seen = psutil.Process(process)
        while not over.wait(_WATCH_S):
            # with the processes that fit its tiles
            if sum(_resident(one) for one in (seen, *seen.children(recursive=True))) > limit_mb * 2**20:
                too_much.set()
                end(process)
                return


def _resident(process: Any) -> int:
    """Bytes in memory of a process; none once it has ended."""
    import psutil

    try:
        return int(process.memory_info().rss)
    except psutil.NoSuchProcess:
        return 0


__all__ = ["perform"]

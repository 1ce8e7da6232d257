"""What a worker does: the commands of one task, as processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from sattools.batch.plan import Task
from sattools.batch.table import make_row
from sattools.errors import SattoolsError
from sattools.processors import end_with_parent
from sattools.scene.files import write_text
from sattools.scene.jsonio import JsonObject

Report = Callable[[float, str], None]
_WATCH_S = 0.2


def perform(task: Task, threads: int, memory_mb: float | None, report: Report, gpu: str | None = None) -> JsonObject:
    """Run a task unless it is done already; its result, also left in `Task.record`.

    Args:
        task: what to do.
        threads: CPU threads of every command.
        memory_mb: resident memory above which a command is stopped, or None.
        report: called with the share done and a message.
        gpu: the CUDA device that the commands see; None = all.

    Returns:
        key, status (`done` or `failed`), scene_json, row (of a run), and for a failure the last line of the command.
    """
    earlier = task.result()
    if earlier is not None:
        return earlier
    result: dict[str, Any] = {"key": task.key, "name": task.name}
    try:
        scene = task.start()
        with open(Path(task.folder) / "attempts.jsonl", "a", encoding="utf-8") as file:
            # one short line at the end of a file: written in one piece
            file.write(json.dumps({"key": task.key, "pid": os.getpid(), "time": round(time.time(), 1)}) + "\n")
        for number, command in enumerate(task.commands):

            def step(fraction: float, message: str, number: int = number) -> None:
                report((number + fraction) / len(task.commands), message)

            _run(task, [str(scene) if part == "{scene}" else part for part in command], threads, memory_mb, step, gpu)
        result |= {"status": "done", "scene_json": str(scene)}
        if task.kind == "run":
            result["row"] = make_row(task.scene, task.configuration, scene)
        write_text(task.record, json.dumps(result, indent=1) + "\n")
    except (SattoolsError, OSError) as error:
        result |= {"status": "failed", "error": " ".join(str(error).split())}
    return result


def _run(task: Task, command: list[str], threads: int, memory_mb: float | None, step: Report, gpu: str | None) -> None:
    """One command; raises SattoolsError with its last line where it fails."""
    call = [sys.executable, "-m", "sattools", "--progress", "json", "--threads", str(threads), *command]
    if memory_mb is not None:
        call += ["--max-memory", f"{memory_mb:.0f}"]
    call += ["--config", str(Path(task.folder) / "config.toml")]
    environment = dict(os.environ)
    if gpu is not None:
        environment["CUDA_VISIBLE_DEVICES"] = gpu
    step(0.0, command[0])
    process = subprocess.Popen(
        call,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment,
        # it must not go on writing when its worker is lost and the task is started elsewhere
        preexec_fn=end_with_parent if sys.platform == "linux" else None,
    )
    too_much = threading.Event()
    if memory_mb is not None:
        threading.Thread(target=_watch, args=(process, memory_mb, too_much), daemon=True).start()
    said = [""]
    assert process.stderr is not None
    try:
        with open(Path(task.folder) / "log.txt", "a", encoding="utf-8") as log:
            print("$", *call, file=log)
            for line in process.stderr:
                share = _progress(line)
                if share is not None:
                    step(*share)
                elif line.strip():
                    said.append(line.strip())
                    log.write(line)
                    log.flush()
        status = process.wait()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        process.stderr.close()
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


def _watch(process: subprocess.Popen[str], limit_mb: float, too_much: threading.Event) -> None:
    """Stop a command that takes more memory than it may, before the machine has none left for the others."""
    import psutil

    with suppress(psutil.Error):
        seen = psutil.Process(process.pid)
        while process.poll() is None:
            # with the processes that fit its tiles
            if sum(_resident(one) for one in (seen, *seen.children(recursive=True))) > limit_mb * 2**20:
                too_much.set()
                process.kill()
                return
            time.sleep(_WATCH_S)


def _resident(process: Any) -> int:
    """Bytes in memory of a process; none once it has ended."""
    import psutil

    try:
        return int(process.memory_info().rss)
    except psutil.NoSuchProcess:
        return 0


__all__ = ["perform"]

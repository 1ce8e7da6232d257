"""Tiles fitted side by side, each by a process of its own: a second process brings more than a second thread.

Processes talk in lines of JSON (see `sattools.fit.tiles.helper`) and share nothing but files, so that the surface is
the same whatever their number.
"""

from __future__ import annotations

import builtins
import json
import logging
import os
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from sattools import errors
from sattools.errors import SattoolsError
from sattools.fit.files import CHECKPOINT, MODEL
from sattools.fit.options import FitOptions
from sattools.fit.whole import fit_whole
from sattools.processors import threads, with_threads
from sattools.progress import Progress
from sattools.scene import Scene
from sattools.scene.memory import give_back, share_of_limit

log = logging.getLogger(__name__)
_PACKAGE = Path(errors.__file__).parent.parent
_ATTEMPTS = 3  # of a part whose process is ended by signals
_PATIENCE_S = 10.0


@dataclass(frozen=True)
class Part:
    """A scene to fit.

    Attributes:
        name: for messages.
        root: folder of its `scene.json`.
        options: of the fit.
    """

    name: str
    root: Path
    options: FitOptions


def fit_parts(parts: Sequence[Part], helpers: int, progress: Progress) -> list[list[str]]:
    """Fit scenes, several at a time; the notes of each.

    Raises SattoolsError where one cannot be fitted; those that run are stopped then, and their checkpoints stay.

    Args:
        parts: the scenes.
        helpers: processes; with one all is done in this one.
        progress: told the share done of all and what is being done.
    """
    if min(helpers, len(parts)) > 1:
        return _Crew(parts, min(helpers, len(parts)), progress).run()
    notes = []
    for k, part in enumerate(parts):

        def told(fraction: float, message: str, k: int = k, name: str = part.name) -> None:
            progress((k + fraction) / len(parts), f"{name}: {message}")

        scene = Scene.from_file(part.root / "scene.json")
        options = replace(part.options, resume=(part.root / CHECKPOINT).exists())
        notes.append(list(fit_whole(scene, options, told)["notes"]))
        give_back()
    return notes


@dataclass
class _Helper:
    """A process with the number of the part that it works on."""

    process: subprocess.Popen[str]
    part: int | None = None


@dataclass
class _Crew:
    parts: Sequence[Part]
    helpers: int
    progress: Progress
    said: queue.Queue[tuple[_Helper, str | None]] = field(default_factory=queue.Queue)

    def __post_init__(self) -> None:
        self.waiting = deque(range(len(self.parts)))
        self.attempts = [0] * len(self.parts)
        self.shares = [0.0] * len(self.parts)
        self.notes: list[list[str] | None] = [None] * len(self.parts)
        self.running: list[_Helper] = []

    def run(self) -> list[list[str]]:
        try:
            for _ in range(self.helpers):
                self._start()
            while any(notes is None for notes in self.notes):
                helper, line = self.said.get()
                if line is None:
                    self._lost(helper)
                else:
                    self._heard(helper, line)
        finally:
            self._end()
        return [notes or [] for notes in self.notes]

    def _start(self) -> None:
        environment = with_threads(max(1, threads() // self.helpers)) | share_of_limit(self.helpers)
        paths = [str(_PACKAGE), *filter(None, [environment.get("PYTHONPATH")])]  # where this process has it from
        environment["PYTHONPATH"] = os.pathsep.join(paths)
        level = logging.getLogger("sattools").getEffectiveLevel()
        process = subprocess.Popen(
            [sys.executable, "-m", "sattools.fit.tiles.helper", str(level)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            encoding="utf-8",
            env=environment,
            process_group=0,  # Ctrl-C is this process's to hear
        )
        helper = _Helper(process)
        self.running.append(helper)
        threading.Thread(target=self._listen, args=(helper,), daemon=True).start()
        self._order(helper)

    def _listen(self, helper: _Helper) -> None:
        assert helper.process.stdout is not None
        with helper.process.stdout as lines:
            for line in lines:
                self.said.put((helper, line))
        self.said.put((helper, None))

    def _order(self, helper: _Helper) -> None:
        """Give it the next part, or let it go."""
        assert helper.process.stdin is not None
        if not self.waiting:
            helper.part = None
            helper.process.stdin.close()
            return
        helper.part = self.waiting.popleft()
        self.attempts[helper.part] += 1
        part = self.parts[helper.part]
        begun = (part.root / CHECKPOINT).exists()  # by an earlier run, or by a process that was lost
        order = {"root": str(part.root), "options": asdict(replace(part.options, resume=begun))}
        with suppress(BrokenPipeError):  # it has ended: told by `_listen`
            print(json.dumps(order), file=helper.process.stdin, flush=True)

    def _heard(self, helper: _Helper, line: str) -> None:
        if not line.endswith("\n"):  # the last words of a process that was killed
            return
        ((kind, what),) = json.loads(line).items()
        if kind == "log":
            level, name, text = what
            logging.getLogger(name).log(level, "%s", text)
            return
        assert helper.part is not None
        part = self.parts[helper.part]
        if kind == "error":
            name, *parts = what
            raise (getattr(errors, name, None) or getattr(builtins, name))(*parts)
        if kind == "progress":
            self.shares[helper.part] = what[0]
            self.progress(sum(self.shares) / len(self.parts), f"{part.name}: {what[1]}")
        elif kind == "done":
            self.shares[helper.part], self.notes[helper.part] = 1.0, what
            self._order(helper)

    def _lost(self, helper: _Helper) -> None:
        """A process has ended: for want of work, or before its time."""
        status = helper.process.wait()
        self.running.remove(helper)
        self._close(helper)
        if helper.part is None:
            return
        part = self.parts[helper.part]
        if (part.root / MODEL).exists():  # it had only not told yet
            self.notes[helper.part] = []
            self._order_more()
            return
        if status >= 0 or self.attempts[helper.part] >= _ATTEMPTS:
            raise SattoolsError(
                f"{part.name} ({part.root}): its process ended with status {status}, expected its fit (for want of "
                "memory? fewer --threads, and --resume, go on from here)"
            )
        log.warning("%s: its process was ended by signal %d; it goes on with one process less", part.name, -status)
        self.waiting.appendleft(helper.part)
        self._order_more()

    def _order_more(self) -> None:
        """Start a process where none is left for what waits."""
        if self.waiting and all(other.part is None for other in self.running):
            self._start()

    def _end(self) -> None:
        for helper in self.running:
            if helper.part is not None:
                helper.process.terminate()
        for helper in self.running:
            try:
                helper.process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                helper.process.kill()
                helper.process.wait()
            self._close(helper)

    @staticmethod
    def _close(helper: _Helper) -> None:
        assert helper.process.stdin is not None
        with suppress(OSError):  # of what could not be sent any more
            helper.process.stdin.close()


__all__ = ["Part", "fit_parts"]

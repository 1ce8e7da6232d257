"""A process that fits tiles for another one: `python -m sattools.fit.tiles.helper`, see `sattools.fit.tiles.crew`.

Orders come on stdin and answers go to what was stdout, one JSON object a line. It ends when there are no more orders,
and with the process that gave them.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TextIO

from sattools.errors import SattoolsError
from sattools.system import end_with_parent

log = logging.getLogger(__name__)


class Answers(logging.Handler):
    """What is told to the process that gives the orders: progress, messages, results."""

    def __init__(self, out: TextIO) -> None:
        super().__init__()
        self.out = out

    def tell(self, kind: str, what: Any) -> None:
        """Write one line.

        Args:
            kind: `progress`, `log`, `done` or `error`.
            what: goes with it.
        """
        print(json.dumps({kind: what}), file=self.out, flush=True)

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        self.tell("log", [record.levelno, record.name, record.getMessage()])

    def progress(self, fraction: float, message: str) -> None:
        """See `sattools.progress.Progress`."""
        self.tell("progress", [fraction, message])


def _error_to_tell(error: Exception) -> list[Any]:
    """Kind of an error, and what another one of that kind is made of.

    Args:
        error: the error.
    """
    if isinstance(error, SattoolsError | MemoryError):
        return [type(error).__name__, str(error)]
    if isinstance(error, OSError) and error.strerror:
        filename = None if error.filename is None else os.fsdecode(error.filename)
        return ["OSError", error.errno, error.strerror, filename]
    return ["RuntimeError", str(error) if type(error) is RuntimeError else f"{type(error).__name__}: {error}"]


def serve(orders: Iterable[str], answers: Answers) -> None:
    """Fit what is ordered until there is nothing more.

    Args:
        orders: lines with the folder of a scene (`root`) and the `options` of its fit.
        answers: told how it goes.
    """
    for line in orders:
        order = json.loads(line)
        try:
            from sattools.fit.options import FitOptions
            from sattools.fit.whole import fit_whole
            from sattools.scene import Scene
            from sattools.scene.memory import give_back

            scene = Scene.from_file(Path(order["root"]) / "scene.json")
            result = fit_whole(scene, FitOptions(**order["options"]), answers.progress)
        except Exception as error:  # the command makes one line of it, whatever it is
            if not isinstance(error, SattoolsError):
                log.debug("%s", traceback.format_exc())
            answers.tell("error", _error_to_tell(error))
            continue
        answers.tell("done", result["notes"])
        del result, scene
        give_back()


def main() -> None:
    """Serve on stdin and stdout."""
    end_with_parent(signal.SIGTERM)
    # Ctrl-C is heard by the process that gives the orders
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    answers = Answers(os.fdopen(os.dup(1), "w", encoding="utf-8"))
    os.dup2(2, 1)  # whatever a library prints is no answer
    logging.getLogger().addHandler(answers)
    logging.getLogger("sattools").setLevel(int(sys.argv[1]))
    try:
        serve(sys.stdin, answers)
    except BrokenPipeError:  # nobody listens any more
        os._exit(1)


if __name__ == "__main__":
    main()

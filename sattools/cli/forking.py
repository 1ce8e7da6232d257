"""Commands that begin without importing: `python -m sattools.cli.forking`, kept by every worker of a batch.

A command imports for one to two seconds, half as long as it fits a tile. This process has imported what commands need
and forks for every line of its input, a JSON list of a command's arguments, so that each is a process of its own as
before. On stderr it says, between what the command says, `{"began": PID}` and `{"ended": EXIT STATUS}`.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
from contextlib import suppress
from importlib import import_module

from sattools.cli import entry
from sattools.cli.commands import COMMANDS, WORK
from sattools.compiled import get_ready
from sattools.system import end_with_parent


def tell(kind: str, what: int) -> None:
    """Write a line of our own; a command that was killed may have left half of one.

    Args:
        kind: `began` or `ended`.
        what: number of the process, or its exit status.
    """
    os.write(2, f"\n{json.dumps({kind: what})}\n".encode())


def _call_it(command: str) -> None:
    """What lists of processes call this one."""
    with suppress(OSError), open("/proc/self/comm", "w", encoding="ascii") as name:
        name.write(f"sattools {command}"[:15])


def import_all() -> None:
    """Import what commands need, also what they import only when they come to use it."""
    used = ("matplotlib.backends.backend_agg", "matplotlib.figure", "safetensors.torch")
    for name in (*WORK.values(), *(f"sattools.cli.{command}" for command in COMMANDS), *used):
        import_module(name)
    get_ready()
    gc.collect()
    gc.freeze()  # what is here stays, and looking at it would copy its pages into every command


def main() -> None:
    """Serve on stdin."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the batch's to hear
    import_all()
    for line in sys.stdin:
        process = os.fork()
        if not process:
            end_with_parent()
            nothing = os.open(os.devnull, os.O_RDONLY)
            os.dup2(nothing, 0)
            sys.stdin = os.fdopen(nothing, encoding="utf-8")
            sys.argv[1:] = json.loads(line)
            _call_it(next((argument for argument in sys.argv[1:] if argument in COMMANDS), ""))
            entry()
            return
        tell("began", process)
        tell("ended", os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]))


if __name__ == "__main__":
    main()

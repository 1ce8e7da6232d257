"""Processes that begin without importing, for tests that are not about how one starts.

A test process keeps a server that has imported everything and forks for every command. What a test starts is this
file as a program, which hands over its arguments, its folder, its environment and its streams, passes on signals, and
ends as the command does. A command ends with the program that asked for it.
"""

import json
import os
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

PASSED_ON = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def server() -> Iterator[list[str]]:
    """Keep one; gives what stands for `python -m`, followed by a module's name and its arguments."""
    import subprocess
    import tempfile

    if sys.platform != "linux":
        yield [sys.executable, "-m"]
        return
    with tempfile.TemporaryDirectory() as folder:  # not pytest's: names of sockets are short
        address = f"{folder}/asked"
        command = [sys.executable, __file__, address]
        null, pipe = subprocess.DEVNULL, subprocess.PIPE
        process = subprocess.Popen(command, stdin=null, stdout=pipe, start_new_session=True)
        assert process.stdout is not None
        try:
            with process.stdout:
                assert process.stdout.readline() == b"ready\n"
                yield [sys.executable, "-S", "-E", __file__, address]
        finally:
            process.kill()
            process.wait()


def program(python_m: list[str], folder: Path) -> Path:
    """The program `sattools`, for a `PATH`; gives the folder."""
    import shlex

    path = folder / "sattools"
    path.write_text(f'#!/bin/sh\nexec {shlex.join([*python_m, "sattools"])} "$@"\n', encoding="utf-8")
    path.chmod(0o755)
    return folder


def serve(address: str) -> None:
    """Import all there is, and fork for everyone who asks."""
    from sattools.cli.forking import import_all
    from sattools.fit.tiles import helper  # noqa: F401  # the module that tiles side by side ask for
    from sattools.system import end_with_parent

    end_with_parent()
    import_all()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        listener.listen()
        os.write(1, b"ready\n")
        while True:
            asking, _ = listener.accept()
            if not os.fork():
                listener.close()
                keep(asking)
            asking.close()
            with suppress(ChildProcessError):
                while os.waitpid(-1, os.WNOHANG)[0]:  # keepers that have ended
                    pass


def keep(asking: socket.socket) -> None:
    """Stay beside a command: it is killed when nobody waits for it any more, and whoever does is told its status."""
    import select

    _, streams, _, _ = socket.recv_fds(asking, 1, 3)
    with asking.makefile("rb") as lines:
        asked = json.loads(lines.readline())
    process = os.fork()
    if not process:
        asking.close()
        become(asked, streams)
        sys.exit()
    for stream in (0, 1, *streams):
        os.close(stream)
    asking.sendall(f"{process}\n".encode())
    ended = os.pidfd_open(process)
    if ended not in select.select([ended, asking], [], [])[0]:
        os.kill(process, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    with suppress(OSError):
        asking.sendall(f"{status}\n".encode())
    os._exit(0)


def become(asked: dict, streams: list[int]) -> None:
    """Be the process that was asked for, as far as it can be told from one that Python has just started."""
    import torch
    from pictures import UNDRAWN, undrawn

    from sattools.system import end_with_parent

    end_with_parent()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    sys.stdin = os.fdopen(0, encoding="utf-8")
    sys.stdout = os.fdopen(1, "w", encoding="utf-8")
    sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace")
    os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    sys.argv[1:] = asked["arguments"]
    with undrawn() if UNDRAWN in os.environ else nullcontext():
        begin(asked["module"])


def begin(module: str) -> None:
    """Do what `python -m` would do."""
    if module == "sattools":
        from sattools.cli import entry

        entry()
    else:
        sys.modules[module].__dict__["main"]()


def ask(address: str, module: str, *arguments: str) -> None:
    """What runs instead of `python -m MODULE ARGUMENTS`."""
    signal.pthread_sigmask(signal.SIG_BLOCK, PASSED_ON)
    with socket.socket(socket.AF_UNIX) as asking:
        asking.connect(address)
        socket.send_fds(asking, [b" "], [0, 1, 2])
        for stream in (0, 1):  # the command's alone: what it closes is closed
            os.close(stream)
        asked = {"module": module, "arguments": arguments, "folder": os.getcwd(), "environment": dict(os.environ)}
        asking.sendall(json.dumps(asked).encode() + b"\n")
        with asking.makefile() as lines:
            process = int(lines.readline())
            for number in PASSED_ON:
                signal.signal(number, lambda number, frame: os.kill(process, number))
            signal.pthread_sigmask(signal.SIG_UNBLOCK, PASSED_ON)
            status = int(lines.readline())
    if status < 0:
        signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    os._exit(status)


if __name__ == "__main__":
    (ask if sys.argv[2:] else serve)(*sys.argv[1:])

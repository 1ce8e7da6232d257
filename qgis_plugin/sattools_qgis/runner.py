# SPDX-License-Identifier: GPL-2.0-or-later
"""Runs the `sattools` executable: environment, progress, cancelling. Knows nothing of QGIS."""

import json
import os
import queue
import re
import shlex
import shutil
import signal
import subprocess
import threading
from contextlib import suppress
from typing import Any

# QGIS brings its own Python, Qt, GDAL and PROJ; a program with other versions of them must not inherit the paths
FOREIGN = ("PYTHON", "__PYVENV", "QT_", "GDAL_", "PROJ_", "LD_", "DYLD_")
ERROR = re.compile(r"(sattools( [a-z]+)?: error|Error): ")
LAST_OF_OURS = 3  # exit code; larger ones are a shell's or the system's
PATIENCE_S = 10.0
POLL_S = 0.1
NEW_GROUP, NO_WINDOW = 0x00000200, 0x08000000  # of Windows; without the second a console opens above QGIS
OWN = (
    "python3 -m venv ~/sattools && ~/sattools/bin/pip install sattools"
    if os.name == "posix"
    else "py -m venv %USERPROFILE%\\sattools, then %USERPROFILE%\\sattools\\Scripts\\pip install sattools"
)
INSTALL = (
    f"found no sattools executable; install it ({OWN}) and "
    "set its path in Settings > Options > Processing > Providers > sattools, or put it on PATH"
)


class CommandFailed(Exception):
    """The command ended with an error; the text is its last line, or how it ended."""


class Cancelled(Exception):
    """The user stopped the command; no process of it is left."""


def find_executable(setting: Any = "") -> Any:
    """Path of the executable: the setting, else the one on PATH; None if there is neither."""
    if setting:
        path = os.path.expanduser(setting)
        return path if os.access(path, os.X_OK) and os.path.isfile(path) else None
    return shutil.which("sattools")


def clean_environment(environment: Any) -> Any:
    """A copy of the environment without the variables of QGIS's own libraries."""
    return {k: v for k, v in environment.items() if not k.startswith(FOREIGN)}


def apart(system: Any = os.name) -> Any:
    """What `subprocess` is told so that a program runs in a group of its own, and on Windows without a console."""
    return {"start_new_session": True} if system == "posix" else {"creationflags": NEW_GROUP | NO_WINDOW}


def as_typed(arguments: Any) -> Any:
    """A command as one line that a shell takes, whatever blanks its paths hold."""
    return shlex.join(arguments) if os.name == "posix" else subprocess.list2cmdline(arguments)


def usage_of(executable: Any) -> Any:
    """The command line's description of itself (`sattools --json-usage`)."""
    try:
        done = subprocess.run(
            [executable, "--json-usage"], check=True, capture_output=True, text=True, timeout=60,
            env=clean_environment(os.environ), **apart(),
        )  # fmt: skip
        found = json.loads(done.stdout)
        int(found["version"].split(".")[0]), found["commands"]
        return found
    except subprocess.CalledProcessError as error:
        said = error.stderr.strip().splitlines() or [f"exit code {error.returncode}"]
        raise CommandFailed(f"{executable}: gives no --json-usage ({said[-1]})") from error
    except (OSError, subprocess.SubprocessError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CommandFailed(f"{executable}: gives no --json-usage ({error})") from error


def run(arguments: Any, on_progress: Any, on_line: Any, is_cancelled: Any) -> Any:
    """Run a command to its end.

    Args:
        arguments: the executable and its arguments, never through a shell.
        on_progress: called with the share done (0 ... 1) and a message.
        on_line: called with every other line of stderr, but for the error that CommandFailed carries.
        is_cancelled: asked several times a second.

    Returns:
        What the command wrote to stdout.

    Raises:
        CommandFailed: exit code other than 0.
        Cancelled: after the whole process group has ended.
    """
    process = subprocess.Popen(
        arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        encoding="utf-8", errors="replace", env=clean_environment(os.environ), **apart(),
    )  # fmt: skip
    lines, output = queue.Queue(), []
    readers = [
        threading.Thread(target=lambda: output.append(process.stdout.read()), daemon=True),
        threading.Thread(target=lambda: [lines.put(line) for line in process.stderr], daemon=True),
    ]
    for reader in readers:
        reader.start()
    last = held = ""
    try:
        while process.poll() is None or readers[1].is_alive() or not lines.empty():
            if is_cancelled():
                raise Cancelled("cancelled")
            try:
                line = lines.get(timeout=POLL_S).rstrip()
            except queue.Empty:
                continue
            record = _progress(line)
            if record is not None:
                on_progress(record[0], record[1])
            elif line:
                if held:
                    on_line(held)
                last, held = line, line if ERROR.match(line) else ""
                if not held:
                    on_line(line)
    finally:
        _end(process)
        for reader, pipe in zip(readers, (process.stdout, process.stderr)):
            reader.join(PATIENCE_S)
            pipe.close()
    if process.returncode:
        raise CommandFailed(held or _why(process.returncode, last))
    if held:
        on_line(held)
    return "".join(output)


def _why(code: Any, last: Any) -> Any:
    """What to say of a program that ended without an error of its own; last: its last line."""
    if code < 0 or code > LAST_OF_OURS:
        # most often for want of memory, of which the program itself can say nothing
        return f"sattools was ended from outside ({_ended(code)}); was there too little memory?"
    return last or f"sattools ended with exit code {code}"


def _ended(code: Any) -> Any:
    if code < 0:  # POSIX
        return f"signal {-code}"
    return f"exit code 0x{code:08X}" if code >= 2**16 else f"exit code {code}"  # Windows: looked up in base 16


def _progress(line: Any) -> Any:
    """(share, message) of a progress line, None for any other."""
    if not line.startswith("{"):
        return None
    try:
        record = json.loads(line)
        return float(record["progress"]), str(record.get("message", ""))
    except (ValueError, KeyError, TypeError):
        return None


def _end(process: Any, system: Any = os.name) -> None:
    """Make sure that nothing of the command is left."""
    if process.poll() is not None:
        return
    if system != "posix":
        # there the executable is a launcher, and what it started would go on without it
        with suppress(OSError):
            subprocess.run(["taskkill", "/F", "/T", "/PID", str(process.pid)], capture_output=True, **apart(system))
        process.terminate()
        process.wait(PATIENCE_S)
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, number)
            process.wait(PATIENCE_S)
            return
        except ProcessLookupError:
            return
        except subprocess.TimeoutExpired:
            continue

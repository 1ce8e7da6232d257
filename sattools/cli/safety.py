"""What stands between the user and a traceback: the last resort for everything that no command has foreseen."""

from __future__ import annotations

import errno
import logging
import os
import re
import sys
import traceback
from contextlib import suppress
from typing import Any

import click

from sattools.cli import interrupts
from sattools.cli.commands import COMMANDS
from sattools.cli.logfile import LogFile, PlainFormatter
from sattools.errors import SattoolsError, printable

LONGEST_ARGUMENT = 100_000
_LONG = re.compile(r"(\S{160})\S{200,}(\S{30})")  # a name that nobody would read to its end
_ALLOCATION = re.compile(r"can't allocate memory|CUDA out of memory")  # torch's words in a RuntimeError


class LastResort(click.Group):
    """A group whose commands end with one line on stderr and a status, whatever happens."""

    running = ""

    def main(self, args: Any = None, prog_name: str | None = None, *rest: Any, **extra: Any) -> Any:
        """See `click.Group.main`. The traceback of an unexpected error is shown with -vv only."""
        if not extra.get("standalone_mode", True):
            return super().main(args, prog_name, *rest, **extra)
        given = list(sys.argv[1:] if args is None else args)
        self.running = next((name for name in given if name in COMMANDS), "")  # until the arguments are understood
        try:
            try:
                _check_arguments(given)
                super().main(given, prog_name, *rest, **extra)
            except SystemExit:
                sys.stdout.flush()  # here, where a full disk can still be told
                raise
        except SystemExit:
            raise
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt) or interrupts.status():
                sys.exit(interrupts.status() or 130)
            sys.exit(self.failed(error))
        return None

    def failed(self, error: BaseException) -> int:
        """Say what went wrong; the status to end with."""
        name = f"sattools {self.running}".strip()
        if isinstance(error, OSError) and _is_stdout(error):
            quiet_stdout()
            if error.errno != errno.EPIPE:  # nobody reads any more: stop quietly
                complain(f"sattools: error: stdout: cannot be written ({error.strerror})")
            return 1
        logging.getLogger("sattools.run").debug("traceback of what follows", exc_info=error)
        if screen_level() == logging.DEBUG or os.environ.get("SATTOOLS_DEBUG"):
            traceback.print_exception(error, file=sys.stderr)
        complain(f"{name}: error: {explain(error)}")
        return 2 if isinstance(error, click.UsageError) else 1


def explain(error: BaseException) -> str:
    """An unexpected error in one line."""
    if isinstance(error, SattoolsError):
        return str(error)
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _ALLOCATION.search(str(error))):
        return f"found too little memory ({_short(error) or 'all is taken'}), expected a smaller area or coarser cells"
    if isinstance(error, OSError) and error.strerror:
        where = f"{_name(error.filename)}: " if error.filename is not None else ""
        return f"{where}found {error.strerror}, expected a file or folder that can be used"
    return f"internal error ({type(error).__name__}: {_short(error)}); run with -vv for the traceback"


def _check_arguments(arguments: list[str]) -> None:
    """Refuse what is no text: names that are not UTF-8 cannot be written into a document."""
    for argument in arguments:
        shown = _name(argument)
        if len(argument) > LONGEST_ARGUMENT:
            raise SattoolsError(f"{shown}: found an argument of {len(argument)} characters, expected a shorter one")
        try:
            argument.encode()
        except UnicodeEncodeError:
            problem = "found a name that is not UTF-8, expected one (rename the file)"
            if _is_utf_8(os.fsencode(argument)):
                problem = f"found a name that {sys.getfilesystemencoding()} cannot read, expected UTF-8 (PYTHONUTF8=1)"
            raise SattoolsError(f"{shown}: {problem}") from None


def _is_utf_8(name: bytes) -> bool:
    try:
        name.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def check_folder() -> None:
    """Raise SattoolsError where the folder that relative paths begin in has been deleted."""
    try:
        os.getcwd()
    except OSError:
        raise SattoolsError("found no working folder (it was deleted), expected to be started in one") from None


class Stderr(logging.Handler):
    """Messages on stderr, whatever that is when they come: a program may call the suite again with another one."""

    screen_level = logging.NOTSET

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`; nobody reading is no reason to stop."""
        if record.name.partition(".")[0] == "sattools" and record.levelno < self.screen_level:
            return
        with suppress(OSError, ValueError, AttributeError):
            print(self.format(record).encode(errors="backslashreplace").decode(), file=sys.stderr, flush=True)


def configure_handler() -> None:
    """Have messages of all libraries on stderr, once."""
    root = logging.getLogger()
    if not any(isinstance(handler, Stderr) for handler in root.handlers):
        handler = Stderr()
        handler.setFormatter(PlainFormatter("sattools: %(message)s"))
        root.addHandler(handler)


def set_screen_level(level: int) -> None:
    """What of our own messages is shown on stderr; those of other libraries follow their own levels."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, Stderr):
            handler.screen_level = level


def screen_level() -> int:
    """See `set_screen_level`."""
    levels = [handler.screen_level for handler in logging.getLogger().handlers if isinstance(handler, Stderr)]
    return levels[0] if levels else logging.getLogger("sattools").level


def complain(line: str) -> None:
    """One line on stderr, without what could steer a terminal, if anybody is there to read it."""
    text = printable(" ".join(_LONG.sub(r"\1...\2", line).split()))
    _to_log(text)
    with suppress(OSError, ValueError):
        click.echo(text.encode(errors="backslashreplace").decode(), err=True)


def _to_log(text: str) -> None:
    """What goes to the screen by another way, for the log file alone."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, LogFile):
            handler.handle(logging.LogRecord("sattools.run", logging.ERROR, "", 0, text, None, None))


def quiet_stdout() -> None:
    """Keep Python from complaining once more when it flushes stdout at exit."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _is_stdout(error: OSError) -> bool:
    """A write to stdout failed: it has no file name, as those of all files have."""
    return error.filename is None and error.errno in (errno.EPIPE, errno.ENOSPC, errno.EIO, errno.EBADF)


def _name(value: object) -> str:
    text = os.fsdecode(value) if isinstance(value, bytes) else str(value)
    text = text.encode(errors="backslashreplace").decode()
    return text if len(text) <= 200 else text[:160] + "..." + text[-30:]


def _short(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 300 else text[:300] + "..."


__all__ = [
    "LastResort",
    "PlainFormatter",
    "check_folder",
    "complain",
    "configure_handler",
    "quiet_stdout",
    "set_screen_level",
]

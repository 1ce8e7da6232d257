"""stdin, stdout and stderr as every command may take them for granted: open, and of any encoding."""

from __future__ import annotations

import codecs
import io
import os
import sys

ESCAPES = "sattools.escapes"  # error handler: what an encoding lacks as JSON writes it, which people can read, too


def _escaped(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    units = error.object[error.start : error.end].encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[k : k + 2].hex()}" for k in range(0, len(units), 2)), error.end


codecs.register_error(ESCAPES, _escaped)


def prepare_streams() -> None:
    """Put the null device in the place of streams that the program was started without, and let none refuse a letter.

    Else the next file that is opened would get the number of the stream, and with it what libraries print.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # it gets the lowest number that is free
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors=ESCAPES)
    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr.reconfigure(errors="backslashreplace")


def portable(line: str) -> str:
    """A line for stdout; a document in ASCII where stdout is not in UTF-8, as which JSON is read everywhere."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    if not line.startswith("{") or codecs.lookup(encoding).name == "utf-8":
        return line
    return line.encode("ascii", ESCAPES).decode("ascii")


__all__ = ["ESCAPES", "portable", "prepare_streams"]

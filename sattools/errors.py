"""The exceptions of sattools: one root, so that callers can catch everything the suite raises on purpose.

Every message is one line that names the file, what was found and what was expected.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from types import ModuleType


def printable(text: str) -> str:
    """The text with its control characters written out, so that no file's content can steer a terminal."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def some_of(names: Sequence[str]) -> str:
    """Names in a line that stays short: the first three, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def counted(count: int, noun: str) -> str:
    """A number of things in words.

    Args:
        count: how many.
        noun: what they are, in the plural, which is the singular and an s.
    """
    return f"{count} {noun[:-1] if count == 1 else noun}"


class SattoolsError(Exception):
    """Root of all errors that sattools raises on purpose."""


class InputError(SattoolsError, ValueError):
    """An input file or value cannot be used."""


class SceneError(SattoolsError, ValueError):
    """A scene document is malformed or does not hold what a command needs."""


class MissingProductError(SceneError):
    """A scene has not been through a command that must come before; in a pipe of dry runs it never has."""


class OutputExistsError(SattoolsError, FileExistsError):
    """An output is already there and overwriting was not asked for."""


class OutputIsInputError(SattoolsError, ValueError):
    """A command was about to write onto a file that it reads; it never does, whatever it is told."""


class StaleError(SceneError):
    """A product was made from something that has changed since."""


def extra(module: str, name: str) -> ModuleType:
    """A library of an extra.

    Args:
        module: to import.
        name: of the extra that brings it.

    Raises:
        SattoolsError: it is not installed; says what to do.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise SattoolsError(f"found no {library}, expected the extra: pip install 'sattools[{name}]'") from error

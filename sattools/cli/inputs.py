"""What is known of a command's options alone, files and folders that they name above all: asked before it waits."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass
from typing import Any

from sattools.errors import InputError
from sattools.settings import specs

log = logging.getLogger(__name__)


def check_inputs(options: Any) -> None:
    """Raise InputError where a file or folder that an option names is not there, before any work and in a dry run.

    Those on other machines and in archives are looked for when they are read.

    Args:
        options: of a command, a dataclass, or None.
    """
    for name, error in _missing(options):
        raise InputError(f"{name}: {error}")


def check_inputs_before_waiting(options: Any, scenes: Sequence[str], ahead: Callable[[], None] | None = None) -> None:
    """The same before the scenes are asked for: those of a pipe come when what is before it has done hours of work.

    What would lie in a folder that is not there either may be what a command before it on the pipe makes; a warning
    has to do for that.

    Args:
        options: as of `check_inputs`.
        scenes: paths of documents; empty or ``-`` = stdin.
        ahead: raises what else is in the way, whatever a scene of a pipe will hold; may read the files that options
            name, and is not asked before all of them are on this machine.
    """
    from sattools.scene.location import is_remote

    piped = not scenes or "-" in scenes
    complete = not any(is_remote(name) for name, _, _ in _named(options))
    for name, error in _missing(options):
        if not piped or os.path.isdir(os.path.dirname(name) or "."):
            raise InputError(f"{name}: {error}")
        log.warning("%s: %s by the time that the scene arrives", name, error)
        complete = False
    if piped and complete and ahead:
        ahead()


def _missing(options: Any) -> Iterator[tuple[str, str]]:
    """Names that options give and nothing has, each with what is said of it."""
    from sattools.scene.location import is_remote

    for name, kind, option in _named(options):
        if not (is_remote(name) or os.path.exists(name)):
            yield name, f"no such {kind}, expected one for {option}"


def _named(options: Any) -> Iterator[tuple[str, str, str]]:
    """What options name that has to be there: its name, file or folder, and the option."""
    for spec in specs(type(options)) if is_dataclass(options) else ():
        value = getattr(options, spec.name)
        option = f"--{spec.name.replace('_', '-')}"
        for text in value if isinstance(value, list) else [value] if value else []:
            if spec.path == "NAME=FILE":
                name, _, file = text.partition("=")
                yield file, "file", f"{option} {name}"
            elif spec.path in ("file", "folder"):
                yield text, spec.path, option


__all__ = ["check_inputs", "check_inputs_before_waiting"]

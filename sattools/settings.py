"""Options of a stage as a dataclass whose fields carry their own help, choices and limits.

The command line, `--print-config`, the scene's history and the QGIS plugin all read these fields, so an option is
described in one place only.
"""

from __future__ import annotations

import dataclasses
import logging
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass
from typing import Any, Literal

log = logging.getLogger(__name__)
LARGEST = 1e12  # of a number in an option: no length, weight or time of the suite is larger, and its square is finite
LARGEST_COUNT = 10**9


def option(
    default: Any,
    help: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    renamed: Mapping[str, str] | None = None,
    path: Literal["file", "folder", "new folder", "NAME=FILE"] | None = None,
) -> Any:
    """A dataclass field with its help text, unit included, and inclusive limits.

    Args:
        default: value of the field.
        help: text for the command's help.
        minimum: smallest number allowed.
        maximum: largest number allowed.
        renamed: former names of choices -> present ones; the command line still takes them, with a warning.
        path: what the text names, for shells that complete it; a file or folder has to be there, a new one not.
    """
    metadata = {"help": help, "minimum": minimum, "maximum": maximum, "renamed": dict(renamed or {}), "path": path}
    if isinstance(default, list | dict):
        return dataclasses.field(default_factory=lambda: type(default)(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class OptionSpec:
    """One option, resolved from a dataclass field.

    Attributes:
        name: field name.
        kind: `bool`, `int`, `float` or `str`.
        choices: allowed values, or None.
        optional: None is allowed.
        multiple: the field is a list.
        default: default value.
        help: help text.
        minimum, maximum: inclusive limits, or None.
        count: how many values it takes at once.
        renamed: former names of choices.
        words: what a number may be instead, such as ``auto``.
        path: ``file``, ``folder``, ``new folder`` (it need not be there) or ``NAME=FILE`` where the text names one.

    Numbers are finite, and no larger than `LARGEST` where nothing else is said.
    """

    name: str
    kind: type
    choices: tuple[str, ...] | None
    optional: bool
    multiple: bool
    default: Any
    help: str
    minimum: float | None
    maximum: float | None
    count: int = 1
    renamed: Mapping[str, str] = dataclasses.field(default_factory=dict)
    words: tuple[str, ...] = ()
    path: str | None = None


def specs(cls: type, *, every: bool = False) -> list[OptionSpec]:
    """The options of a dataclass, in order.

    Args:
        cls: the dataclass.
        every: also fields without help, which the command line has in a way of its own.
    """
    hints = typing.get_type_hints(cls)
    options = []
    for item in dataclasses.fields(cls):
        if "help" not in item.metadata and not every:
            continue
        hint = hints[item.name]
        kind, choices, optional, multiple = _resolve(hint)
        default = item.default_factory() if item.default_factory is not MISSING else item.default
        options.append(
            OptionSpec(
                item.name,
                kind,
                choices,
                optional,
                multiple,
                default,
                item.metadata.get("help", ""),
                item.metadata.get("minimum"),
                item.metadata.get("maximum"),
                _count(hint),
                item.metadata.get("renamed", {}),
                _words(hint, kind),
                item.metadata.get("path"),
            )
        )
    return options


def _words(hint: Any, kind: type) -> tuple[str, ...]:
    """Texts that stand beside numbers, as in `float | Literal["auto"] | None`."""
    if kind not in (int, float):
        return ()
    parts = [part for part in typing.get_args(hint) if typing.get_origin(part) is typing.Literal]
    return tuple(word for part in parts for word in typing.get_args(part))


def _count(hint: Any) -> int:
    """2 for `tuple[float, float]`, also where None is allowed."""
    for part in (hint, *typing.get_args(hint)):
        if typing.get_origin(part) is tuple:
            return len(typing.get_args(part))
    return 1


def _resolve(hint: Any) -> tuple[type, tuple[str, ...] | None, bool, bool]:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        inner = [a for a in typing.get_args(hint) if a is not type(None)]
        kind, choices, _, multiple = _resolve(inner[0])
        return kind, choices, True, multiple
    if origin is list:
        kind, choices, _, _ = _resolve(typing.get_args(hint)[0])
        return kind, choices, False, True
    if origin is tuple:
        return typing.get_args(hint)[0], None, False, False
    if origin is typing.Literal:
        return str, tuple(typing.get_args(hint)), False, False
    return hint, None, False, False


def tell_without_effect(idle: Iterable[tuple[str, str]]) -> None:
    """One line for each option that was given and does nothing beside the others.

    Args:
        idle: names of fields, each with what was found and expected.
    """
    for name, why in idle:
        log.warning("--%s does nothing here: %s", name.replace("_", "-"), why)


def as_dict(options: Any) -> dict[str, Any]:
    """Resolved options as plain types."""
    return dataclasses.asdict(options)


__all__ = ["LARGEST", "LARGEST_COUNT", "OptionSpec", "as_dict", "option", "specs", "tell_without_effect"]

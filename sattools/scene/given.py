"""Options as a program gives them: values of Python and numpy of any make, as their dataclasses have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any, TypeVar

from sattools.errors import InputError
from sattools.scene.schema import Flag, Items, Kind, Maybe, Number, Text, meant
from sattools.settings import LARGEST, LARGEST_COUNT, OptionSpec, specs

T = TypeVar("T")


def options_of(cls: type[T], given: T | Mapping[str, Any] | None) -> T:
    """The options of a stage.

    Args:
        cls: their dataclass.
        given: one of it, or options by name; None = the defaults.

    Raises:
        InputError: a name that it does not have, or a value that it does not take.
    """
    if given is None:
        return cls()
    known = {spec.name: spec for spec in specs(cls, every=True)}
    if not isinstance(given, Mapping):
        if not isinstance(given, cls):
            raise InputError(f"found {type(given).__name__}, expected {cls.__name__} or a dict of its options")
        own = _checked(cls, known, {name: getattr(given, name) for name in known})
        return replace(given, **own)  # type: ignore[type-var]
    unknown = sorted(set(given) - known.keys(), key=str)
    if unknown:
        names = sorted(known)
        hint = meant(unknown[0], names)
        raise InputError(f"{cls.__name__}: found option {unknown[0]!r}, expected some of {', '.join(names)}{hint}")
    return cls(**_checked(cls, known, given))


def flag_of(given: Any, name: str) -> bool:
    """True or false, Python's or numpy's.

    Args:
        given: by a program.
        name: what it is called there.

    Raises:
        InputError: it is neither; a text such as "no" would count as true.
    """
    value = _plain(given)
    Flag().check(value, name)
    return bool(value)


def _checked(cls: type, known: Mapping[str, OptionSpec], given: Mapping[str, Any]) -> dict[str, Any]:
    """Values of options as their dataclass has them. Raises InputError for one that an option does not take."""
    values = {}
    for name, value in given.items():
        spec, value = known[name], _as_given(known[name], _plain(value))
        _kind(spec).check(value, f"{cls.__name__}: option {name!r}")
        values[name] = (list(value) if spec.multiple else tuple(value)) if isinstance(value, list | tuple) else value
    return values


def _as_given(spec: OptionSpec, value: Any) -> Any:
    """A value as the command line, which knows texts alone, would have made it of one."""
    if spec.kind is str:
        # what is a number in Python is text there, such as a scale or a band; a text, an option that is given once
        if spec.multiple and isinstance(value, list | tuple):
            return [_text(member) for member in value]
        value = _text(value)
        return [value] if spec.multiple and isinstance(value, str) else value
    if spec.kind is int and isinstance(value, list | tuple):
        return [_whole(member) for member in value]
    return _whole(value) if spec.kind is int else value


def _text(value: Any) -> Any:
    return str(value) if type(value) in (int, float) else value


def _whole(value: Any) -> Any:
    """A number such as 3.0 as the integer that it is."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _plain(value: Any) -> Any:
    """A value as the command line would have it: paths as text, numbers and arrays of numpy as Python's."""
    if isinstance(value, PathLike):
        return str(value)
    if isinstance(value, list | tuple):
        return [_plain(member) for member in value]
    return value.tolist() if hasattr(value, "tolist") else value


def _kind(spec: OptionSpec) -> Kind:
    """What an option takes, as `kind_of` of the command line has it."""
    low, high = spec.minimum, spec.maximum
    kind: Kind = Text(tuple(spec.choices or ()), empty=spec.path is None)
    if spec.kind is bool:
        kind = Flag()
    elif spec.kind is int:
        low = -LARGEST_COUNT if low is None else low
        kind = Number(low, LARGEST_COUNT if high is None else high, whole=True)
    elif spec.kind is float:
        kind = Number(-LARGEST if low is None else low, LARGEST if high is None else high)
    if spec.words:
        kind = _Or(kind, spec.words)
    if spec.multiple or spec.count > 1:
        kind = Items(kind, spec.count, spec.count) if spec.count > 1 else Items(kind)
    return Maybe(kind) if spec.optional or spec.default is None else kind


@dataclass(frozen=True)
class _Or:
    """A value of a kind, or one of some words."""

    kind: Kind
    words: tuple[str, ...]

    def check(self, value: Any, where: str) -> None:
        """See `Kind`."""
        if value not in self.words:
            self.kind.check(value, where)


__all__ = ["flag_of", "options_of"]

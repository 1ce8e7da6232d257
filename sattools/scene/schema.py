"""A small declarative schema: what a document may hold, said once, and checked with a message that names the place.

JSON Schema would need a library for a tenth of what is used here, and its messages name neither what was meant nor what
was found in words.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from sattools.errors import InputError, counted


class Kind(Protocol):
    """What a value may be."""

    def check(self, value: Any, where: str) -> None:
        """Raise InputError, naming `where`, when the value is something else."""


@dataclass(frozen=True)
class Number:
    """A finite number within inclusive limits."""

    minimum: float = -math.inf
    maximum: float = math.inf
    whole: bool = False
    unit: str = ""

    def check(self, value: Any, where: str) -> None:
        """See `Kind`."""
        right = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if right and self.whole:
            right = float(value).is_integer()
        if not right or not self.minimum <= value <= self.maximum:
            raise InputError(f"{where}: found {shown(value)}, expected {self}")

    def __str__(self) -> str:
        kind = "a whole number" if self.whole else "a finite number"
        low, high = self.minimum, self.maximum
        if math.isfinite(low) and math.isfinite(high):
            kind += f" from {low:g} to {high:g}"
        elif math.isfinite(low):
            kind += f" of at least {low:g}"
        return kind + (f" {self.unit}" if self.unit else "")


@dataclass(frozen=True)
class NumberText:
    """A number, or text that is one, as in vendors' metadata; no text at all where it is not known."""

    def check(self, value: Any, where: str) -> None:
        """See `Kind`."""
        if isinstance(value, str) and not value.strip():
            return
        try:
            right = not isinstance(value, bool | list | Mapping) and math.isfinite(float(value))
        except (TypeError, ValueError, OverflowError):
            right = False
        if not right:
            raise InputError(f"{where}: found {shown(value)}, expected a finite number")


@dataclass(frozen=True)
class Text:
    """Text, not empty; one of `choices` where there are some."""

    choices: tuple[str, ...] = ()
    empty: bool = False
    longest: int = 4096

    def check(self, value: Any, where: str) -> None:
        """See `Kind`."""
        if self.choices and value not in self.choices:
            options = ", ".join(self.choices)
            raise InputError(f"{where}: found {shown(value)}, expected {options}{meant(value, self.choices)}")
        if not isinstance(value, str) or (not value and not self.empty):
            some = " that is not empty" if value == "" else ""
            raise InputError(f"{where}: found {shown(value)}, expected text{some}")
        if "\0" in value or len(value) > self.longest:
            raise InputError(f"{where}: found {shown(value)}, expected at most {self.longest} characters without NUL")


@dataclass(frozen=True)
class Flag:
    """True or false."""

    def check(self, value: Any, where: str) -> None:
        """See `Kind`."""
        if not isinstance(value, bool):
            raise InputError(f"{where}: found {shown(value)}, expected true or false")


@dataclass(frozen=True)
class Anything:
    """Whatever it is."""

    def check(self, value: Any, where: str) -> None:
        """See `Kind`."""


@dataclass(frozen=True)
class Maybe:
    """A value of a kind, or null."""

    kind: Kind

    def check(self, value: Any, where: str) -> None:
        """See `Kind`."""
        if value is not None:
            self.kind.check(value, where)


@dataclass(frozen=True)
class Items:
    """A list whose members are of one kind; `shortest` and `longest` limit its length."""

    kind: Kind
    shortest: int = 0
    longest: int = 1_000_000

    def check(self, value: Any, where: str) -> None:
        """See `Kind`."""
        if not isinstance(value, list | tuple) or not self.shortest <= len(value) <= self.longest:
            few = f"{self.shortest}" if self.shortest == self.longest else f"{self.shortest} to {self.longest}"
            expected = (
                f"a list of {few} {'value' if few == '1' else 'values'}" if self.longest < 1_000_000 else "a list"
            )
            raise InputError(f"{where}: found {shown(value)}, expected {expected}")
        for k, member in enumerate(value):
            self.kind.check(member, f"{where}[{k}]")


@dataclass(frozen=True)
class Table:
    """An object: the kinds of its known members, which of them it needs, and what other members may be.

    `other` None = there are no others: an unknown name is refused with the one that was perhaps meant.
    """

    members: Mapping[str, Kind] = field(default_factory=dict)
    needs: tuple[str, ...] = ()
    other: Kind | None = field(default_factory=Anything)

    def check(self, value: Any, where: str) -> None:
        """See `Kind`."""
        if not isinstance(value, Mapping):
            raise InputError(f"{where}: found {shown(value)}, expected an object")
        for name in self.needs:
            if name not in value:
                raise InputError(f"{where}: found no {name!r}, expected {', '.join(self.needs)}")
        for name, member in value.items():
            kind = self.members.get(name, self.other)
            if kind is None:
                raise InputError(
                    f"{where}: found an unknown member {shown(name)}, expected {', '.join(self.members)}"
                    f"{meant(name, self.members)}"
                )
            if not isinstance(kind, Anything):
                kind.check(member, f"{where}.{name}" if where else str(name))


def shown(value: Any) -> str:
    """A value in at most some forty characters, whatever it is."""
    if isinstance(value, Mapping):
        return "an object" if value else "an empty object"
    if isinstance(value, list | tuple) and len(value) > 8:
        return f"a list of {len(value)} values"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        text = "[" + ", ".join(shown(member) for member in value) + "]"
        return text if len(text) <= 60 else f"a list of {counted(len(value), 'values')}"
    if isinstance(value, int | float):
        return f"{value:g}" if isinstance(value, float) else str(value)[:40]
    text = repr(value)
    return text if len(text) <= 40 else text[:36] + "...'"


def meant(found: Any, known: Iterable[str], closeness: float = 0.6) -> str:
    """` (did you mean 'x'?)` where a known name is close to the one found, else nothing.

    Args:
        found: in a document.
        known: names.
        closeness: in [0, 1] from which it is meant.
    """
    names = {str(name).lower(): name for name in known}
    close = difflib.get_close_matches(str(found)[:100].lower(), list(names), 1, closeness)
    return f" (did you mean {names[close[0]]!r}?)" if close else ""


__all__ = ["Anything", "Flag", "Items", "Kind", "Maybe", "Number", "NumberText", "Table", "Text", "meant", "shown"]

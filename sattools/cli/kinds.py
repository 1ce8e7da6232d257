"""What values options take: click's types, but with finite numbers only, and nothing silently turned into another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import click
from click.shell_completion import CompletionItem

from sattools.errors import InputError
from sattools.settings import LARGEST, LARGEST_COUNT, OptionSpec

UNNAMED = "found an empty text, expected a file or folder."  # of a variable that is not set, as a rule


class Finite(click.FloatRange):
    """A finite number within limits: NaN passes every comparison that asks whether it lies outside."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType.convert`."""
        if isinstance(value, str) and "," in value and param is not None and param.nargs > 1:
            self.fail(f"found {value[:40]!r}, expected {param.nargs} numbers with blanks between them.", param, ctx)
        number = float(click.FLOAT.convert(value, param, ctx))
        if not abs(number) <= LARGEST:  # neither NaN nor infinity is
            self.fail(f"found {str(value)[:40]}, expected a finite number of at most {LARGEST:g}.", param, ctx)
        return super().convert(number, param, ctx)

    def _describe_range(self) -> str:
        return super()._describe_range() if self.min is not None or self.max is not None else ""


class FiniteOr(Finite):
    """A finite number within limits, or one of some words."""

    name = "number or word"

    def __init__(self, words: Sequence[str], low: float | None, high: float | None) -> None:
        super().__init__(min=low, max=high)
        self.words = tuple(words)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType.convert`."""
        return value if value in self.words else super().convert(value, param, ctx)

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """See `click.ParamType.get_metavar`."""
        return "|".join(("FLOAT", *self.words))


class Whole(click.IntRange):
    """A whole number within limits; 1.7 of a configuration file is none."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType.convert`."""
        if isinstance(value, str) and len(value) > 40:  # Python refuses to read some thousand digits
            self.fail(f"found a number of {len(value)} digits, expected a smaller one.", param, ctx)
        number = super().convert(value, param, ctx)
        if abs(number) > LARGEST_COUNT:
            self.fail(f"found {number}, expected at most {LARGEST_COUNT}.", param, ctx)
        return number

    def _describe_range(self) -> str:
        return super()._describe_range() if self.min is not None or self.max is not None else ""


class Renamed(click.Choice):
    """A choice of which some values had other names; these still work, and stderr says so."""

    def __init__(self, choices: Sequence[str], renamed: Mapping[str, str]) -> None:
        super().__init__(choices)
        self.renamed = renamed

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType.convert`."""
        if value in self.renamed:
            name = param.opts[0] if param else "value"
            click.echo(f"Warning: {name} {value} is now called {name} {self.renamed[value]}.", err=True)
            value = self.renamed[value]
        return super().convert(value, param, ctx)


class PathText(click.ParamType):
    """Text that names a file or folder, or an address: taken as it is, and completed by shells."""

    name = "text"

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType.convert`."""
        return value or self.fail(UNNAMED, param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType.shell_complete`: the shell itself lists files or folders, but not after NAME=."""
        if self.kind == "NAME=FILE":
            return []
        return [CompletionItem(incomplete, type="dir" if self.kind.endswith("folder") else "file")]


class NamedPath(click.Path):
    """A file or folder that has a name: without one it would be the current folder, or pass for not given."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType.convert`."""
        return self.fail(UNNAMED, param, ctx) if value == "" else super().convert(value, param, ctx)


def kind_of(spec: OptionSpec) -> Any:
    """Click's type of an option; None where click finds it by itself."""
    if spec.choices:
        return Renamed(spec.choices, spec.renamed) if spec.renamed else click.Choice(spec.choices)
    if spec.words:
        return FiniteOr(spec.words, spec.minimum, spec.maximum)
    if spec.kind is float:
        return Finite(min=spec.minimum, max=spec.maximum)
    if spec.kind is int:
        low, high = (None if limit is None else int(limit) for limit in (spec.minimum, spec.maximum))
        return Whole(min=low, max=high)
    if spec.path:
        return PathText(spec.path)
    return None if spec.kind is bool else spec.kind


def check_value(option: click.Option, value: Any) -> None:
    """Raise InputError where a value of a configuration file is of another type than its option."""
    from sattools.scene.schema import Flag, Items, Maybe, Number, Text

    kind: Any = Text(empty=True)
    if option.is_flag or isinstance(option.type, click.types.BoolParamType):
        kind = Flag()
    if isinstance(option.type, click.types.IntParamType):
        kind = Number(whole=True)
    elif isinstance(option.type, click.types.FloatParamType):
        kind = Number()
    if isinstance(option.type, FiniteOr) and value in option.type.words:
        return
    several = option.multiple or option.nargs != 1
    if isinstance(option.type, click.types.StringParamType):  # a scale or a band, which is text on the command line
        value = [_text(member) for member in value] if several and isinstance(value, list) else _text(value)
    try:
        many = Items(kind, option.nargs, option.nargs) if option.nargs > 1 else Items(kind)
        Maybe(many if several else kind).check(value, "value")
    except InputError as error:
        raise InputError(str(error).removeprefix("value: ")) from None


def _text(value: Any) -> Any:
    return str(value) if type(value) in (int, float) else value


__all__ = ["Finite", "FiniteOr", "NamedPath", "PathText", "Renamed", "Whole", "check_value", "kind_of"]

"""Options shared by the commands, each defined once."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from sattools.settings import OptionSpec, as_dict, specs

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


def scene_argument(command: F) -> F:
    """Where the scene documents come from: stdin (`-`, the default) or files."""
    return click.argument("scenes", nargs=-1, type=click.Path(path_type=str), metavar="[SCENE]...")(command)


def common_options(command: F) -> F:
    """`--overwrite`, `--dry-run`, `--config`, `--print-config`."""
    for decorate in (
        click.option("--print-config", is_flag=True, help="Print the resolved options as TOML and stop."),
        click.option("--dry-run", is_flag=True, help="Say on stderr what would be done, do nothing."),
        click.option("--overwrite", is_flag=True, help="Replace existing outputs."),
        click.option(
            "--config",
            type=click.Path(dir_okay=False),
            callback=_load_config,
            is_eager=True,
            expose_value=False,
            help="TOML file with options; a table named like the command, or options at the top level.",
        ),
    ):
        command = decorate(command)
    return command


def dataclass_options(cls: type) -> Callable[[F], F]:
    """Add one option per field of an options dataclass (see `sattools.settings`)."""

    def decorate(command: F) -> F:
        for spec in reversed(specs(cls)):
            command = _click_option(spec)(command)
        return command

    return decorate


def build(cls: type[T], values: dict[str, Any]) -> T:
    """The options dataclass from click's keyword arguments (lists come as tuples)."""
    fields = {spec.name: spec for spec in specs(cls)}
    return cls(**{k: list(v) if fields[k].multiple else v for k, v in values.items() if k in fields})


def print_config(command: str, options: Any) -> None:
    """Write the resolved options as a TOML table; unset options are left out, as TOML has no null."""
    import tomli_w

    table = {k.replace("_", "-"): v for k, v in as_dict(options).items() if v is not None}
    click.echo(tomli_w.dumps({command: table}), nl=False)


def _click_option(spec: OptionSpec) -> Callable[[F], F]:
    name = spec.name.replace("_", "-")
    kind: Any = spec.kind
    if spec.choices:
        kind = click.Choice(spec.choices)
    elif spec.kind in (int, float) and (spec.minimum is not None or spec.maximum is not None):
        kind = _range(spec)
    declaration = f"--{name}/--no-{name}" if spec.kind is bool else f"--{name}"
    show = spec.default is not None and spec.default != []
    return click.option(
        declaration,
        spec.name,
        type=None if spec.kind is bool else kind,
        default=spec.default,
        multiple=spec.multiple,
        nargs=spec.count,
        show_default=show,
        help=spec.help,
    )


def _range(spec: OptionSpec) -> click.IntRange | click.FloatRange:
    if spec.kind is float:
        return click.FloatRange(min=spec.minimum, max=spec.maximum)
    low, high = (None if limit is None else int(limit) for limit in (spec.minimum, spec.maximum))
    return click.IntRange(min=low, max=high)


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file's content; an unreadable one is wrong usage of --config."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise click.BadParameter(f"{path}: cannot be read ({error.strerror})", param_hint="--config") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise click.BadParameter(f"{path}: found no valid TOML ({error})", param_hint="--config") from error


def _load_config(ctx: click.Context, parameter: click.Parameter, value: str | None) -> None:
    if value is None:
        return
    data = read_toml(Path(value))
    command = ctx.info_name or ""
    table = data.get(command, {k: v for k, v in data.items() if not isinstance(v, dict)})
    known = {p.name for p in ctx.command.params}
    resolved = {k.replace("-", "_"): v for k, v in table.items()}
    unknown = sorted(set(resolved) - known)
    if unknown:
        raise click.BadParameter(f"{value}: found option {unknown[0]!r}, which `sattools {command}` does not have")
    ctx.default_map = {**(ctx.default_map or {}), **resolved}


__all__ = ["build", "common_options", "dataclass_options", "print_config", "read_toml", "scene_argument"]

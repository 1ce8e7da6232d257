"""Options shared by the commands, each defined once."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click

from sattools.cli.commands import COMMANDS
from sattools.cli.kinds import Finite, NamedPath, check_value, kind_of
from sattools.errors import InputError, SattoolsError
from sattools.settings import OptionSpec, as_dict, specs

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")
WHOLE_DOCUMENT = "sattools.json"  # of click's `meta`: print scene documents on terminals too


def scene_argument(command: F) -> F:
    """Where the scene documents come from: stdin (`-`, the default) or files."""
    return click.argument("scenes", nargs=-1, type=NamedPath(path_type=str), metavar="[SCENE]...")(command)


def common_options(command: F) -> F:
    """`--overwrite`, `--json`, `--dry-run`, `--config`, `--print-config`."""
    for decorate in (
        click.option("--print-config", is_flag=True, help="Print the resolved options as TOML and stop."),
        click.option("--dry-run", is_flag=True, help="Say on stderr what would be done, do nothing."),
        click.option("--overwrite", is_flag=True, help="Replace existing outputs."),
        click.option(
            "--json",
            is_flag=True,
            expose_value=False,
            callback=lambda ctx, parameter, value: ctx.meta.update({WHOLE_DOCUMENT: value}),
            help="Print the whole scene document on a terminal too, where there is a summary otherwise.",
        ),
        click.option(
            "--config",
            type=NamedPath(dir_okay=False),
            callback=_load_config,
            is_eager=True,
            expose_value=False,
            help="TOML file with options; a table named like the command, or options at the top level.",
        ),
    ):
        command = decorate(command)
    return command


def run_options() -> list[click.Option]:
    """How the program runs, not what comes out: accepted before the command and after it."""
    return [
        click.Option(["-v", "--verbose"], count=True, help="Say more on stderr (twice: debugging)."),
        click.Option(["-q", "--quiet"], is_flag=True, help="Say only errors on stderr."),
        click.Option(
            ["--progress"],
            type=click.Choice(["auto", "bar", "json", "none"]),
            help="Progress on stderr: a bar on a terminal (auto), JSON lines, or none [default: auto].",
        ),
        click.Option(
            ["--threads"],
            type=click.IntRange(min=1, max=1024),
            help="CPU threads (default: all that this process may use).",
        ),
        click.Option(
            ["--max-memory", "--memory"],
            type=Finite(min=100),
            help="Memory to get by with, that of processes which fit tiles included [MB; default: half of what is "
            "free]: sizes of tiles and how many are fitted at a time go by it, what surely needs more is refused.",
        ),
        click.Option(
            ["--allow-remote"],
            is_flag=True,
            help="Let scene documents name files on other machines and in archives (/vsicurl/, /vsis3/, /vsizip/).",
        ),
        click.Option(
            ["--log-file"],
            type=NamedPath(dir_okay=False),
            help="Add everything that happens to this file, with times, whatever the screen shows; the commands that "
            "change a scene have such a log in its folder in any case, sattools.log.",
        ),
    ]


def dataclass_options(cls: type) -> Callable[[F], F]:
    """Add one option per field of an options dataclass (see `sattools.settings`)."""

    def decorate(command: F) -> F:
        for spec in reversed(specs(cls)):
            command = _click_option(spec)(command)
        return command

    return decorate


@contextmanager
def as_usage() -> Iterator[None]:
    """What is found inside is known from the command line alone: wrong usage, and its status."""
    try:
        yield
    except SattoolsError as error:
        raise click.UsageError(str(error)) from None


def build(cls: type[T], values: dict[str, Any]) -> T:
    """The options dataclass from click's keyword arguments (lists come as tuples)."""
    fields = {spec.name: spec for spec in specs(cls)}
    with as_usage():
        return cls(**{k: list(v) if fields[k].multiple else v for k, v in values.items() if k in fields})


def typed(values: Iterable[str]) -> list[str]:
    """Those of some options, by their fields, that were given on the command line; a file may serve several calls."""
    context = click.get_current_context()
    return [name for name in values if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE]


def print_config(command: str, options: Any) -> None:
    """Write the resolved options as a TOML table; unset options are left out, as TOML has no null."""
    import tomli_w

    defaults = {spec.name: spec.default for spec in specs(type(options))}
    unset = [k for k, v in as_dict(options).items() if v is None or (v == [] and not defaults.get(k))]
    table = {k.replace("_", "-"): v for k, v in as_dict(options).items() if k not in unset}
    click.echo(tomli_w.dumps({command: table}), nl=False)


def _click_option(spec: OptionSpec) -> Callable[[F], F]:
    name = spec.name.replace("_", "-")
    declaration = f"--{name}/--no-{name}" if spec.kind is bool else f"--{name}"
    show = spec.default is not None and spec.default != []
    return click.option(
        declaration,
        spec.name,
        type=kind_of(spec),
        default=spec.default,
        multiple=spec.multiple,
        nargs=spec.count,
        show_default=show,
        help=spec.help,
    )


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file's tables; an unreadable one, or one with a table of no command, is wrong usage of --config."""
    from sattools.scene.jsonio import read_toml as read

    try:
        data = read(path)
    except InputError as error:
        raise click.BadParameter(str(error), param_hint="--config") from None
    for name, value in data.items():
        if isinstance(value, dict) != (name in COMMANDS):
            from sattools.scene.schema import meant, shown

            if isinstance(value, dict):
                wrong = f"{path}: found the table [{name}], expected one named like a command{meant(name, COMMANDS)}"
                raise click.BadParameter(wrong, param_hint="--config")
            if name in COMMANDS:
                raise click.BadParameter(
                    f"{path}: found {name} = {shown(value)}, expected a table [{name}]", param_hint="--config"
                )
    return data


def _load_config(ctx: click.Context, parameter: click.Parameter, value: str | None) -> None:
    if value is None:
        return
    data = read_toml(Path(value))
    command = ctx.info_name or ""
    loose = {k: v for k, v in data.items() if not isinstance(v, dict)}
    if loose and command in data:
        name = next(iter(loose))
        raise click.BadParameter(f"{value}: found {name!r} outside of the table [{command}], expected it inside")
    table = data.get(command, loose)
    known = {p.name: p for p in ctx.command.params if isinstance(p, click.Option) and p.name != "config"}
    resolved = {}
    for key, given in table.items():
        option = known.get(key.replace("-", "_"))
        if option is None:
            from sattools.scene.schema import meant

            hint = meant(key.replace("_", "-"), [str(name).replace("_", "-") for name in known])
            raise click.BadParameter(f"{value}: found option {key!r}, which `sattools {command}` does not have{hint}")
        try:
            check_value(option, given)
            # click itself would blame the option of the command line, which nobody gave
            resolved[str(option.name)] = option.type_cast_value(ctx, given)
        except (InputError, click.BadParameter) as error:
            found = error.message if isinstance(error, click.BadParameter) else error
            raise click.BadParameter(f"{value}: {key}: {found}") from None
    ctx.default_map = {**(ctx.default_map or {}), **resolved}


def configure_logging(verbose: int, quiet: bool) -> None:
    """How much is said on stderr; a log file, where there is one, gets all."""
    from sattools.cli.logfile import log_is_open
    from sattools.cli.safety import set_screen_level

    level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.getLogger("sattools").setLevel(logging.DEBUG if log_is_open() else level)
    set_screen_level(level)


__all__ = [
    "WHOLE_DOCUMENT",
    "as_usage",
    "build",
    "common_options",
    "configure_logging",
    "dataclass_options",
    "print_config",
    "read_toml",
    "run_options",
    "scene_argument",
    "typed",
]

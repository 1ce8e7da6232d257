"""The whole command line as JSON, for programs that build their own forms from it (the QGIS plugin does)."""

from __future__ import annotations

import json
from typing import Any

import click

from sattools import __version__

# options of the commands' housekeeping: a form has no use for them
PLUMBING = {"help", "config", "print_config", "dry_run", "json", "verbose", "quiet", "progress", "threads"}
PLUMBING |= {"max_memory", "allow_remote", "log_file"}


def usage(group: click.Group) -> str:
    """JSON with `version` and `commands`: name -> {help, arguments, options}.

    Every option has `name` (its flag), `off` (the flag that switches it off, or null), `kind` (bool, int, float or
    str), `choices`, `words` (what a number may be instead, such as auto), `minimum`, `maximum`, `default`, `multiple`,
    `values` (how many values follow the flag), `help`, `group` (its title in the command's help, or null) and
    `by_preset` (whether a preset may say what it is where it is not given).
    """
    context = click.Context(group, info_name="sattools")
    commands: dict[str, Any] = {}
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None  # list_commands names only what is there
        arguments = [p for p in command.params if isinstance(p, click.Argument)]
        options = [p for p in command.params if isinstance(p, click.Option) and p.name not in PLUMBING]
        named = getattr(command, "groups", {})
        groups = {option: title for title, names in named.items() for option in names}
        by_preset: frozenset[str] = getattr(command, "by_preset", frozenset())
        commands[name] = {
            "help": command.help or "",
            "arguments": [{"name": p.name, "multiple": p.nargs == -1} for p in arguments],
            "options": [
                {**_option(p, groups.get(str(p.name))), "by_preset": str(p.name) in by_preset} for p in options
            ],
        }
    return json.dumps({"version": __version__, "commands": commands})


def _option(option: click.Option, group: str | None) -> dict[str, Any]:
    kind = option.type
    low, high = getattr(kind, "min", None), getattr(kind, "max", None)
    names = {click.types.IntParamType: "int", click.types.FloatParamType: "float", click.types.BoolParamType: "bool"}
    default = option.default if isinstance(option.default, bool | int | float | str | list | tuple) else None
    return {
        "name": option.opts[0],
        "off": option.secondary_opts[0] if option.secondary_opts else None,
        "kind": next((text for cls, text in names.items() if isinstance(kind, cls)), "str"),
        "choices": list(kind.choices) if isinstance(kind, click.Choice) else None,
        "words": list(getattr(kind, "words", ())),
        "minimum": low,
        "maximum": high,
        "default": list(default) if isinstance(default, tuple) else default,
        "multiple": option.multiple,
        "values": option.nargs,
        "help": option.help or "",
        "group": group,
    }


__all__ = ["usage"]

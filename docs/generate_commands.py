"""Write docs/commands.md from the commands themselves: `python docs/generate_commands.py` (or `make docs`)."""

from __future__ import annotations

import inspect
from pathlib import Path

import click

from sattools.cli import COMMANDS, main

HEAD = """# Commands

Made by `make docs` from the commands' own help.

    sattools [OPTIONS] COMMAND [ARGS]...
"""


def option_rows(command: click.Command, context: click.Context) -> list[str]:
    """Markdown table rows (option, help) of a command."""
    rows = []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if isinstance(parameter, click.Option) and record and "--help" not in record[0]:
            name, text = (part.replace("|", "\\|").replace("\n", " ") for part in record)
            rows.append(f"| `{name}` | {text} |")
    return rows


def document() -> str:
    """The text of docs/commands.md."""
    group = click.Context(main, info_name="sattools")
    lines = [HEAD, "| option | meaning |", "|---|---|", *option_rows(main, group), ""]
    for name in main.list_commands(group):
        command = main.get_command(group, name)
        assert command is not None
        context = click.Context(command, info_name=name, parent=group)
        arguments = " ".join(p.make_metavar(context) for p in command.params if isinstance(p, click.Argument))
        lines += [f"## {name}", "", COMMANDS[name], "", f"    sattools {name} [OPTIONS] {arguments}".rstrip(), ""]
        lines += [inspect.cleandoc(command.help or ""), "", "| option | meaning |", "|---|---|"]
        lines += [*option_rows(command, context), ""]
    return "\n".join(lines)


if __name__ == "__main__":
    target = Path(__file__).with_name("commands.md")
    target.write_text(document(), encoding="utf-8")
    print(f"{target} written")

"""Shells complete every option that names a file or a folder."""

import re
from typing import Any

import click
import pytest

from sattools.cli import main
from sattools.cli.commands import COMMANDS
from sattools.cli.kinds import PathText

# words of help texts that mean a file or folder is named; what else they may mean
NAMED = re.compile(r"^(folder|root|vector file|reference dsm|dsm to score|class map|surface to take|samples)", re.I)


def options() -> list[Any]:
    context = click.Context(main, info_name="sattools")
    commands = ((name, main.get_command(context, name)) for name in COMMANDS)
    return [(name, o) for name, command in commands for o in command.params if isinstance(o, click.Option)]


@pytest.mark.parametrize("command", list(COMMANDS))
def test_options_that_name_paths_are_completed(command: str) -> None:
    for name, option in options():
        if name == command and NAMED.match(option.help or ""):
            assert isinstance(option.type, PathText | click.Path), f"{name} --{option.name}"


@pytest.mark.parametrize(
    ("command", "flag", "kind"),
    [
        ("prep", "aoi", "file"), ("prep", "metadata", "dir"), ("prep", "mask", "file"), ("compare", "dsm", "file"),
        ("align", "to", "file"), ("fit", "reference", "file"), ("simulate", "out", "dir"), ("prep", "colours", "dir"),
    ],
)  # fmt: skip
def test_the_shell_is_asked_for_files_or_folders(command: str, flag: str, kind: str) -> None:
    (option,) = [o for name, o in options() if name == command and o.name == flag]
    (item,) = option.shell_complete(click.Context(main), "a/b")
    assert (item.value, item.type) == ("a/b", kind)


def test_the_shell_is_asked_for_nothing_where_a_name_comes_first() -> None:
    (option,) = [o for name, o in options() if (name, o.name) == ("compare", "map")]
    assert option.shell_complete(click.Context(main), "w=a/b") == []

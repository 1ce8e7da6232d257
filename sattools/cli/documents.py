"""Scene documents on the command line and on stdin, and what is there instead of one."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, BinaryIO

import click

from sattools.errors import InputError, SceneError

if TYPE_CHECKING:  # the document pulls in numpy, which --help can do without
    from sattools.scene import Scene


def documents(scenes: tuple[str, ...]) -> Iterator[tuple[str, str | None]]:
    """(name, text) of every scene; text None means that the name is a file still to be read."""
    for name in scenes or ("-",):
        if name != "-":
            yield name, None
            continue
        if sys.stdin is None or sys.stdin.isatty():
            raise click.UsageError("expected scene documents on stdin (from `sattools prep`) or the path of one")
        yield from _gathered(_lines())


def _gathered(lines: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """The same, with one error for lines in a row that cannot begin a document, such as what `info` prints."""
    foreign: list[tuple[str, str]] = []  # the first of them and the last
    for name, text in lines:
        start = text.strip()
        if start.startswith(("{", "\0")) and start != "{":
            yield from _in_one(foreign)
            foreign = []
            yield name, text
        else:
            foreign = [*foreign[:1], (name, text)]
    yield from _in_one(foreign)


def _in_one(foreign: list[tuple[str, str]]) -> list[tuple[str, str]]:
    if len(foreign) < 2:
        return foreign
    from sattools.scene.schema import shown

    (first, text), (last, _) = foreign
    name = f"{first.replace('line', 'lines')} to {last.rpartition(' ')[2]}"
    return [(name, f"\0{name}: found text that is not JSON ({shown(text.strip())}), expected scene documents")]


def _lines() -> Iterator[tuple[str, str]]:
    """The documents on stdin, of a length that memory holds: one per line, or over several lines as `jq .` prints."""
    from sattools.scene.jsonio import TEXT_LIMIT, decode

    stream = sys.stdin.buffer
    number, ahead = 0, b""
    while line := ahead or stream.readline(TEXT_LIMIT + 1):
        number, ahead = number + 1, b""
        name = f"stdin line {number}"
        if line.removeprefix(b"\xef\xbb\xbf").rstrip() == b"{":
            rest, ahead = _until_closed(stream, TEXT_LIMIT + 1 - len(line))
            number += rest.count(b"\n")
            line += rest
        try:
            if len(line) > TEXT_LIMIT:
                raise InputError(f"{name}: found more than {TEXT_LIMIT >> 20} MiB, expected a scene document in a line")
            text = decode(line, name)
        except InputError as error:
            yield name, f"\0{error}"
            if len(line) > TEXT_LIMIT:
                return
            continue
        if text.strip():
            yield name, text


def _until_closed(stream: BinaryIO, limit: int) -> tuple[bytes, bytes]:
    """What follows an opening brace on a line of its own, up to the closing one; the line where another begins instead.

    Neither brace is indented, and all between them is.
    """
    found: list[bytes] = []
    while limit > 0 and (line := stream.readline(limit)):
        if line.startswith(b"{"):
            return b"".join(found), line
        found.append(line)
        limit -= len(line)
        if line.rstrip() == b"}":
            break
    return b"".join(found), b""


def parse(source: str, text: str | None) -> Scene:
    """The scene of a document; raises SceneError where it is none."""
    from sattools.scene import Scene

    if text is not None and text.startswith("\0"):  # what `_lines` could not read
        raise SceneError(text[1:])
    return Scene.from_file(source) if text is None else Scene.from_json(text, source)


__all__ = ["documents", "parse"]

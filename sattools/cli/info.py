"""`sattools info`: what is in a scene."""

from __future__ import annotations

import sys

import click

from sattools.cli.options import scene_argument
from sattools.cli.pipe import documents, parse, report_error


@click.command("info")
@scene_argument
def command(scenes: tuple[str, ...]) -> None:
    """Print a summary of scenes on stdout (no scene document: the end of a pipe)."""
    from sattools.errors import SattoolsError
    from sattools.scene.summary import summary

    failed = False
    for source, text in documents(scenes):
        try:
            click.echo(summary(parse(source, text)))
        except SattoolsError as error:
            failed = True
            report_error("info", error)
    if failed:
        sys.exit(1)

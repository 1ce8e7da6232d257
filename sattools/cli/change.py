"""`sattools change`: what has changed between two dates."""

from __future__ import annotations

import json
import sys
from typing import Any

import click

from sattools.change.options import ChangeOptions
from sattools.cli.kinds import NamedPath
from sattools.cli.options import build, common_options, dataclass_options
from sattools.cli.options import print_config as show_config
from sattools.cli.pipe import is_watched, progress_of, report_error
from sattools.cli.plans import of_change
from sattools.errors import SattoolsError


@click.command("change")
@click.argument("before", type=NamedPath())
@click.argument("after", type=NamedPath())
@dataclass_options(ChangeOptions)
@common_options
def command(before: str, after: str, overwrite: bool, dry_run: bool, print_config: bool, **values: Any) -> None:
    """Compare the surfaces of two dates, BEFORE and AFTER: scene documents after `export`, or rasters of heights.

    Writes maps of the change of height (and albedo), its significance, and polygons of what has risen or sunk with
    their volumes into --out; the table as JSON on stdout.

    Some metres along the rim of what the images of a date show, its heights are worse, which the map of their change
    shows. Regions of scenes are judged by the confidence of the matching, which is low there; rasters have none.
    """
    options = build(ChangeOptions, values)
    if print_config:
        show_config("change", options)
        return
    from sattools.change.stage import change, check_start

    try:
        if dry_run or is_watched():
            plan = of_change(check_start(before, after, options, overwrite))  # before anything is said
            what = f"would compare {before} with {after}" if dry_run else f"{before} {after}"
            click.echo(f"sattools change: {what}: {plan}; writes {options.out}/", err=True)
        if dry_run:
            return
        table = change(before, after, options, progress_of("change", f"{before} {after}"), overwrite)
    except SattoolsError as error:
        report_error("change", error)
        sys.exit(1)
    click.echo(json.dumps(table))

"""`sattools report`: one HTML page."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

import click

from sattools.cli.documents import documents, parse
from sattools.cli.kinds import NamedPath
from sattools.cli.pipe import NOTHING, report_error
from sattools.errors import OutputExistsError, SattoolsError, SceneError


@click.command("report")
@click.argument("source", default="-", type=NamedPath(), metavar="[SCENE|FOLDER]")
@click.option(
    "--out", type=NamedPath(dir_okay=False, path_type=Path), help="The page [default: report.html beside the data]."
)
@click.option("--overwrite", is_flag=True, help="Replace an existing page of sattools; never another file.")
def command(source: str, out: Path | None, overwrite: bool) -> None:
    """Write one self-contained HTML page about a scene, or about a folder that `batch` or `compare --fit` has written.

    Needs no network to be read; what a scene has no data for is left out. Prints the path of the page.
    """
    try:
        batch = Path(source) / "table.csv"
        if source != "-" and batch.is_file():
            from sattools.report.batch import batch_page

            inputs = [path for path in batch.parent.iterdir() if path.name != "report.html"]
            write(out or batch.with_name("report.html"), batch_page(batch.parent), overwrite, inputs)
            return
        evaluation = Path(source) / "evaluation.json"
        if source != "-" and evaluation.is_file():
            from sattools.report.evaluation import evaluation_page

            inputs = [path for path in evaluation.parent.iterdir() if path.name != "report.html"]
            write(out or evaluation.with_name("report.html"), evaluation_page(evaluation), overwrite, inputs)
            return
        from sattools.report.scene import scene_page
        from sattools.scene.dependencies import files_of
        from sattools.scene.runner import check_place

        name = source
        if source != "-" and Path(source).is_dir():
            name = str(Path(source) / "scene.json")
            if not Path(name).is_file():
                raise SceneError(
                    f"{source}: found a folder without scene.json, table.csv and evaluation.json, expected that of a "
                    "scene, or one that `batch` or `compare --fit` has written"
                )
        done = False
        if out is not None and name == "-":  # known before the scene comes, hours maybe
            check_page(out, overwrite)
        for origin, text in documents((name,)):
            scene = parse(origin, text)
            if scene.origin is None:  # of one on disk a page says what is left of it
                check_place(scene)
            if done and out is not None:
                raise SceneError(
                    f"{out}: the page of scene {scene.id} would replace that of the one before, expected one scene "
                    "with --out"
                )
            done = True
            page = scene_page(scene)
            read = [scene.path("scene.json"), *([scene.origin] if scene.origin else []), *files_of(scene)]
            write(out or scene.output("report.html"), page, overwrite, read)
        if not done:
            raise SceneError(f"stdin: found nothing, expected a scene document {NOTHING}")
    except SattoolsError as error:
        report_error("report", error)
        sys.exit(1)


def write(path: Path, page: str, overwrite: bool, inputs: Iterable[Path]) -> None:
    """The page, unless it would replace what it was made from, or a file that is no page; its path on stdout.

    Args:
        path: file to write.
        page: its HTML.
        overwrite: replace outputs that are there.
        inputs: files that it was made from.
    """
    from sattools.scene.files import check_outputs, write_text

    check_outputs([path], inputs, overwrite=True)  # an input is told as one, whatever it is
    check_page(path, overwrite)
    write_text(path, page)
    click.echo(str(path))


def check_page(path: Path, overwrite: bool) -> None:
    """Raise OutputExistsError where a page would replace a file that is no page, or another page unasked.

    Args:
        path: file to write.
        overwrite: replace a page that is there.
    """
    from sattools.report.page import may_be_replaced
    from sattools.scene.files import check_outputs

    if path.is_file() and not may_be_replaced(path):
        raise OutputExistsError(f"{path}: found a file that is no report of sattools, expected a new name or a report")
    check_outputs([path], overwrite=overwrite)

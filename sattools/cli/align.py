"""`sattools align`: bring a scene onto a reference."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from sattools.align.options import AlignOptions
from sattools.cli import plans
from sattools.cli.options import build, common_options, dataclass_options, scene_argument
from sattools.cli.pipe import Run, run_scenes, tell
from sattools.progress import Progress

if TYPE_CHECKING:
    from sattools.scene import Scene
    from sattools.scene.jsonio import JsonObject


@click.command("align")
@scene_argument
@dataclass_options(AlignOptions)
@common_options
def command(scenes: tuple[str, ...], overwrite: bool, dry_run: bool, print_config: bool, **values: Any) -> None:
    """Move an exported scene onto a reference DEM or ground control points: DSM, maps, model and cameras together.

    The shift and what is left go to the history, to align/N/transform.json (a 4 x 4 matrix; residuals of control
    points) and to stderr; the files from before stay where they are.
    """
    options = build(AlignOptions, values)
    if options.to is None and not print_config:
        raise click.UsageError("Missing option '--to', a raster of heights or ground control points.")

    def work(scene: Scene, progress: Progress) -> JsonObject:
        from sattools.align.stage import align

        figures = align(scene, options, progress, overwrite)
        tell(f"scene {scene.id}: {figures['notes'][0]}")
        return figures

    def check(scene: Scene) -> None:
        from sattools.align.stage import check_start

        check_start(scene, options, overwrite)

    def ahead() -> None:
        from sattools.align.stage import check_options

        check_options(options)

    run = Run("align", options, dry_run, print_config, overwrite)
    plan = "move onto the reference"
    run_scenes(run, scenes, work, plan=plan, foreseen=plans.of_align, check=check, ahead=ahead)

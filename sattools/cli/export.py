"""`sattools export`: a fitted scene becomes georeferenced files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from sattools.cli import plans
from sattools.cli.options import build, common_options, dataclass_options, scene_argument, typed
from sattools.cli.pipe import Run, run_scenes
from sattools.export.options import ExportOptions, without_effect
from sattools.progress import Progress
from sattools.settings import tell_without_effect

if TYPE_CHECKING:
    from sattools.scene import Scene
    from sattools.scene.jsonio import JsonObject


@click.command("export")
@scene_argument
@dataclass_options(ExportOptions)
@common_options
def command(scenes: tuple[str, ...], overwrite: bool, dry_run: bool, print_config: bool, **values: Any) -> None:
    """Write the DSM, the albedo, shadow masks and a picture as cloud-optimised GeoTIFFs and PNG."""
    options = build(ExportOptions, values)
    tell_without_effect(without_effect(options, typed(values)))

    def work(scene: Scene, progress: Progress) -> JsonObject:
        from sattools.export.stage import export

        return export(scene, options, progress, overwrite)

    def check(scene: Scene) -> None:
        from sattools.export.stage import check_start

        check_start(scene, options, overwrite)

    def ahead() -> None:
        from sattools.export.stage import check_options

        check_options(options)

    run = Run("export", options, dry_run, print_config, overwrite)
    plan = "write the DSM and maps"
    run_scenes(run, scenes, work, plan=plan, foreseen=plans.of_export, check=check, ahead=ahead)

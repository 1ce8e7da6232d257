"""`sattools normalise`: digital numbers become linear radiance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from sattools.cli import plans
from sattools.cli.options import as_usage, build, common_options, dataclass_options, scene_argument
from sattools.cli.pipe import Run, run_scenes
from sattools.progress import Progress
from sattools.radiometry.options import NormaliseOptions

if TYPE_CHECKING:
    from sattools.scene import Scene
    from sattools.scene.jsonio import JsonObject


@click.command("normalise")
@scene_argument
@dataclass_options(NormaliseOptions)
@common_options
def command(scenes: tuple[str, ...], overwrite: bool, dry_run: bool, print_config: bool, **values: Any) -> None:
    """Turn digital numbers into linear radiance: black level, masks, band order, vendor calibration.

    Writes radiance/*.tif and a histogram of input and output below the scene's root. Nothing is clipped; the scene
    says whether the values are reflectances or radiance up to an unknown factor.
    """
    options = build(NormaliseOptions, values)
    if options.scale is not None or options.offset:
        from sattools.radiometry.kind import declared_by_user

        with as_usage():
            declared_by_user(options)

    def work(scene: Scene, progress: Progress) -> JsonObject:
        from sattools.radiometry.stage import normalise

        return normalise(scene, options, progress, overwrite)

    def check(scene: Scene) -> None:
        from sattools.radiometry.stage import check_start

        check_start(scene, options, overwrite)

    run = Run("normalise", options, dry_run, print_config, overwrite)
    run_scenes(run, scenes, work, plan="write linear radiance", foreseen=plans.of_normalise, check=check)

"""`sattools prior`: a scene gets a rough surface by matching its images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from sattools.cli import plans
from sattools.cli.options import build, common_options, dataclass_options, scene_argument
from sattools.cli.pipe import Run, run_scenes
from sattools.prior.options import PriorOptions
from sattools.progress import Progress

if TYPE_CHECKING:
    from sattools.scene import Scene
    from sattools.scene.jsonio import JsonObject


@click.command("prior")
@scene_argument
@dataclass_options(PriorOptions)
@common_options
def command(scenes: tuple[str, ...], overwrite: bool, dry_run: bool, print_config: bool, **values: Any) -> None:
    """Match the scene's images in ground geometry: a rough surface, its confidence, and its normals.

    Writes prior/dsm.tif, prior/confidence.tif (0 to 1) and prior/normals.tif (east, north, up) below the scene's root.
    prior/water.tif says where water was laid level.
    Where the images go on beyond the area, prior/surroundings.tif has the heights of 16 m around it, for shadows.
    """
    options = build(PriorOptions, values)

    def work(scene: Scene, progress: Progress) -> JsonObject:
        from sattools.prior.stage import prior

        return prior(scene, options, progress, overwrite)

    def check(scene: Scene) -> None:
        from sattools.prior.gate import check_start

        check_start(scene, options, overwrite)

    run = Run("prior", options, dry_run, print_config, overwrite)
    run_scenes(run, scenes, work, plan="match the images", foreseen=plans.of_prior(options), check=check)

"""`sattools prior`: a scene gets a rough surface by matching its images."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import click

from sattools.cli import interrupts, plans
from sattools.cli.options import build, common_options, dataclass_options, scene_argument
from sattools.cli.pipe import Run, run_scenes
from sattools.prior.options import PriorOptions
from sattools.progress import Progress

if TYPE_CHECKING:
    from sattools.scene import Scene
    from sattools.scene.jsonio import JsonObject

log = logging.getLogger(__name__)


@click.command("prior")
@scene_argument
@dataclass_options(PriorOptions)
@common_options
def command(scenes: tuple[str, ...], overwrite: bool, dry_run: bool, print_config: bool, **values: Any) -> None:
    """Match the scene's images in ground geometry: a rough surface, its confidence, and its normals.

    Writes prior/dsm.tif, prior/confidence.tif (0 to 1) and prior/normals.tif (east, north, up) below the scene's root.
    prior/water.tif says where water was laid level.
    Where the images go on beyond the area, prior/surroundings.tif has the heights of 16 m around it, for shadows.
    What is matched in tiles and was interrupted goes on with those that are finished; --overwrite begins anew.
    """
    options = build(PriorOptions, values)

    def work(scene: Scene, progress: Progress) -> JsonObject:
        from sattools.prior.resume import how_to_go_on
        from sattools.prior.stage import prior

        try:
            return prior(scene, options, progress, overwrite)
        except BaseException as error:
            if (isinstance(error, KeyboardInterrupt | SystemExit) or interrupts.status()) and (
                words := how_to_go_on(scene)
            ):
                log.warning("%s", words)
            raise

    def check(scene: Scene) -> None:
        from sattools.prior.gate import check_start

        check_start(scene, options, overwrite)

    run = Run("prior", options, dry_run, print_config, overwrite)
    run_scenes(run, scenes, work, plan="match the images", foreseen=plans.of_prior(options, overwrite), check=check)

"""`fit --tile`: an area fitted piece by piece, with the memory of one piece.

A coarse fit of the whole, on no more cells than one tile has, finds what all tiles share: gain, offset and ambient
light of every image, the shift of its rays, and the surface around a tile that throws shadows into it. Where its cells
are too large to show shadows and shifts, up to four pilot tiles, fitted by themselves, find those. Every tile is a
scene of its own in ``fit/tiles/NAME``, with a grid of its own on the cells of the whole, and is fitted as any other,
but for what is shared; several at a time where there are processors and memory for it. The maps are then mosaicked with
weights that feather where tiles overlap.
"""

from __future__ import annotations

import logging
from dataclasses import replace

from sattools.fit.foresight import check_tiled
from sattools.fit.inputs import forget_left_over, warn_of_prior
from sattools.fit.options import FitOptions
from sattools.fit.tiles.clearing import WHOLE
from sattools.fit.tiles.mosaic import mosaic_tiles
from sattools.fit.tiles.plan import Plan
from sattools.fit.whole import fit_whole
from sattools.progress import Progress, silent, subprogress
from sattools.scene import Scene
from sattools.scene.dependencies import seen
from sattools.scene.files import immediately, write_text
from sattools.scene.jsonio import JsonObject
from sattools.scene.memory import give_back

log = logging.getLogger(__name__)


def fit_tiled(scene: Scene, options: FitOptions, progress: Progress = silent) -> JsonObject:
    """Fit a scene in tiles; called by `sattools.fit.stage.fit`, which has set the roles of the images.

    Args:
        scene: the scene.
        options: of the fit.
        progress: told the share done and what is being done.

    Returns:
        Remarks and figures for the history.

    Raises:
        SceneError: options that do not go with tiles, tiles of another fit with ``resume``, a tile that is not fitted
            with ``part="mosaic"``.
    """
    check_tiled(options)
    if options.prior_weight > 0:
        forget_left_over(scene)  # the tiles make their own
    plan = Plan.make(scene, options)
    if len(plan.tiles) == 1:
        log.info("scene %s is no larger than a tile: fitted all at once", scene.id)
        if options.part in ("coarse", "split"):
            plan.begin([])
            with immediately():
                write_text(scene.output(WHOLE), scene.to_json(root="../..") + "\n")
            return {"tiles": [], "pilots": []} if options.part == "coarse" else {"tiles": []}
        return fit_whole(scene, replace(options, tile=None, part="all"), progress)
    if options.part in ("all", "coarse"):
        warn_of_prior(scene, options)
    notes: list[str] = []
    read = seen(scene, "fit", scene.train_items())
    with immediately():  # all of it is there for another run to go on with
        if options.part == "coarse":
            return {"notes": plan.coarse(progress), "pilots": plan.pilots()}
        first = 1 / (len(plan.tiles) + 1)
        if options.part in ("all", "split"):
            notes = plan.split(subprogress(progress, 0.0, first if options.part == "all" else 1.0))
        if options.part == "split":
            return {"notes": notes, "tiles": plan.names()}
        if options.part == "all":
            give_back()
            notes += plan.fit(subprogress(progress, first, 1.0))
    return mosaic_tiles(plan, notes, read, progress)


__all__ = ["fit_tiled"]

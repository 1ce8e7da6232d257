"""What may be in the way of a matching, asked before an image is read."""

from __future__ import annotations

import logging
import math
from itertools import combinations

import numpy as np

from sattools.errors import SceneError
from sattools.prior.cells import grids
from sattools.prior.files import MAPS, SURROUNDINGS
from sattools.prior.foresight import check_fits, plan_matching, warn_of_tiles
from sattools.prior.matched import matching_height
from sattools.prior.matching.match import PLANE_CELLS
from sattools.prior.matching.pairs import choose_pairs
from sattools.prior.options import PriorOptions
from sattools.prior.resume import KeptTiles
from sattools.prior.surroundings import with_surroundings
from sattools.scene import Grid, Item, Scene
from sattools.scene.dependencies import may_begin
from sattools.views import line_of_sight, open_images
from sattools.views.check import check_extent

log = logging.getLogger(__name__)
NO_STEREO = "found no two images from different directions, expected stereo images"
# Heights of simulated cities, downtowns (cells of 0.35 m) and hills (1.4 m), seven views: with a window of 9 x 9 cells
# twice as wrong as with 3 x 3, with 13 x 13 2.4 to 3.3, with 33 x 33 6 to 9.5 times. Below 3 m it is narrower than
# streets and houses, however small the cells are.
WIDE_CELLS, WIDE_M = 9, 3.0
NARROW_DEG = 5.0  # between lines of sight, below which half a pixel is several pixels of height


def check_start(scene: Scene, options: PriorOptions, overwrite: bool = True) -> None:
    """What `prior` looks at before its work, for a dry run; arguments and errors as of `sattools.prior.stage.prior`.

    Args:
        scene: is changed.
        options: of the matching.
        overwrite: replace products that are there.
    """
    items = scene.train_items()
    kept = KeptTiles(scene, items, options, overwrite)
    may_begin(scene, "prior", outputs(items, options), kept.may_replace)
    check_count(scene, items)
    grid, fine = grids(scene, items, options)
    warn_of_window(scene, fine, options)
    warn_of_base(scene, items)
    z_range = scene.require_height_range()
    images = open_images(scene, items)
    check_extent(grid)
    check_step(scene, options, fine.cell_size)
    shapes = [image.shape for image in images.parts]
    wide = with_surroundings(fine, images.cameras, shapes, matching_height(z_range), scene.surroundings_m)
    plan = plan_matching(scene, items, fine, wide, options, kept=None if overwrite else kept)
    check_fits(scene, plan, len(items))
    warn_of_tiles(scene, plan)
    slopes = [line_of_sight(camera, fine, z_range[0], z_range)[0] for camera in images.cameras]
    if not len(choose_pairs(slopes, [None] * len(items), options.pairs)):
        raise SceneError(f"scene {scene.id}: {NO_STEREO}")


def check_count(scene: Scene, items: list[Item]) -> None:
    """Raise SceneError where fewer than two images are left to match."""
    if len(items) < 2:
        raise SceneError(f"scene {scene.id}: found {len(items)} training image, expected at least 2")


def check_step(scene: Scene, options: PriorOptions, cell: float) -> None:
    """Raise SceneError for height planes further apart than the heights: planes beyond them would be all there is.

    Args:
        scene: with its height range.
        options: of the matching.
        cell: of the surface [m].
    """
    low, high = scene.require_height_range()
    least = options.step or PLANE_CELLS * cell * options.detail
    if least > high - low:
        what = f"--step {least:g} m" if options.step else f"cells of {cell:g} m, whose planes are {least:g} m apart"
        more = "" if options.step else " (--resolution)"
        raise SceneError(f"scene {scene.id}: found {what}, expected at most the height range, {high - low:g} m{more}")


def warn_of_window(scene: Scene, grid: Grid, options: PriorOptions) -> list[str]:
    """Notes, and a warning, of a window so wide that it blurs what it is to find; none where it is not.

    Args:
        scene: for the message.
        grid: of the surface.
        options: of the matching.
    """
    cells = 2 * options.window + 1
    width = cells * grid.cell_size * options.detail
    if cells <= WIDE_CELLS or width <= WIDE_M:
        return []
    text = (
        f"--window {options.window} compares {cells} x {cells} cells, {width:.1f} m on the ground, and blurs what is "
        "narrower: heights are mostly more than twice as wrong as with --window 1"
    )
    log.warning("scene %s: %s", scene.id, text)
    return [text]


def warn_of_base(scene: Scene, items: list[Item]) -> list[str]:
    """Notes, and a warning, of images from so nearly one direction that displacements tell little of heights.

    Args:
        scene: for the message.
        items: the images.
    """
    known = [item.properties.get("sattools:view_direction") for item in items]
    if not all(known):
        return []
    towards = np.array(known, np.float64)
    # by the chord: the cosine of a small angle has no digits left
    widest = max(2 * math.asin(min(1.0, float(np.linalg.norm(a - b)) / 2)) for a, b in combinations(towards, 2))
    if math.degrees(widest) >= NARROW_DEG:
        return []
    pixel = float(np.median([item.properties.get("gsd") or math.nan for item in items]))
    worth = f"a pixel of displacement is {pixel / max(widest, 1e-6):.0f} m of height" if math.isfinite(pixel) else ""
    text = (
        f"lines of sight are {math.degrees(widest):.1f} degrees apart at most: {worth or 'heights are weakly known'}; "
        "probability and bounds of the errors do not know of it"
    )
    log.warning("scene %s: %s", scene.id, text)
    return [text]


def outputs(items: list[Item], options: PriorOptions) -> list[str]:
    """All files that will be written."""
    found = [*MAPS.values(), SURROUNDINGS]
    if options.per_image:
        found += [per_image_href(name, item.id) for item in items for name in ("depth", "confidence")]
    return found


def per_image_href(name: str, item_id: str) -> str:
    """File of what an image sees of the matched surface."""
    return f"prior/{name}/{item_id}.tif"


__all__ = [
    "NO_STEREO", "check_count", "check_start", "check_step", "outputs", "per_image_href", "warn_of_base",
    "warn_of_window",
]  # fmt: skip

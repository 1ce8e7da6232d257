"""What a matching will take, said before it begins, and pieces of the area that fit into memory."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np

from sattools import system
from sattools.camera.rpc import RPC
from sattools.errors import SattoolsError, counted
from sattools.prior import tiled
from sattools.prior.cells import grids
from sattools.prior.matched import matching_height
from sattools.prior.matching.match import margin_for
from sattools.prior.matching.sweep import BEYOND_PLANES, planes, volume_bytes
from sattools.prior.options import PriorOptions
from sattools.prior.resume import KeptTiles
from sattools.prior.surroundings import with_surroundings
from sattools.scene import Grid, Item, Scene
from sattools.scene.memory import available, check_memory, to_spend

log = logging.getLogger(__name__)
# Measured on one thread, 3 to 36 simulated images on 0.06 to 1.1 million cells
BASE_BYTES = 250e6  # of the program
COMMON_BYTES = 40e6  # of what tiles have in common, beside their images on coarse cells
BYTES_PER_IMAGE = 40.0  # per cell that is matched and image: what it shows, what hides it, where its rays end
BYTES_PER_BAND = 8.0  # and per band
KEPT_HEIGHTS = 2 / 3  # of the height range, which is left when the first pass has seen the surface
START_S = 1.5
CELL_S = 4.8e-6  # CPU seconds per cell that is matched
IMAGE_S = 2.0e-6  # and image
PAIR_S = 1.2e-9  # and pair and height
OFF_NADIR_DEG = 30.0  # of images that do not tell theirs


@dataclass(frozen=True)
class MatchingPlan:
    """How an area is matched.

    Attributes:
        edge: cells along that of a tile, without its overlap, about; None = all at once.
        tiles: their number.
        memory: bytes at a time, those of the program included.
        cpu_s: CPU seconds.
        usual: the edge where memory is no question.
        done: tiles that an interrupted run has matched.
    """

    edge: int | None
    tiles: int
    memory: float
    cpu_s: float
    usual: int | None
    done: int = 0


def foresee_matching(scene: Scene, options: PriorOptions, overwrite: bool = True) -> MatchingPlan:
    """What `prior` will take, by the scene's document and cameras alone.

    Args:
        scene: with a grid and a height range.
        options: of the matching.
        overwrite: it begins anew, whatever an interrupted one has left.

    Raises:
        SceneError: a scene without them.
    """
    items = scene.train_items()
    _, fine = grids(scene, items, options)
    kept = None if overwrite else KeptTiles(scene, items, options, overwrite)
    return plan_matching(scene, items, fine, known_surroundings(scene, items, fine), options, kept=kept)


def plan_matching(
    scene: Scene,
    items: list[Item],
    fine: Grid,
    wide: Grid,
    options: PriorOptions,
    *,
    whole: bool = False,
    kept: KeptTiles | None = None,
) -> MatchingPlan:
    """The largest pieces, up to the usual ones, that fit into the memory that there is.

    A tile of a fit is matched as it is wherever it is fitted: its fit was cut to size for what there is. What was begun
    goes on as it was, if there is memory for that.

    Args:
        scene: of the images.
        items: the images.
        fine: the area on the cells of the matching.
        wide: the same with what stands around it.
        options: of the matching.
        whole: all at once is usual whatever its size.
        kept: tiles that an interrupted run has left; None = none.
    """
    usual = None if whole or fine.width * fine.height <= tiled.AT_ONCE else tiled.TILE_CELLS
    free, there = available(), to_spend()
    if kept and (begun := kept.edge()):
        plan, done = _planned(scene, items, wide, options, begun), kept.count(begun)
        if scene.is_part or there is None or _beyond_start(plan) <= there:
            left = START_S + (plan.cpu_s - START_S) * (plan.tiles - done) / plan.tiles
            return replace(plan, usual=usual, done=done, cpu_s=left)
    plan = _planned(scene, items, wide, options, usual)
    if scene.is_part or free is None or there is None or _beyond_start(plan) <= free:
        return plan
    for edge in (tiled.TILE_CELLS, *tiled.SMALLER_CELLS):
        if usual is None or edge < usual:
            smaller = replace(_planned(scene, items, wide, options, edge), usual=usual)
            plan = smaller if smaller.memory < plan.memory else plan
            if _beyond_start(plan) <= there:
                break
    return plan


def check_fits(scene: Scene, plan: MatchingPlan, images: int) -> None:
    """Raise SattoolsError where not even the smallest pieces fit into memory.

    Args:
        scene: for the message.
        plan: of the matching.
        images: their number.
    """
    if not scene.is_part:
        pieces = f"in {counted(plan.tiles, 'tiles')}" if plan.edge else "at once"
        what = f"scene {scene.id}: matching {counted(images, 'images')} {pieces}"
        check_memory(_beyond_start(plan), what, "fewer images, or larger cells: --detail 1, --resolution")


def warn_of_tiles(scene: Scene, plan: MatchingPlan) -> list[str]:
    """Notes, and a warning, of tiles that are there for want of memory.

    Args:
        scene: for the message.
        plan: of the matching.
    """
    if plan.edge == plan.usual:
        return []
    how = f"in tiles of {plan.usual} cells" if plan.usual else "all at once"
    text = f"needs more memory than is free {how}: matched in {counted(plan.tiles, 'tiles')} of {plan.edge} cells"
    log.warning("scene %s: %s", scene.id, text)
    return [text]


def matching_bytes(scene: Scene, cells: float) -> float:
    """Bytes that matching a square of so many cells takes with its defaults, those of the program included.

    Args:
        scene: with a grid and a height range.
        cells: of the matching, what stands around included.
    """
    items, options = scene.train_items(), PriorOptions()
    fine = grids(scene, items, options)[1]
    edge = math.ceil(math.sqrt(cells))
    square = Grid(fine.crs, 0.0, 0.0, fine.cell_size, edge, edge)
    return _planned(scene, items, square, options, None if cells <= tiled.AT_ONCE else tiled.TILE_CELLS).memory


def seconds_per_cell(scene: Scene, items: list[Item], cell: float, options: PriorOptions) -> float:
    """CPU seconds of a matching per cell.

    Args:
        scene: with a height range.
        items: the images.
        cell: of the matching [m].
        options: of the matching.
    """
    low, high = scene.require_height_range()
    pairs = min(len(items) * (len(items) - 1) // 2, options.pairs)
    heights = (high - low) / (options.step or 2 * cell * options.detail)
    return (CELL_S + IMAGE_S * len(items) + PAIR_S * heights * pairs) / options.detail**2


def known_surroundings(scene: Scene, items: list[Item], fine: Grid) -> Grid:
    """The area with what stands around it; without, where that is not known.

    Args:
        scene: with a height range.
        items: the images.
        fine: the area on any cells.
    """
    shapes = [tuple(item.properties.get("proj:shape") or ()) for item in items]
    if not all(shapes):
        return fine
    try:
        cameras = [RPC.from_file(scene.path(item.assets["rpc"].href)) for item in items]
    except (SattoolsError, KeyError):  # which the command will tell
        return fine
    return with_surroundings(fine, cameras, shapes, matching_height(scene.require_height_range()), scene.surroundings_m)


def _planned(scene: Scene, items: list[Item], wide: Grid, options: PriorOptions, edge: int | None) -> MatchingPlan:
    tiles = tiled.tiles_of(wide, edge) if edge else []
    parts = [tile.grid for tile in tiles] or [wide]
    most = _part_bytes(scene, items, max(parts, key=lambda part: part.width * part.height), options)
    if tiles:  # the images of all of them are held on coarse cells
        coarse = tiled.coarse_of(wide, tiles)
        most += COMMON_BYTES + coarse.width * coarse.height * BYTES_PER_BAND * sum(_bands(item) for item in items)
    cells = sum(part.width * part.height for part in parts)
    seconds = START_S + cells * seconds_per_cell(scene, items, wide.cell_size, options)
    return MatchingPlan(edge, len(parts), BASE_BYTES + most, seconds, edge)


def _part_bytes(scene: Scene, items: list[Item], part: Grid, options: PriorOptions) -> float:
    """Bytes that matching a part at once takes beside the program."""
    low, high = scene.require_height_range()
    cell = part.cell_size * options.detail
    rows, cols = (round(edge / options.detail) for edge in part.shape)
    step = options.step or 2 * cell
    beyond = 2 * BEYOND_PLANES * step
    parallax = np.array([math.tan(math.radians(_off_nadir(item))) for item in items]) / cell
    z_ref = matching_height((low, high))
    margin = margin_for(parallax, z_ref, (low - beyond, high + beyond), options.window)
    framed = (rows + 2 * margin) * (cols + 2 * margin)
    images = sum(BYTES_PER_IMAGE + BYTES_PER_BAND * _bands(item) for item in items)
    kept = math.ceil(KEPT_HEIGHTS * len(planes((low, high), step)))
    volume = volume_bytes((rows, cols), kept, options.memory, options.rough_passes > 0)
    rough = volume_bytes((rows // 2, cols // 2), len(planes((low, high), 2 * step)), options.memory, False)
    return framed * images + max(volume, rough)


def _bands(item: Item) -> int:
    return int(item.properties.get("sattools:bands") or 1)


def _off_nadir(item: Item) -> float:
    """Angle of the line of sight on the ground from the vertical [degrees]."""
    for name in ("view:incidence_angle", "view:off_nadir"):
        if item.properties.get(name) is not None:
            return float(item.properties[name])
    return OFF_NADIR_DEG


def _beyond_start(plan: MatchingPlan) -> float:
    """Bytes that are still to be taken by a program that has started, and has not loaded all that it needs."""
    return plan.memory - min(BASE_BYTES, system.memory_taken())


__all__ = [
    "START_S", "MatchingPlan", "check_fits", "foresee_matching", "known_surroundings", "matching_bytes",
    "plan_matching", "seconds_per_cell", "warn_of_tiles",
]  # fmt: skip

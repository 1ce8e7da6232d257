"""What a fit will take, said before it begins: area, cells, tiles, memory, minutes; and tiles that fit into memory."""

from __future__ import annotations

import logging
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from sattools.errors import SceneError, counted
from sattools.fit.combinations import step_bytes
from sattools.fit.options import FitOptions
from sattools.fit.presets import with_preset
from sattools.fit.surface.passes import FEWEST_EPOCHS, cells_of, epochs_of
from sattools.fit.tiles.state import begun
from sattools.prior.cells import grids
from sattools.prior.foresight import START_S, known_surroundings, matching_bytes, seconds_per_cell
from sattools.prior.options import PriorOptions
from sattools.processors import takes, threads
from sattools.scene import Grid, Scene
from sattools.scene.grid import AROUND_TILE_M, SURROUNDINGS_M
from sattools.scene.memory import available, to_spend
from sattools.scene.tiles import widest_part

log = logging.getLogger(__name__)
# what goes with tiles, and why nothing else does
IN_TILES = (
    ("field", "surface", "a field of rays has no maps to join"),
    ("brdf", "lambert", "materials are found for an area as a whole"),
    ("budget", None, "a tile needs the time it needs"),
    ("reference", None, "the surface is whole only at the end (`sattools compare` scores it)"),
)
TILE_SIZES_M = (1024.0, 512.0, 256.0)
LARGEST_AT_ONCE_M = 1024.0  # beyond it tiles cost nothing and keep progress
# Measured by `benchmarks/foresight.py` on simulated cities and a real one, one thread
BASE_BYTES = 450e6
BYTES_PER_CELL = 1000.0
BYTES_PER_CELL_AND_IMAGE = 250.0
WORTH_STARTS = 4.0  # CPU seconds of a process over those of its start, at least
FIT_S = 7.5e-7  # CPU seconds per cell and image, with the passes that a fit has by default
# of these, what is there once (the albedo's solution); what passes take with a reflectance model or learned shadows
ONCE, HARDER = 0.5, 2.0
# of a fit on cells of its own (`--resolution`), beyond those of twice the grid's cell that it has otherwise
FITTED_CELLS = 0.25
BYTES_PER_FITTED_CELL_AND_IMAGE = 110.0
FITTED_S = 3.2e-6


@dataclass(frozen=True)
class Foresight:
    """What a fit will take, roughly.

    Attributes:
        area_km2: of the scene's grid.
        cells: of the grid.
        images: for training.
        tiles: pieces that are fitted by themselves; 1 = all at once.
        tile_m: their edge [m], or None.
        beside: pieces that are fitted at a time.
        memory: bytes at a time.
        cpu_s: CPU seconds; None = not foretold.
        training: how a field of rays is trained, in words.
    """

    area_km2: float
    cells: int
    images: int
    tiles: int
    tile_m: float | None
    beside: int
    memory: float
    cpu_s: float | None
    training: str = ""

    def __str__(self) -> str:
        if self.cpu_s is None:
            what = f"{self.area_km2:.3g} km2, {self.cells} cells, {self.images} images, {self.training}"
            return f"{what}: at least {self.memory / 2**30:.1f} GiB of memory"
        how = f"{self.tiles} tiles of {self.tile_m:g} m" if self.tile_m else "all at once"
        if self.beside > 1:
            how += f", {self.beside} at a time"
        what = f"{self.area_km2:.3g} km2, {self.cells} cells, {self.images} images, {how}"
        return f"{what}: {takes(self.memory, self.cpu_s)}"


def foresee(scene: Scene, options: FitOptions) -> Foresight:
    """What `fit` will take, with tiles if the options ask for them.

    Raises:
        SceneError: a scene without grid or height range, or options that do not go with tiles.
    """
    grid = scene.require_grid()
    images = len(scene.train_items())
    tile = chosen_tile(scene, options)
    if tile:
        check_tiled(options)
    cells = grid.width * grid.height
    if options.field != "surface":
        memory = _bytes(cells, images, 0.0) + step_bytes(options)
        area = cells * grid.cell_size**2 / 1e6
        return Foresight(area, cells, images, 1, None, 1, memory, None, _training(options))
    tiles, piece, work = _cut(grid, tile, options.overlap)
    # of a tile the overlap is the most of what stands around it
    around = _with_surroundings(scene) if tiles == 1 else 1.0
    seconds = work * _seconds_per_cell(scene, options, around)
    area = cells * grid.cell_size**2 / 1e6
    finer = _finer(grid.cell_size, options)
    each = max(_bytes(piece, images, finer), _matching_bytes(scene, options, piece * around))
    beside = 1
    if tiles > 1:
        beside = side_by_side(scene, options, tiles)
    return Foresight(area, cells, images, tiles, tile if tiles > 1 else None, beside, beside * each, START_S + seconds)


def plan_of(options: FitOptions) -> str:
    """What a fit does, in words."""
    if options.field == "surface":
        return "fit the surface" if options.brdf == "lambert" else f"fit the surface with --brdf {options.brdf}"
    return f"train the network {options.network}" if options.field == "mlp" else f"train a {options.field} field"


def _training(options: FitOptions) -> str:
    steps = f"at most {counted(options.steps, 'steps')} of {counted(options.rays, 'rays')}"
    if options.budget:
        return f"{steps}, ended by --budget {options.budget:g} s after the matching"
    return f"{steps}, whose seconds are not foretold (its progress tells them; --budget SECONDS ends it in time)"


def _cut(grid: Grid, tile: float | None, overlap: float) -> tuple[int, float, float]:
    """Number of tiles, cells of the largest, and of all together; one tile for None."""
    if not tile:
        return 1, float(grid.width * grid.height), float(grid.width * grid.height)
    # of a narrow overlap more is matched around a tile (`AROUND_TILE_M`), but for what any area has around it
    longest, margin = tile / grid.cell_size, max(overlap, AROUND_TILE_M - SURROUNDINGS_M) / grid.cell_size
    along = [max(1, math.ceil(edge / longest)) for edge in grid.shape]
    piece = math.prod(min(widest_part(edge, longest, margin), edge) for edge in grid.shape)
    work = math.prod(edge + 2 * margin * (n - 1) for edge, n in zip(grid.shape, along, strict=True))
    return along[0] * along[1], piece, work


def _seconds_per_cell(scene: Scene, options: FitOptions, matched: float = 1.0) -> float:
    """CPU seconds per cell of the grid, where the matching of a prior has so many times as many."""
    images, cell = len(scene.train_items()), scene.require_grid().cell_size
    seconds = (FIT_S + FITTED_S * _finer(cell, options)) * _passes(scene, options) * images
    if options.prior_weight > 0 and "prior_dsm" not in scene.products:
        seconds += matched * _matching_s(scene)
    return seconds


def _passes(scene: Scene, options: FitOptions) -> float:
    """What a fit takes over what it takes with the passes over all views that uncalibrated images have by default."""
    with_prior = options.prior_weight > 0
    relative = all(item.properties.get("sattools:radiance", "relative") == "relative" for item in scene.train_items())
    cells = cells_of(options, scene.require_grid().cell_size, with_prior)
    epochs = epochs_of(options, len(cells), with_prior, relative)
    work = sum(count * (cells[-1] / cell) ** 2 for cell, count in zip(cells, epochs, strict=True)) / FEWEST_EPOCHS
    harder = options.brdf != "lambert" or options.shadow in ("learned", "auto")
    return ONCE + (1 - ONCE) * work * (HARDER if harder else 1.0)


def _matching_s(scene: Scene) -> float:
    """CPU seconds of the matching per cell of the grid, which may be matched on finer ones."""
    items = scene.train_items()
    grid, fine = grids(scene, items, PriorOptions())
    return seconds_per_cell(scene, items, fine.cell_size, PriorOptions()) * (grid.cell_size / fine.cell_size) ** 2


def _with_surroundings(scene: Scene) -> float:
    """Cells that are matched, what stands around the area included, per cell of the area; 1 where that is not known."""
    grid = scene.require_grid()
    wide = known_surroundings(scene, scene.train_items(), grid)
    return wide.width * wide.height / (grid.width * grid.height)


def _matching_bytes(scene: Scene, options: FitOptions, cells: float) -> float:
    """Bytes that making the prior takes for a part of so many cells; 0 if it is there.

    That is more than what a fit of them takes where they are matched on finer cells, or much beyond their border.
    """
    if options.prior_weight == 0 or "prior_dsm" in scene.products:
        return 0.0
    grid, fine = grids(scene, scene.train_items(), PriorOptions())
    return matching_bytes(scene, cells * (grid.cell_size / fine.cell_size) ** 2)


def chosen_tile(scene: Scene, options: FitOptions) -> float | None:
    """Edge of a tile [m]; for ``auto`` None where all at once fits into memory, else the largest that does.

    Without a word of the user, tiles are what surely does not fit otherwise, and can be cut. What was begun goes on as
    it was, whatever memory there is now.

    Raises:
        SceneError: a scene without grid, a damaged list of tiles.
    """
    if options.tile is not None and options.tile != "auto":
        return options.tile or None
    cannot = any(getattr(options, name) != wanted for name, wanted, _ in IN_TILES)
    if not cannot and (before := _begun_tile(scene, options)):
        return before
    if options.resume and _begun_at_once(scene):
        return None
    grid = scene.require_grid()
    images = len(scene.train_items())
    if options.tile is None:
        free = available()
        everything = _bytes(grid.width * grid.height, images, _finer(grid.cell_size, options))
        if free is None or cannot or everything <= free:
            return None
    there = to_spend()
    budget = math.inf if there is None else there
    edge = max(grid.shape) * grid.cell_size
    finer = _finer(grid.cell_size, options)
    if edge <= LARGEST_AT_ONCE_M and _bytes(grid.width * grid.height, images, finer) <= budget:
        return None
    sizes = [size for size in TILE_SIZES_M if 2 * options.overlap < size < edge]
    for size in sizes:
        if _bytes(((size + 2 * options.overlap) / grid.cell_size) ** 2, images, finer) <= budget:
            return size
    return sizes[-1] if sizes else None


def side_by_side(scene: Scene, options: FitOptions, tiles: int) -> int:
    """How many of some tiles are fitted at a time: one per thread that the user allows, as far as memory goes.

    One thread each, which brings more than several for one tile (docs/batch.md).
    No more than each has work for, beside its start.

    Raises:
        SceneError: a scene without grid.
    """
    tile = chosen_tile(scene, options)
    there = to_spend()
    # in a program that embeds Python the executable is that program
    if not tile or there is None or threads() == 1 or "python" not in Path(sys.executable or "").name.lower():
        return 1
    grid = scene.require_grid()
    count, piece, work = _cut(grid, tile, options.overlap)
    each = _bytes(piece, len(scene.train_items()), _finer(grid.cell_size, options))
    worth = tiles / count * work * _seconds_per_cell(scene, options) / (WORTH_STARTS * START_S)
    return max(1, min(threads(), tiles, int(there // each), int(worth)))


def check_tiled(options: FitOptions) -> None:
    """Raise SceneError for options that do not go with tiles."""
    if why := why_at_once(options):
        raise SceneError(f"--tile: {why} (without --tile all is fitted at once)")


def why_at_once(options: FitOptions) -> str | None:
    """What of the options does not go with tiles, and why; None where all does."""
    for name, wanted, why in IN_TILES:
        given = getattr(options, name)
        if given != wanted:
            found = f"--{name} {given}"
            if with_preset(options.preset, options.start, options.field).get(name) == given:
                found += f" of --preset {options.preset}"
            expected = "none" if wanted is None else f"--{name} {wanted}"
            return f"found {found}, expected {expected}: {why}"
    return None


def _begun_tile(scene: Scene, options: FitOptions) -> float | None:
    """Edge of the tiles [m] that an interrupted fit has left for this one to go on with."""
    state = begun(scene.root) if options.resume else None
    return state.get("tile") if state else None


def _begun_at_once(scene: Scene) -> bool:
    """Whether an interrupted fit has left a checkpoint of the whole area."""
    from sattools.fit.files import CHECKPOINT  # late: it imports PyTorch, which is slow

    return scene.path(CHECKPOINT).exists()


def with_tile(scene: Scene, options: FitOptions) -> FitOptions:
    """The options with a size of tiles, or none, where that was left open."""
    if options.tile not in ("auto", None):
        return options
    chosen = chosen_tile(scene, options)
    if chosen is not None and chosen == _begun_tile(scene, options):
        log.warning("scene %s: goes on in the tiles of %g m that were begun", scene.id, chosen)
    elif options.tile is None and chosen is not None:
        log.warning("scene %s: needs more memory than is free all at once: fitted in tiles of %g m", scene.id, chosen)
    return options if chosen == options.tile else replace(options, tile=chosen)


def _finer(cell: float, options: FitOptions) -> float:
    """Cells of the fit per cell of the grid [m], beyond those that it has by default."""
    return max(0.0, (cell / options.resolution) ** 2 - FITTED_CELLS) if options.resolution else 0.0


def _bytes(cells: float, images: int, finer: float) -> float:
    per_image = BYTES_PER_CELL_AND_IMAGE + BYTES_PER_FITTED_CELL_AND_IMAGE * finer
    return BASE_BYTES + cells * (BYTES_PER_CELL + per_image * images)


__all__ = [
    "Foresight", "check_tiled", "chosen_tile", "foresee", "plan_of", "side_by_side", "why_at_once",
    "with_tile",
]  # fmt: skip

"""What a fit will take, said before it begins: area, cells, tiles, memory, minutes; and tiles that fit into memory."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace

from sattools.fit.options import FitOptions
from sattools.prior.options import PriorOptions
from sattools.scene import Scene
from sattools.scene.memory import available
from sattools.scene.tiles import widest_part

TILE_SIZES_M = (1024.0, 512.0, 256.0)
LARGEST_AT_ONCE_M = 1024.0  # beyond it tiles cost nothing and keep progress
MEMORY_SHARE = 0.5  # of what is free: other programs want some, and estimates are estimates
# Measured by `benchmarks/foresight.py` on simulated cities and a real one, one thread
BASE_BYTES = 450e6
BYTES_PER_CELL = 1000.0
BYTES_PER_CELL_AND_IMAGE = 250.0
START_S = 4.0
MATCH_S = 1.5e-8  # CPU seconds per cell, height plane and pair of images
FIT_S = 2.0e-6  # CPU seconds per cell and image
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
        tiles: pieces that are fitted one by one; 1 = all at once.
        tile_m: their edge [m], or None.
        memory: bytes at a time.
        cpu_s: CPU seconds.
    """

    area_km2: float
    cells: int
    images: int
    tiles: int
    tile_m: float | None
    memory: float
    cpu_s: float

    def __str__(self) -> str:
        cores = len(os.sched_getaffinity(0))
        how = f"{self.tiles} tiles of {self.tile_m:g} m" if self.tile_m else "all at once"
        minutes = self.cpu_s / 60
        took = f"{minutes:.1f}" if minutes < 10 else f"{minutes:.0f}"
        return (
            f"{self.area_km2:.3g} km2, {self.cells} cells, {self.images} images, {how}: about "
            f"{self.memory / 2**30:.1f} GiB of memory and {took} CPU minutes (this machine has {cores} cores)"
        )


def foresee(scene: Scene, options: FitOptions) -> Foresight:
    """What `fit` will take, with tiles if the options ask for them.

    Raises:
        SceneError: a scene without grid or height range.
    """
    grid = scene.require_grid()
    images = len(scene.train_items())
    tile = chosen_tile(scene, options)
    low, high = scene.require_height_range()
    pairs = min(images * (images - 1) // 2, PriorOptions().pairs) if options.prior_weight > 0 else 0
    planes = (high - low) / (2 * grid.cell_size)
    cells = grid.width * grid.height
    tiles, piece, work = 1, float(cells), float(cells)
    if tile:
        longest, margin = tile / grid.cell_size, options.overlap / grid.cell_size
        along = [max(1, math.ceil(edge / longest)) for edge in grid.shape]
        tiles = along[0] * along[1]
        piece = math.prod(widest_part(edge, longest, margin) for edge in grid.shape)
        work = math.prod(edge + 2 * margin * (n - 1) for edge, n in zip(grid.shape, along, strict=True))
    finer = _finer(grid.cell_size, options)
    seconds = START_S + work * (MATCH_S * planes * pairs + (FIT_S + FITTED_S * finer) * images)
    area = cells * grid.cell_size**2 / 1e6
    return Foresight(area, cells, images, tiles, tile if tiles > 1 else None, _bytes(piece, images, finer), seconds)


def chosen_tile(scene: Scene, options: FitOptions) -> float | None:
    """Edge of a tile [m]; for ``auto`` None where all at once fits into memory, else the largest that does.

    Raises:
        SceneError: a scene without grid.
    """
    if options.tile != "auto":
        return options.tile or None
    grid = scene.require_grid()
    images = len(scene.train_items())
    there = available()
    budget = math.inf if there is None else MEMORY_SHARE * there
    edge = max(grid.shape) * grid.cell_size
    finer = _finer(grid.cell_size, options)
    if edge <= LARGEST_AT_ONCE_M and _bytes(grid.width * grid.height, images, finer) <= budget:
        return None
    sizes = [size for size in TILE_SIZES_M if 2 * options.overlap < size < edge]
    for size in sizes:
        if _bytes(((size + 2 * options.overlap) / grid.cell_size) ** 2, images, finer) <= budget:
            return size
    return sizes[-1] if sizes else None


def with_tile(scene: Scene, options: FitOptions) -> FitOptions:
    """The options with ``auto`` resolved."""
    return replace(options, tile=chosen_tile(scene, options)) if options.tile == "auto" else options


def _finer(cell: float, options: FitOptions) -> float:
    """Cells of the fit per cell of the grid [m], beyond those that it has by default."""
    return max(0.0, (cell / options.resolution) ** 2 - FITTED_CELLS) if options.resolution else 0.0


def _bytes(cells: float, images: int, finer: float) -> float:
    per_image = BYTES_PER_CELL_AND_IMAGE + BYTES_PER_FITTED_CELL_AND_IMAGE * finer
    return BASE_BYTES + cells * (BYTES_PER_CELL + per_image * images)


__all__ = ["Foresight", "chosen_tile", "foresee", "with_tile"]

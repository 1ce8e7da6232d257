"""The coarse-to-fine schedule of the fit."""

from __future__ import annotations

import math
from dataclasses import replace

from sattools.errors import SceneError
from sattools.fit.options import FitOptions
from sattools.fit.surface.passes import cells_of, epochs_of
from sattools.fit.surface.trainer import StageSettings
from sattools.prior.cells import grids
from sattools.prior.options import PriorOptions
from sattools.scene import Scene


def schedule(
    options: FitOptions,
    cell: float,
    z_range: tuple[float, float],
    with_prior: bool,
    shortest_m: float = math.inf,
    *,
    relative: bool = False,
) -> list[StageSettings]:
    """Stages from the coarsest to the finest cell, each half as wide as the one before.

    A prior is a better start than any coarse stage: with one, the fit starts on the finest grid.

    Args:
        options: `resolution`, `coarsest`, `epochs`, `softness`.
        cell: half the finest one [m], see `own_cell`.
        z_range: lowest and highest height [m].
        with_prior: a depth prior is there.
        shortest_m: shorter side of the area [m]; stages that would have next to no cells are left out.
        relative: the images are not calibrated.

    Raises:
        SceneError: options that make no schedule.
    """
    if min(options.softness) <= 0:
        raise SceneError(f"--softness: found {options.softness}, expected positive numbers")
    if options.epochs and min(options.epochs) < 1:
        raise SceneError(f"--epochs: found {options.epochs}, expected positive numbers")
    cells = cells_of(options, cell, with_prior, shortest_m)
    epochs = epochs_of(options, len(cells), with_prior, relative)
    first, last = options.softness
    stages = [StageSettings(c, n, (first * c, last * c), z_range) for c, n in zip(cells, epochs, strict=True)]
    return stages if options.brdf in ("lambert", "auto") else [*stages[:-1], *_pretrained(stages[-1], options.pretrain)]


def own_cell(scene: Scene) -> float:
    """Half the finest cell of a fit [m]: the grid's, or less where wide cells are matched as means of finer ones.

    Rendering, too, takes wide cells that hold roof and street for roof.
    """
    grid, fine = grids(scene, scene.train_items(), PriorOptions())
    return max(fine.cell_size, grid.cell_size / 2)


def _pretrained(stage: StageSettings, share: float) -> list[StageSettings]:
    """A stage in two: a share of its epochs without, the rest with a reflectance model; softness goes on falling."""
    before = min(round(share * stage.epochs), stage.epochs - 1)
    first, last = stage.softness
    middle = first * (last / first) ** (before / stage.epochs)
    later = replace(stage, epochs=stage.epochs - before, softness=(middle, last), reflective=True)
    return [replace(stage, epochs=before, softness=(first, middle)), later] if before else [later]


__all__ = ["own_cell", "schedule"]

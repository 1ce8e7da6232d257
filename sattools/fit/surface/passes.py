"""How fine the cells of a surface's fit are, stage by stage, and how often each sees all views; without PyTorch."""

from __future__ import annotations

import math

from sattools.fit.options import FitOptions

EPOCHS = 16
FEW_EPOCHS, FEWEST_EPOCHS = 8, 5  # with a matched surface: in general, of uncalibrated images
LEAST_COARSE_CELLS = 4  # of a stage along the area's shorter side


def cells_of(options: FitOptions, cell: float, with_prior: bool, shortest_m: float = math.inf) -> list[float]:
    """Cells of the stages [m], from the coarsest to the finest, each half as wide as the one before.

    A prior is a better start than any coarse stage: with one, the fit starts on the finest grid.

    Args:
        options: `resolution`, `coarsest`.
        cell: half the finest one [m], unless a resolution is asked for.
        with_prior: a depth prior is there.
        shortest_m: shorter side of the area [m]; stages that would have next to no cells are left out.
    """
    finest = options.resolution or 2 * cell
    coarsest = options.coarsest or (finest if with_prior else 4 * finest)
    cells = [finest]
    while cells[0] * 2 <= coarsest * (1 + 1e-9) and cells[0] * 2 * LEAST_COARSE_CELLS <= shortest_m:
        cells.insert(0, cells[0] * 2)
    return cells


def epochs_of(options: FitOptions, stages: int, with_prior: bool, relative: bool) -> list[int]:
    """Passes over all views of every stage; the last one given holds for all further stages.

    A matched surface needs fewer, unless light is to be learned, too. From the fourth pass on the surface of JAX_068 or
    of a simulated city changes by less than a centimetre; heights and parameters of reflectance models are as good
    after 8 passes as after 16. Lambertian fits of images on which nothing is calibrated predict a view as well after 5;
    of calibrated ones by 0.1 to 0.6 dB worse, with the same heights.

    Args:
        options: `epochs`, and what is to be learned.
        stages: their number.
        with_prior: a depth prior is there.
        relative: the images are not calibrated.
    """
    usual = FEWEST_EPOCHS if relative and options.brdf == "lambert" else FEW_EPOCHS
    epochs = options.epochs or [EPOCHS if not with_prior or _learns_light(options) else usual]
    return [epochs[min(k, len(epochs) - 1)] for k in range(stages)]


def _learns_light(options: FitOptions) -> bool:
    """Whether shadows or transients are to be learned, as far as it is known."""
    return options.shadow in ("learned", "auto") or options.transient != "off"


__all__ = ["EPOCHS", "FEWEST_EPOCHS", "FEW_EPOCHS", "cells_of", "epochs_of"]

"""The coarse-to-fine schedule of the fit."""

from __future__ import annotations

from sattools.fit.options import FitOptions
from sattools.fit.train import StageSettings


def schedule(options: FitOptions, finest: float, z_range: tuple[float, float]) -> list[StageSettings]:
    """Stages from the coarsest to the finest cell, each half as wide as the one before.

    Args:
        options: `coarsest`, `epochs`, `softness`; shorter lists are continued with their last value.
        finest: cell of the last stage [m].
        z_range: lowest and highest height [m].
    """
    cells = [finest]
    while cells[0] * 2 <= options.coarsest * (1 + 1e-9):
        cells.insert(0, cells[0] * 2)

    def at(values: list, k: int):  # type: ignore[no-untyped-def]
        return values[min(k, len(values) - 1)]

    return [
        StageSettings(cell, at(options.epochs, k), (at(options.softness, k), at(options.softness, k + 1)), z_range)
        for k, cell in enumerate(cells)
    ]


__all__ = ["schedule"]

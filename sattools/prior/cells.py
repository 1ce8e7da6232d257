"""The cells on which images are matched."""

from __future__ import annotations

import math

from sattools.prior.options import PriorOptions
from sattools.scene import Grid, Item, Scene
from sattools.scene.grid import default_cell_size, finer_pixel

COARSE, FINE = 1.5, 0.6  # times as wide as cells that suit the pixels, beyond which cells are not matched themselves


def grids(scene: Scene, items: list[Item], options: PriorOptions) -> tuple[Grid, Grid]:
    """Grid of the result, and that on which the images are matched.

    Windows of cells much wider than pixels see roof and street at once, and the roof wins. So a surface of such cells
    is the mean of one of finer cells. Windows much narrower than pixels see noise, so a surface of such cells lies
    between the cells of a coarser one. Who asks for a ``resolution`` is matched on that.

    Args:
        scene: with a grid.
        items: the images.
        options: of the matching.
    """
    whole = scene.require_grid()
    if options.resolution:
        grid = whole.resized(options.resolution)
        return grid, grid
    sizes = [float(item.properties.get("gsd") or 0.0) for item in items]
    if not all(size > 0 for size in sizes):
        return whole, whole
    times = whole.cell_size / default_cell_size(finer_pixel(sizes))
    if times > COARSE:
        return whole, whole.resized(whole.cell_size / math.ceil(times - 1e-6))
    return whole, whole.resized(whole.cell_size * (round(1 / times) if times < FINE else 1))


__all__ = ["grids"]

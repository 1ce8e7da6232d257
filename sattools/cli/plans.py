"""What commands say before they begin: area, cells, images, memory, CPU time, and what they write.

The figures are straight lines through what `benchmarks/memory.py`, `benchmarks/threads.py` and
`benchmarks/full_scene.py` have measured (docs/batch.md), from a crop of 0.07 km2 to 27 km2 and images of 40,000 x
40,000 pixels; `fit` knows its own (`sattools.fit.foresight`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from sattools.errors import counted
from sattools.processors import takes

if TYPE_CHECKING:
    from sattools.prior.options import PriorOptions
    from sattools.scene import Grid, Scene

Plan = Callable[["Scene"], str]
_GIB = 2**30


def _on_cells(writes: str, memory: float, start_s: float, cell_s: float, image_s: float = 0.0) -> Plan:
    """Of a command that reads maps: seconds of its start, for each cell, and for each cell of each image."""

    def said(scene: Scene) -> str:
        if scene.grid is None:  # the command knows whether it needs one
            return f"writes {writes}"
        cells, images = _cells(scene), len(scene.train_items())
        return f"{_size(scene)}: {takes(memory, start_s + cells * (cell_s + images * image_s))}; writes {writes}"

    return said


def of_prior(options: PriorOptions, overwrite: bool = True) -> Plan:
    """Of `prior`.

    Args:
        options: of the matching.
        overwrite: it begins anew.
    """

    def said(scene: Scene) -> str:
        from sattools.prior.foresight import foresee_matching

        if scene.grid is None or scene.height_range_m is None:
            return "writes prior/"
        plan = foresee_matching(scene, options, overwrite)
        done = f" ({plan.done} of them matched before)" if plan.done else ""
        tiles = f", in {counted(plan.tiles, 'tiles')}{done}" if plan.edge else ""
        return f"{_size(scene)}{tiles}: {takes(plan.memory, plan.cpu_s)}; writes prior/"

    return said


def of_normalise(scene: Scene) -> str:
    """Of `normalise`."""
    shapes = [item.properties.get("proj:shape") for item in scene.items]
    pixels = sum(int(shape[0]) * int(shape[1]) for shape in shapes if shape)
    taken = takes(0.14 * _GIB, 1.0 + 4e-8 * pixels)
    return f"{counted(len(scene.items), 'images')}, {pixels / 1e6:.3g} megapixels: {taken}; writes radiance/"


def of_prep(shapes: Iterable[tuple[int, int]]) -> str:
    """Of `prep`: larger images are read at a lower resolution and in windows.

    Args:
        shapes: rows and columns of the images.
    """
    from sattools.prep.images import memory_needed

    shapes = list(shapes)
    sizes = [rows * cols for rows, cols in shapes]
    seconds = 1.5 + sum(1e-3 * size**0.5 for size in sizes)
    taken = takes(memory_needed(shapes), seconds)
    return f"{counted(len(sizes), 'images')}, {sum(sizes) / 1e6:.3g} megapixels: {taken}"


def of_simulate(size_m: float, gsd_m: float, views: int) -> str:
    """Of `simulate`: rays of all images.

    Args:
        size_m: edge of the scene.
        gsd_m: edge of a pixel.
        views: images.
    """
    pixels = views * (size_m / gsd_m) ** 2
    taken = takes(0.2 * _GIB + 80 * pixels, 1.0 + 6.5e-6 * pixels)
    return f"{size_m**2 / 1e6:.3g} km2, {counted(views, 'images')}, {pixels / 1e6:.3g} megapixels: {taken}"


def of_change(grid: Grid) -> str:
    """Of `change`.

    Args:
        grid: of the earlier surface.
    """
    cells = grid.width * grid.height
    return f"{cells * grid.cell_size**2 / 1e6:.3g} km2, {cells} cells: {takes(0.25 * _GIB, 1.0 + 1.2e-6 * cells)}"


def _cells(scene: Scene) -> int:
    grid = scene.require_grid()
    return grid.width * grid.height


def _size(scene: Scene) -> str:
    area = _cells(scene) * scene.require_grid().cell_size ** 2 / 1e6
    return f"{area:.3g} km2, {_cells(scene)} cells, {counted(len(scene.train_items()), 'images')}"


of_export = _on_cells("export/", 0.4 * _GIB, 1.2, 8e-7, 2e-7)
of_compare = _on_cells("compare/", 0.3 * _GIB, 1.0, 1.6e-6)
of_align = _on_cells("the moved scene", 0.21 * _GIB, 2.0, 1.3e-6)

__all__ = [
    "Plan",
    "of_align",
    "of_change",
    "of_compare",
    "of_export",
    "of_normalise",
    "of_prep",
    "of_prior",
    "of_simulate",
]

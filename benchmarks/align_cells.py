"""How far `align` brings an exported scene from where fine cells put it, on references of larger and larger cells.

    python benchmarks/align_cells.py SCENE.json --truth TRUTH --cells 5 10 20

TRUTH is a georeferenced raster of heights, or a folder of the Data Fusion Contest 2019 that has the scene's. It is
averaged to cells of each size on four lattices, and the surface aligned with each: by closest points, by means that
count all cells alike, and by means that count them by the surface's own errors, as the command does. Printed are the
mean shift, the largest distance from where the truth's own cells put the surface (closest points), and how well a
move of (3, -2, 5) m is found: how far what is found for the moved surface differs from that and what is found for the
one that was not moved [m].
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sattools.align.estimate import Method, shift_to_dem
from sattools.compare.truth import read_dfc2019, read_reference
from sattools.errors import InputError
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster
from sattools.scene.regrid import resize_map
from sattools.scene.validity import MEASURED

MOVED = np.array([3.0, -2.0, 5.0])
LATTICES = ((0.0, 0.0), (0.5, 0.5), (0.3, 0.7), (0.8, 0.2))  # begin so many cells from the truth's corner


def averaged(height: np.ndarray, grid: Grid, cell: float, begin: tuple[float, float]) -> tuple[np.ndarray, Grid]:
    """The truth on larger cells whose lattice begins at a part of one."""
    rows, columns = (round(part * cell / grid.cell_size) for part in begin)
    part = grid.part(slice(rows, grid.height), slice(columns, grid.width))
    large = part.resized(cell)
    large = large.part(slice(0, large.height - 1), slice(0, large.width - 1))  # the last ones may be cut off
    return resize_map(height[rows:, columns:], part, large), large


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scene", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--cells", type=float, nargs="+", default=[5.0, 10.0, 20.0])
    options = parser.parse_args()
    scene = Scene.from_file(options.scene)
    maps = [read_raster(scene.path(scene.products[name])) for name in ("dsm", "validity", "dsm_error95")]
    grid = maps[0][1]
    heights, validity, error = (array[0] for array, _ in maps)
    height = np.where(validity == MEASURED, heights, np.nan).astype(np.float32)
    truth = read_dfc2019(options.truth, scene.id) if options.truth.is_dir() else read_reference(options.truth)

    def found(onto: np.ndarray, onto_grid: Grid, method: Method, errors: np.ndarray | None, moved: bool) -> np.ndarray:
        surface, there = (height + np.float32(MOVED[2]), grid.moved(*MOVED[:2])) if moved else (height, grid)
        try:
            shift = shift_to_dem(surface, there, onto, onto_grid, method, error=errors)
        except InputError as refused:
            print(f"  {method}: {refused}")
            return np.full(3, np.nan)
        return np.array([shift.east, shift.north, shift.up])

    fine = found(truth.heights, truth.grid, "icp", None, False)
    print(f"{scene.id}: cells of {truth.grid.cell_size:g} m put it at", np.round(fine, 3))
    ways: list[tuple[str, Method, np.ndarray | None]]
    ways = [("closest points", "icp", None), ("means, alike", "means", None), ("means, by errors", "means", error)]
    for cell in options.cells:
        for name, method, errors in ways:
            references = [averaged(truth.heights, truth.grid, cell, begin) for begin in LATTICES]
            own = np.array([found(*reference, method, errors, False) for reference in references])
            back = np.array([found(*reference, method, errors, True) for reference in references]) - own + MOVED
            off = np.hypot(*(own - fine)[:, :2].T).max()
            print(f"  {cell:4g} m  {name:17s}", np.round(own.mean(axis=0), 3), f"at most {off:.2f} off;", end=" ")
            print(f"the move is found to {np.abs(back).max():.3f}", flush=True)


if __name__ == "__main__":
    main()

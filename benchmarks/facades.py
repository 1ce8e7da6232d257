"""Where are the walls? Position error of facades on scenes whose reference has vertical walls (simulated cities).

    python benchmarks/facades.py SCENE/scene.json DSM [--product dsm]

Scenes are scored after registration as `sattools compare` does it, by whole cells, and moved by what all walls have in
common besides; what a wall and its place are says `sattools.compare.facades`. After all walls come those of less than
15 m, of 15 to 50 m, and the higher ones.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

from sattools.compare import compare_dsm, read_reference
from sattools.compare.facades import find_walls, wall_figures
from sattools.scene import Scene
from sattools.scene.raster import raster_grid

GROUPS_M = (0.0, 15.0, 50.0, float("inf"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene.json with the product")
    parser.add_argument("dsm", type=Path, help="reference DSM; a class map beside it (_CLS.tif) is used")
    parser.add_argument("--product", action="append", help="dsm and prior_dsm if not given; repeatable")
    options = parser.parse_args()
    scene = Scene.from_file(options.scene)
    classes = options.dsm.with_name(options.dsm.name.replace("_DSM", "_CLS"))
    truth = read_reference(options.dsm, classes if classes != options.dsm and classes.exists() else None)
    for name in options.product or ["prior_dsm", "dsm"]:
        path = scene.path(scene.products[name])
        result = compare_dsm(path, truth)
        registered = truth.heights + result.difference
        print(f"{options.scene}: {name} (cells of {raster_grid(path).cell_size:g} m)")
        walls = find_walls(registered, truth.heights, truth.grid.cell_size, truth.classes)
        for heights in [(0.0, GROUPS_M[-1]), *pairwise(GROUPS_M)]:
            f = wall_figures(walls.between(heights).offset)
            moved = wall_figures(walls.without_shift().between(heights).offset)
            if f["median"] is not None:
                print(
                    f"  {heights[0]:g} to {heights[1]:g} m, {f['pieces']} pieces of wall: median {f['median']:.2f} m, "
                    f"90 % within {f['p90']:.2f} m, {f['mean']:+.2f} m outward, "
                    f"none found at {100 * f['missing']:.1f} %; without what all are shifted by "
                    f"{moved['median']:.2f}, {moved['p90']:.2f}, {moved['mean']:+.2f} m"
                )


if __name__ == "__main__":
    main()

"""Where are the walls? Position error of facades on scenes whose reference has vertical walls (simulated cities).

    python benchmarks/facades.py SCENE/scene.json DSM [--product dsm]

Scenes are scored after registration as `sattools compare` does it; what a wall and its place are says
`sattools.compare.facades`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from sattools.compare import compare_dsm, read_reference
from sattools.compare.facades import wall_figures, wall_offsets
from sattools.scene import Scene
from sattools.scene.raster import raster_grid


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
        f = wall_figures(wall_offsets(registered, truth.heights, truth.grid.cell_size, truth.classes))
        cell = raster_grid(path).cell_size
        print(
            f"{options.scene}: {name} (cells of {cell:g} m), {f['pieces']} pieces of wall: "
            f"median {f['median']:.2f} m, 90 % within {f['p90']:.2f} m, {f['mean']:+.2f} m outward, "
            f"none found at {100 * f['missing']:.1f} %"
        )


if __name__ == "__main__":
    main()

"""What tiles have laid level as water is known of the whole that is joined of them."""

from dataclasses import replace
from typing import Any

import numpy as np

from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.scene import Scene
from sattools.scene.raster import read_raster, write_cog

TILED = FitOptions(resolution=1.0, epochs=[1], tile=32.0, overlap=8.0)


def test_water_of_a_tile_is_that_of_the_whole(make_town: Any) -> None:
    """Half of what tiles share is the share of each; tiles of an earlier version do not say."""
    scene = make_town()
    for name in fit(scene, replace(TILED, part="split"))["tiles"]:
        part = Scene.from_file(scene.root / f"fit/tiles/{name}/scene.json")
        fit(part, TILED)
    north_west, south_east = (scene.root / f"fit/tiles/{name}/prior/water.tif" for name in ("r0c0", "r1c1"))
    laid, grid = read_raster(north_west)
    write_cog(north_west, np.ones_like(laid), grid, nodata=None)
    south_east.unlink()
    fit(scene, replace(TILED, part="mosaic"))
    found, whole = read_raster(scene.path(scene.products["prior_water"]))
    rows, cols = (round(32.0 / whole.cell_size) + edge for edge in (-8, -8))
    assert found.dtype == np.uint8
    assert (found[0, :rows, :cols] == 1).all()
    assert not found[0, rows + 24 :].any()
    assert not found[0, :, cols + 24 :].any()

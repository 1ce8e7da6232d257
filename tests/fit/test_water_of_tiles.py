"""What tiles have laid level as water is known of the whole that is joined of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from in_tiles import TILED
from towns import copied

from sattools.fit.stage import fit
from sattools.scene import Scene
from sattools.scene.raster import read_raster, write_cog


def test_water_of_a_tile_is_that_of_the_whole(finished_tiles: Scene, tmp_path: Path) -> None:
    """Half of what tiles share is the share of each; tiles of an earlier version do not say."""
    scene = copied(finished_tiles, tmp_path / "WATER")
    north_west, south_east = (scene.root / f"fit/tiles/{name}/prior/water.tif" for name in ("r0c0", "r1c1"))
    laid, grid = read_raster(north_west)
    write_cog(north_west, np.ones_like(laid), grid, nodata=None)
    south_east.unlink()
    fit(scene, replace(TILED, part="mosaic"))
    found, whole = read_raster(scene.path(scene.products["prior_water"]))
    rows, cols = (round(16.0 / whole.cell_size) + edge for edge in (-4, -4))
    assert found.dtype == np.uint8
    assert (found[0, :rows, :cols] == 1).all()
    assert not found[0, rows + 12 :].any()
    assert not found[0, :, cols + 12 :].any()

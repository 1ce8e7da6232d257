"""Files that cannot be moved with a scene, and that somebody may have handed on, are named."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sattools
from sattools.scene import Scene
from sattools.scene.raster import read_raster, write_cog

QUICK: dict[str, Any] = {"resolution": 2.0, "coarsest": 2.0, "epochs": [1], "prior_weight": 0.0}


def raised(scene: Scene, folder: Path, **options: Any) -> list[str]:
    """The notes of a scene that is fitted, exported and moved up by 5 m."""
    sattools.export(sattools.fit(scene, options), {"products": "ply,contours"})
    heights, grid = read_raster(scene.path(scene.products["dsm"]))
    write_cog(folder / "higher.tif", heights + np.float32(5.0), grid)
    sattools.align(scene, {"to": folder / "higher.tif", "method": "z"})
    return list(scene.history[-1]["notes"][1:])  # the first is the shift


def test_points_and_contours_of_before_are_named(
    make_hamlet: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """They stayed 5 m too low in the scene's folder, and nobody heard of it."""
    scene = make_hamlet()
    with caplog.at_level(logging.WARNING):
        notes = raised(scene, tmp_path, **QUICK)
    found = "contours, points_ply: not moved, and no products any more; `sattools export --overwrite --products ...` "
    assert notes == [found + "makes them anew"]
    assert f"HAMLET: {notes[0]}" in caplog.messages
    assert "model" in scene.products


def test_a_network_that_stays_is_named(make_hamlet: Any, tmp_path: Path) -> None:
    """`export` found no model later on, and nothing had said why."""
    notes = raised(make_hamlet(), tmp_path, field="neural", steps=1, resolution=2.0)
    assert notes[-1] == "model: not moved, as it is a network's, and no product any more; `sattools fit` makes one anew"

"""The whole pipe in a shell: images with wrong cameras in, a scored surface model out."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sattools.scene import Scene
from sattools.scene.raster import read_raster

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")

PIPE = """
set -euo pipefail
sattools prep town/images/*.tif --metadata town/metadata --id TOWN --out work \
    | sattools fit --epochs 4 --epochs 2 --epochs 2 --resolution 1 \
    | sattools export \
    | tee scene.json \
    | sattools compare --dsm town/truth/TOWN_DSM.tif --classes town/truth/TOWN_CLS.tif 2> table.txt > errors.json
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the pipe has run; the images' own RPCs are up to two pixels off."""
    from sattools.simulate import SimulateOptions, simulate

    folder = tmp_path_factory.mktemp("pipe")
    simulate(SimulateOptions(id="TOWN", size=64.0, views=5, dates=3, bias_px=2.0), folder / "town")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", PIPE], cwd=folder, env={**os.environ, "PATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def scene(folder: Any) -> Scene:
    return Scene.from_file(folder / "scene.json")


def test_the_surface_has_holes_only_where_no_two_images_look_and_lies_in_the_height_range(scene: Any) -> None:
    dsm, grid = read_raster(scene.path(scene.products["dsm"]))
    validity, own = read_raster(scene.path(scene.products["validity"]))
    assert grid == own
    assert grid.cell_size == 1.0
    assert np.array_equal(np.isfinite(dsm), validity > 0)
    # the images overlap in the middle of what any of them shows
    assert np.isfinite(dsm[0, 16:-16, 16:-16]).all()
    low, high = scene.height_range_m
    assert low <= np.nanmin(dsm) < np.nanmax(dsm) <= high


def test_the_surface_is_better_than_a_plane(folder: Any) -> None:
    truth, _ = read_raster(folder / "town/truth/TOWN_DSM.tif")
    figures = json.loads((folder / "errors.json").read_text())
    assert figures["completeness"] > 0.9
    # a short fit on a coarse grid: the plane at the median height is the bar that says it has seen the city at all
    assert figures["mae"] < 0.8 * np.abs(truth - np.median(truth)).mean()
    assert set(figures["classes"]) >= {"ground", "buildings"}
    assert figures["protocol"] == "dsm"
    assert (folder / "table.txt").read_text().startswith("TOWN against TOWN_DSM (dsm)\n  MAE ")


def test_every_command_left_its_history(scene: Any) -> None:
    commands = [entry["command"] for entry in scene.history]
    assert commands == ["prep", "fit", "export"]
    for entry in scene.history:
        assert entry["seconds"] > 0
        assert 50 < entry["peak_memory_mb"] < 4096
        assert entry["versions"]["sattools"]
    assert scene.history[0]["options"]["id"] == "TOWN"
    assert scene.history[1]["options"]["resolution"] == 1.0
    stored = Scene.from_file(scene.root / "scene.json")
    assert [entry["command"] for entry in stored.history] == ["prep", "fit", "export", "compare"]


def test_all_files_that_the_scene_names_are_there_and_no_temporary_ones(scene: Any) -> None:
    for href in scene.products.values():
        assert scene.path(href).is_file(), href
    for item in scene.items:
        for name, asset in item.assets.items():
            assert scene.path(asset.href).is_file(), (item.id, name)
    assert [str(p) for p in scene.root.rglob("*.tmp*")] == []
    assert {"dsm", "albedo", "model", "trace", "tie_points"} <= set(scene.products)


def test_the_adjusted_cameras_agree_better_than_the_raw_ones(scene: Any) -> None:
    adjustment = scene.history[0]["adjustment"]
    assert adjustment["median_after_px"] < 0.4
    assert adjustment["median_after_px"] < 0.5 * adjustment["median_before_px"]


def test_shadow_masks_are_maps_on_the_ground_grid(scene: Any) -> None:
    dsm, grid = read_raster(scene.path(scene.products["dsm"]))
    for item in scene.items:
        mask, own = read_raster(scene.path(item.assets["shadow"].href))
        assert own == grid
        assert set(np.unique(mask)) == {0, 1, 255}
        assert np.array_equal(mask == 255, np.isnan(dsm))
        assert dsm.shape == mask.shape

"""Large areas are exported block by block, with what the same area gives at once."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from sattools.export import blocks as cutting
from sattools.export import validity as looking
from sattools.export.blocks import Surroundings, blocks
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit import stored
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.render import sun_visibility
from sattools.scene import Grid, Scene, cog

QUICK = FitOptions(resolution=1.0, coarsest=2.0, epochs=[2, 2], prior_weight=0.0)


def maps_of(folder: Path) -> dict[str, Any]:
    found = {}
    for path in sorted(folder.rglob("*.tif")):
        with rasterio.open(path) as data:
            found[str(path.relative_to(folder))] = data.read(), data.profile, data.tags(), data.descriptions
    return found


def test_blocks_give_the_maps_of_the_whole(town_source: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = []
    for name in ("ONE", "BLOCKS"):
        shutil.copytree(town_source.root, tmp_path / name)
        scene = Scene.from_json(town_source.to_json())
        scene.root = tmp_path / name
        scenes.append(scene)
    fit(scenes[0], QUICK)
    shutil.copytree(tmp_path / "ONE/fit", tmp_path / "BLOCKS/fit")
    scenes[1].products.update(scenes[0].products)
    scenes[1].history = list(scenes[0].history)
    one = export(scenes[0], ExportOptions())
    for module, name, value in (
        (cutting, "EDGE", 24),
        (cutting, "AT_ONCE", 100),
        (cutting, "_POOL", 4),
        (stored, "IN_MEMORY", 0),
        (stored, "_STRIP_CELLS", 500),
        (looking, "_STRIP_CELLS", 200),
        (cog, "IN_MEMORY", 0),
    ):
        monkeypatch.setattr(module, name, value)
    other = export(scenes[1], ExportOptions())
    assert one["validity"] == pytest.approx(other["validity"], abs=0.002)
    found, expected = maps_of(tmp_path / "BLOCKS/export"), maps_of(tmp_path / "ONE/export")
    assert found.keys() == expected.keys()
    for name, (values, profile, tags, words) in expected.items():
        assert str(found[name][1]) == str(profile)
        assert found[name][2:] == (tags, words)
        # the line of sight is that of the block, not of the whole: a cell at the edge of what is hidden may change
        differ = ~((found[name][0] == values) | (np.isnan(found[name][0]) & np.isnan(values)))
        assert differ.mean() < (0.002 if name == "validity.tif" else 1e-9), name
    assert not list((tmp_path / "BLOCKS").rglob("*.tmp-sattools"))


@pytest.mark.parametrize("sun", [(0.6, 0.3, 0.742), (-0.9, 0.0, 0.436), (0.05, -0.98, 0.19), (0.0, 0.0, 1.0)])
def test_a_block_is_in_the_shadow_of_what_stands_outside_it(sun: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cutting, "EDGE", 16)
    monkeypatch.setattr(cutting, "AT_ONCE", 100)
    monkeypatch.setattr(cutting, "_POOL", 8)
    rng = np.random.default_rng(3)
    height = rng.normal(0, 0.3, (70, 90)).astype(np.float32)
    for row, col in rng.integers(0, 60, (8, 2)):
        height[row : row + 6, col : col + 5] += 9.0
    grid = Grid("EPSG:32633", 500000.0, 5000000.0, 1.0, 90, 70)
    surface = Surroundings(grid, lambda rows, cols: height[rows, cols].copy())
    import torch

    whole = sun_visibility(torch.from_numpy(height), 1.0, sun).numpy()
    cut = blocks(grid)
    assert len(cut) == 30
    for block in cut:
        np.testing.assert_array_equal(surface.lit(block, sun), whole[block.rows, block.cols])

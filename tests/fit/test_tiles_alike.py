"""Tiles that were fitted otherwise than their neighbours are not joined without a word."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from towns import copied

from sattools import api
from sattools.errors import SceneError
from sattools.fit import stage
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.fit.tiles import plan as tile_plan
from sattools.scene import Scene

TILED: dict[str, Any] = {"resolution": 1.0, "epochs": [2], "tile": 16.0, "overlap": 4.0}
NAMES = ["r0c0", "r0c1", "r1c0", "r1c1"]


def fit_tile(scene: Scene, name: str, **others: Any) -> None:
    one = Scene.from_file(scene.root / f"fit/tiles/{name}/scene.json")
    api.fit(one, {"resolution": 1.0, "epochs": [2], **others})


@pytest.fixture(scope="module")
def source(matched_hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene split, and all its tiles fitted by calls of their own; tests must leave its files alone."""
    scene = copied(matched_hamlet_source, tmp_path_factory.mktemp("alike") / "ALIKE")
    scene = api.fit(scene, {**TILED, "part": "split"})
    for name in NAMES:
        fit_tile(scene, name)
    return scene


def tiles_of(source: Scene, root: Path, **others: dict[str, Any]) -> Scene:
    """A copy of the scene with its tiles; by name, what is other for a tile, which is fitted anew."""
    scene = copied(source, root)
    for name, other in others.items():
        shutil.rmtree(root / f"fit/tiles/{name}/fit")
        fit_tile(scene, name, **other)
    return scene


def test_a_tile_of_other_cells_is_refused_by_its_name(source: Scene, tmp_path: Path) -> None:
    """Put in place by row and column, its surface would be scrambled."""
    scene = tiles_of(source, tmp_path / "CELLS", r1c0={"resolution": 2.0})
    with pytest.raises(SceneError, match=r"r1c0/fit/model\.safetensors: found a tile of cells of 2 m, expected 1 m as"):
        api.fit(scene, {**TILED, "part": "mosaic"})
    assert not (Path(scene.root) / "fit/model.safetensors").exists()


def test_options_of_tiles_that_are_not_those_of_the_whole_are_told(
    source: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = tiles_of(source, tmp_path / "OTHER", r0c0={"epochs": [1]}, r1c1={"epochs": [1], "seed": 3})
    scene = api.fit(scene, {**TILED, "part": "mosaic"})
    told = [
        "tiles r0c0, r1c1: found a fit with --epochs 1, expected 2 as this fit is noted with",
        "tile r1c1: found a fit with --seed 3, expected 0 as this fit is noted with",
    ]
    assert [text for text in scene.history[-1]["notes"] if "found a fit with" in text] == told
    assert all(text in caplog.text for text in told)


def test_tiles_of_the_same_options_are_joined_without_a_word(
    source: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Tile size, number of images and where it ran are no differences."""
    scene = tiles_of(source, tmp_path / "SAME", r0c0={"tile": 16.0, "overlap": 4.0, "device": "cpu"})
    scene = api.fit(scene, {**TILED, "part": "mosaic", "views": "all"})
    assert "found a fit with" not in json.dumps(scene.history[-1]) + caplog.text


def test_weights_for_calibrated_images_are_set_once_in_tiles_too(
    make_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Set for the whole and again for its tiles, they were a tenth and five times those of a fit at once."""
    scene = api.normalise(make_hamlet("CALIBRATED"), {"quantity": "toa_reflectance", "scale": "0.0001"})
    given: list[Any] = []

    class Done(Exception):
        """Stands for the fit."""

    def note(scene: Any, options: FitOptions, *rest: Any) -> None:
        given.append(options)
        raise Done

    for module in (stage, tile_plan):
        monkeypatch.setattr(module, "fit_whole", note)
    for tile in (None, 16.0):
        with pytest.raises(Done):
            fit(scene, FitOptions(**{**TILED, "tile": tile}))
    assert replace(given[0], tile=None, resolution=None) == replace(given[1], tile=None, resolution=None)

"""Options of `compare` and `export` that do nothing beside others are told, or refused where scores would be others."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import sattools
from sattools.cli import main
from sattools.compare.options import CompareOptions
from sattools.errors import SattoolsError
from sattools.export.options import ExportOptions
from sattools.scene import Grid, Scene
from sattools.scene.raster import write_cog

GRID = Grid("EPSG:32617", 436000.0, 3357800.0, 1.0, 60, 60)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """A simulated scene whose surface is 2 m too high, with an albedo of three bands."""
    products = {"dsm": "dsm.tif", "albedo": "albedo.tif", "truth_dsm": "truth/SIM_1_DSM.tif"}
    made = Scene("SIM_1", tmp_path / "work", grid=GRID, products=products)
    heights = np.zeros(GRID.shape, np.float32)
    heights[20:30, 20:40] = 10
    write_cog(made.output("truth/SIM_1_DSM.tif"), heights, GRID)
    write_cog(made.output("classes.tif"), np.full(GRID.shape, 2, np.uint8), GRID, nodata=None)
    write_cog(made.output("dsm.tif"), heights + 2, GRID)
    write_cog(made.output("albedo.tif"), np.full((3, *GRID.shape), 0.25, np.float32), GRID)
    return made


def compare(scene: Scene, *arguments: Any) -> Any:
    return CliRunner().invoke(main, ["compare", *map(str, arguments)], input=scene.to_json() + "\n")


@pytest.mark.parametrize("reference", [(), ("--truth", "truth")])
def test_a_class_map_that_would_not_be_used_is_refused(scene: Scene, reference: Any) -> None:
    result = compare(scene, *reference, "--classes", scene.root / "classes.tif")
    assert (result.exit_code, result.stdout) == (2, "")
    assert f"--classes: found {scene.root / 'classes.tif'} without --dsm, expected both" in result.stderr
    assert not (scene.root / "compare").exists()


def test_a_class_map_beside_its_reference_is_used(scene: Scene) -> None:
    reference = scene.root / "truth" / "SIM_1_DSM.tif"
    result = compare(scene, "--dsm", reference, "--classes", scene.root / "classes.tif", "--register", "none")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["classes"]["ground"]["mae"] == 2.0


def test_a_tile_without_a_folder_and_weights_without_views_are_told(scene: Scene) -> None:
    result = compare(scene, "--aoi", "JAX_068", "--lpips-weights", scene.root / "dsm.tif")
    assert result.exit_code == 0, result.stderr
    assert "--aoi does nothing here: expected --truth beside it" in result.stderr
    assert "--lpips-weights does nothing here: expected --views beside it" in result.stderr


@pytest.mark.parametrize("make", [dict, CompareOptions])
def test_from_python_they_are_told_too(scene: Scene, make: Any, caplog: pytest.LogCaptureFixture) -> None:
    sattools.compare(scene, make(aoi="JAX_068", lpips_weights=[str(scene.root / "dsm.tif")]))
    assert "--aoi does nothing here: expected --truth beside it" in caplog.messages
    assert "--lpips-weights does nothing here: expected --views beside it" in caplog.messages


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"ground_width": 60.0}, True),
        (ExportOptions(ground_width=60.0), True),
        ({"ground_width": 60.0, "products": "dtm"}, False),
        (ExportOptions(), False),
        (None, False),
    ],
    ids=str,
)
def test_a_width_of_buildings_without_bare_ground_is_told_from_python(
    scene: Scene, options: Any, told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(SattoolsError, match="model"):  # nothing is fitted
        sattools.export(scene, options)
    assert ("--ground-width does nothing here: expected --products dtm beside it" in caplog.messages) == told


def test_a_scene_beside_others_to_score_is_refused(scene: Scene, tmp_path: Path) -> None:
    scene.write()
    path = scene.root / "scene.json"
    result = CliRunner().invoke(main, ["compare", str(path), f"--fit=A={path}", "--out", str(tmp_path / "out")])
    assert (result.exit_code, result.stdout) == (2, "")
    assert f"found {path} beside --fit, expected it as --fit NAME={path}" in " ".join(result.stderr.split())


@pytest.mark.parametrize(("columns", "told"), [("albdo_1,foo", True), ("albedo,foo", True), ("albedo_1,foo", False)])
def test_samples_of_no_map_of_the_scene_are_told(scene: Scene, tmp_path: Path, columns: str, told: bool) -> None:
    path = tmp_path / "samples.csv"
    path.write_text(f"name,x,y,{columns}\nrock,436010,3357790,0.5,7\n")
    result = compare(scene, "--points", path)
    assert result.exit_code == 0, result.stderr
    figures = json.loads(result.stdout)
    first = columns.split(",")[0]
    line = f"{path}: found values {first}, foo, expected some of maps that scene SIM_1 has (albedo_1, theta, ...)"
    assert (line in result.stderr) == told
    assert (line in figures.get("notes", [])) == told
    (row,) = figures["points"]
    expected = {"map": 0.25, "sample": 0.5, "difference": -0.25}
    assert row == {"name": "rock", "values": {} if told else {"albedo_1": expected}}

"""`sattools compare` on the command line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sattools.cli import main
from sattools.compare.text import table
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3357800.0, 1.0, 60, 60)


@pytest.fixture
def scene(tmp_path: Path) -> Any:
    scene = Scene(
        "SIM_1", tmp_path / "work", grid=GRID, products={"dsm": "dsm.tif", "truth_dsm": "truth/SIM_1_DSM.tif"}
    )
    heights = np.zeros(GRID.shape, np.float32)
    heights[20:30, 20:40] = 10
    write_cog(scene.output("truth/SIM_1_DSM.tif"), heights, GRID)
    write_cog(scene.output("dsm.tif"), heights + 2, GRID)
    return scene


def test_scene_on_stdin_gives_json_on_stdout_and_a_table_on_stderr(scene: Any) -> None:
    result = CliRunner().invoke(main, ["compare", "--register", "none"], input=scene.to_json() + "\n")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["mae"] == pytest.approx(2.0)
    assert figures["scene"] == "SIM_1"
    assert "MAE 2.000 m" in result.stderr
    again = CliRunner().invoke(main, ["compare"], input=scene.to_json() + "\n")
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr


def test_files_are_scored_without_a_scene(scene: Any) -> None:
    predicted, reference = scene.root / "dsm.tif", scene.root / "truth/SIM_1_DSM.tif"
    result = CliRunner().invoke(main, ["compare", "--predicted", str(predicted), "--dsm", str(reference)])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["shift_m"] == pytest.approx([0.0, 0.0, -2.0])


@pytest.mark.parametrize(("rows", "said"), [(slice(15, 35), True), (slice(10, 40), False)])
def test_a_file_on_a_small_part_of_the_reference_is_told_the_region_that_it_lies_on(
    scene: Any, rows: slice, said: bool
) -> None:
    """Of a surface beside a large tile of lidar next to nothing was complete, and holes were filled to its rims."""
    reference, part = scene.root / "truth/SIM_1_DSM.tif", GRID.part(rows, slice(0, 60))
    write_cog(scene.root / "part.tif", read_raster(reference, part)[0], part)
    files = ["compare", "--predicted", str(scene.root / "part.tif"), "--dsm", str(reference), "--register", "none"]
    whole = CliRunner().invoke(main, files)
    figures = json.loads(whole.stdout)
    assert figures["completeness"] == pytest.approx((rows.stop - rows.start) / 60)
    region = "436000,3357765,436060,3357785"
    told = "the DSM lies on 33 % of the reference, and completeness and filled holes are about all of it; "
    told += f"--region {region} scores that part"
    assert (told in whole.stderr) == said
    assert ("notes" in figures) == said
    if said:
        within = CliRunner().invoke(main, [*files, "--region", region])
        assert (json.loads(within.stdout)["completeness"], "the DSM lies on" in within.stderr) == (1.0, False)


@pytest.mark.parametrize("more", [["--map", "w=w.tif"], ["--points", "p.csv"], ["--views"], ["scene.json"]])
def test_what_needs_a_scene_is_wrong_usage_beside_a_file(scene: Any, more: list[str]) -> None:
    (scene.root / "scene.json").touch()
    more = [*more[:-1], str(scene.root / more[-1])] if more[0] == "scene.json" else more
    result = CliRunner().invoke(main, ["compare", "--predicted", str(scene.root / "dsm.tif"), *more])
    assert result.exit_code == 2
    assert "beside --predicted, which scores that file alone" in result.stderr


def test_heights_are_no_class_map(scene: Any) -> None:
    predicted, reference = scene.root / "dsm.tif", scene.root / "truth/SIM_1_DSM.tif"
    write_cog(scene.output("half.tif"), np.full(GRID.shape, 2.5, np.float32), GRID)
    files = ["--predicted", str(predicted), "--dsm", str(reference), "--classes", str(scene.root / "half.tif")]
    result = CliRunner().invoke(main, ["compare", *files])
    assert result.exit_code == 1
    assert "half.tif: found 2.5, expected class codes, whole numbers from 0 to 255" in result.stderr


def test_missing_reference_is_one_line_and_exit_code_1(scene: Any) -> None:
    result = CliRunner().invoke(main, ["compare", "--predicted", str(scene.root / "dsm.tif"), "--dsm", "nowhere.tif"])
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "nowhere.tif: no such file" in result.stderr
    assert result.stdout == ""


def test_a_scene_without_a_reference_is_named_once(scene: Any) -> None:
    del scene.products["truth_dsm"]
    result = CliRunner().invoke(main, ["compare"], input=scene.to_json() + "\n")
    expected = "scene SIM_1: found no reference, expected --truth DIR or --dsm FILE"
    assert (result.exit_code, result.stderr) == (1, f"sattools compare: error: {expected}\n")


def test_a_folder_for_results_is_wrong_usage_where_the_scene_has_its_own(scene: Any, tmp_path: Path) -> None:
    arguments = ["compare", str(scene.root / "scene.json"), "--out", str(tmp_path / "elsewhere")]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 2
    assert "found --out with a scene" in result.output
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize(
    ("roles", "words"),
    [(["train", "train"], "(2 that the fit was trained on, none held out)"), (["train", "test"], "(1 held out from")],
)
def test_the_text_says_whether_a_fit_has_seen_the_views_that_it_is_scored_by(roles: Any, words: str) -> None:
    views = {f"v{k}": {"role": role} for k, role in enumerate(roles)}
    figures = dict.fromkeys(("mae", "mae_filled", "rmse", "median", "nmad", "completeness", "within_1m"), 1.0)
    figures |= {"within_2_5m": 1.0, "psnr": 46.752, "ssim": 0.9, "lpips": None, "avg": None}
    more = {"reference": "r", "protocol": "p", "cells": 9, "shift_m": (0, 0, 0), "registration": {"method": "none"}}
    more |= {"measured": {"mae": 1.0}, "mask": "all", "views": views, "mae_centred": 1.0, "mae_capped_5m": 1.0}
    more |= {"near_steps": {"share": 0}, "away_from_steps": {"share": 0}}
    line = table({"scene": "A", **figures, **more}).splitlines()[-1]
    assert line.startswith("  views     psnr 46.752")
    assert words in line

"""`prep --overwrite` leaves no files of images that the scene no longer has, and takes nothing else away."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from synthetic_views import parallel_rpc, render, texture

from sattools import api
from sattools.cli import main
from sattools.prep.options import PrepOptions
from sattools.prep.stage import prepare
from sattools.scene import Scene

RUNS = [(0.3, 0.05), (-0.2, 0.2), (0.0, -0.3)]


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three images in `in` and their scene in `out/city`; to be copied."""
    folder = tmp_path_factory.mktemp("three")
    (folder / "in").mkdir()
    ground = texture()
    for k, run in enumerate(RUNS):
        pixels = render(ground, run).clip(1, 2047).astype(np.uint16)
        profile = {"driver": "GTiff", "count": 1, "height": pixels.shape[0], "width": pixels.shape[1]}
        with rasterio.open(folder / f"in/city_{k}.tif", "w", dtype="uint16", **profile) as out:
            out.write(pixels[None])
            out.update_tags(ns="RPC", **parallel_rpc(run).to_tags())
    api.prepare([folder / f"in/city_{k}.tif" for k in range(3)], {"out": str(folder / "out")})
    return folder


@pytest.fixture
def again(three: Path, tmp_path: Path) -> Path:
    shutil.copytree(three, tmp_path / "three")
    return tmp_path / "three"


def two_of(folder: Path) -> list[Path]:
    return [folder / f"in/city_{k}.tif" for k in (0, 1)]


def named(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("city_*") if path.is_file())


def test_images_and_cameras_that_the_scene_no_longer_has_go(again: Path) -> None:
    (again / "out/city/images/notes.txt").write_text("mine")
    (again / "out/city/images/city_7.tif").write_text("mine, too")
    args = ["-q", "prep", *map(str, two_of(again)), "--out", str(again / "out"), "--id", "city", "--overwrite"]
    result = CliRunner().invoke(main, args)
    assert result.exit_code == 0, result.stderr
    assert named(again / "out/city/images") == ["city_0.tif", "city_1.tif", "city_7.tif"]
    assert named(again / "out/city/rpc") == ["city_0_RPC.TXT", "city_1_RPC.TXT"]
    assert (again / "out/city/images/notes.txt").read_text() == "mine"
    assert named(again / "in") == ["city_0.tif", "city_1.tif", "city_2.tif"]


def test_copies_go_where_originals_are_referred_to(again: Path) -> None:
    api.prepare(two_of(again), {"out": str(again / "out"), "id": "city", "copy": False}, overwrite=True)
    assert named(again / "out/city/images") == []
    assert named(again / "in") == ["city_0.tif", "city_1.tif", "city_2.tif"]


def test_nothing_goes_while_the_new_scene_is_not_there(again: Path) -> None:
    before = named(again / "out")
    with pytest.raises(KeyboardInterrupt):
        api.prepare(two_of(again), {"out": str(again / "out"), "id": "city"}, overwrite=True, progress=stop_at_the_end)
    assert named(again / "out") == before


def stop_at_the_end(share: float, message: str) -> None:
    if share >= 1.0:
        raise KeyboardInterrupt


def test_files_elsewhere_stay_whatever_an_earlier_document_says(again: Path) -> None:
    """Those of another folder by their path or a link, those that were given, and those of other names."""
    root = again / "out/city"
    scene = Scene.from_file(root / "scene.json")
    other, given = again / "elsewhere.tif", root / "mine.tif"
    shutil.copy(root / "images/city_2.tif", other)
    (root / "images/city_2.tif").rename(given)
    (root / "images/city_2.tif").symlink_to(other)
    scene.items[0].assets["image"].href = "mine.tif"
    scene.items[1].assets["image"].href = str(again / "in/city_1.tif")
    scene.items[2].assets["notes"] = replace(scene.items[2].assets["rpc"], href="adjustment.txt")
    scene.write()
    prepare(two_of(again), PrepOptions(out=str(again / "out"), id="city"), overwrite=True)
    for path in (other, given, root / "images/city_2.tif", root / "adjustment.txt", again / "in/city_1.tif"):
        assert path.exists(), path
    assert not (root / "rpc/city_2_RPC.TXT").exists()


@pytest.mark.parametrize("command", ["simulate", "of another program", None])
def test_files_of_a_scene_that_prep_has_not_made_stay(again: Path, command: Any) -> None:
    """They may be all that there is of it."""
    root = again / "out/city"
    scene = Scene.from_file(root / "scene.json")
    scene.history = [] if command is None else [{**scene.history[0], "command": command}]
    scene.write()
    prepare(two_of(again), PrepOptions(out=str(again / "out"), id="city"), overwrite=True)
    assert (root / "images/city_2.tif").exists()

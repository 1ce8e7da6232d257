"""Panchromatic and multispectral images of one acquisition as one item, each with its own pixels and camera."""

import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from sattools.camera import RPC
from sattools.cli import main
from sattools.errors import InputError
from sattools.prep.colours import corrected, partners
from sattools.prep.metadata import Metadata
from sattools.scene import Scene
from sattools.scene.raster import read_raster
from sattools.scene.regrid import reproject_map

RATIO = 4


def run(*arguments: Any) -> Any:
    done = CliRunner().invoke(main, ["-q", *map(str, arguments)])
    assert done.exit_code == 0, done.output
    return done


def town(folder: Path, size: int) -> Path:
    options = ("--size", size, "--views", 4, "--dates", 2, "--bias-px", 2, "--pan", RATIO)
    run("simulate", "--id", "TOWN", "--out", folder, *options)
    return folder / "TOWN"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """(simulated folder, prepared scene)."""
    folder = tmp_path_factory.mktemp("pan")
    root = town(folder, 64)
    images = sorted((root / "images").glob("*.tif"))
    run("prep", *images, "--colours", root / "colours", "--metadata", root / "metadata", "--id", "PS", "--out", folder)
    return root, Scene.from_file(folder / "PS/scene.json")


def source(name: str, seconds: float | None = None) -> Any:
    start = datetime(2020, 5, 1, 10, tzinfo=UTC)
    time = None if seconds is None else start + timedelta(seconds=seconds)
    return SimpleNamespace(id=name, path=Path(f"{name}.tif"), metadata=replace(Metadata(), time=time))


def test_every_acquisition_is_one_item_with_two_images_and_two_cameras(prepared: Any) -> None:
    _, scene = prepared
    assert len(scene.items) == 4
    assert scene.history[0]["cpu_seconds"] > 0
    for item in scene.items:
        with rasterio.open(scene.path(item.assets["image"].href)) as pan:
            assert pan.count == 1
            shape = pan.shape
        with rasterio.open(scene.path(item.assets["colours"].href)) as colours:
            assert colours.count == 3
            assert colours.shape[0] == pytest.approx(shape[0] / RATIO, abs=2)
        assert scene.path(item.assets["colours_rpc"].href).is_file()


def test_the_colours_cameras_get_the_correction_that_tie_points_have_found(prepared: Any) -> None:
    root, scene = prepared
    west, south, east, north = scene.items[0].bbox
    rng = np.random.default_rng(0)
    lon, lat, h = rng.uniform(west, east, 50), rng.uniform(south, north, 50), rng.uniform(-22, 0, 50)
    wrong, left = [], []
    for item in scene.items:
        with rasterio.open(scene.path(item.assets["colours"].href)) as data:
            first = RPC.from_file(root / "colours" / f"{item.id}_MS.tif")
            assert data.tags(ns="RPC")
        # prep keeps all pixels of this small image or crops it by whole ones: the shift between both is a whole number
        truth = np.array(RPC.from_file(root / "truth/rpc" / f"{item.id}_MS_RPC.TXT").projection(lon, lat, h))
        own = np.array(RPC.from_file(scene.path(item.assets["colours_rpc"].href)).projection(lon, lat, h))
        moved = np.round(np.median(truth - own, axis=1, keepdims=True))
        wrong.append(np.median(np.array(first.projection(lon, lat, h)) - truth, axis=1))
        left.append(np.median(own + moved - truth, axis=1))
    # what all cameras share cannot be known; it is taken out of both
    wrong, left = (np.hypot(*(np.array(v) - np.mean(v, axis=0)).T) for v in (wrong, left))
    assert np.max(wrong) > 0.2
    assert np.max(left) < 0.5 * np.max(wrong)


def test_a_correction_in_panchromatic_pixels_is_a_fourth_in_multispectral_ones() -> None:
    root = RPC.from_file(_some_rpc())
    colour = root.cropped(1, 2).reduced(RATIO)
    n = 60
    rng = np.random.default_rng(1)
    places = np.stack(
        [root.lon_offset + rng.uniform(-1, 1, n) * 1e-3, root.lat_offset + rng.uniform(-1, 1, n) * 1e-3,
         root.alt_offset + rng.uniform(-50, 50, n)], axis=1,
    )  # fmt: skip
    found, misfit = corrected(colour, root, root.shifted(6.0, -2.0), places)
    difference = np.array(found.projection(*places.T)) - np.array(colour.projection(*places.T))
    assert difference == pytest.approx(np.array([[1.5], [-0.5]]) * np.ones((1, n)), abs=0.02)
    assert misfit < 0.02


def _some_rpc() -> Path:
    import tempfile

    folder = Path(tempfile.mkdtemp())
    from synthetic_views import parallel_rpc

    path = folder / "a_RPC.TXT"
    path.write_text(parallel_rpc((0.2, 0.1)).to_rpc_txt())
    return path


def test_partners_are_found_by_name_and_else_by_time() -> None:
    pans = [source("A_PAN_1", 0.0), source("A_PAN_2", 60.0)]
    named = [source("A_MS_2"), source("A_MS_1")]
    assert [c.id for c in partners(pans, named)] == ["A_MS_1", "A_MS_2"]
    timed = [source("X", 60.4), source("Y", 0.2)]
    assert [c.id for c in partners(pans, timed)] == ["Y", "X"]
    assert partners(pans, [named[1]])[1] is None


@pytest.mark.parametrize(
    ("pan", "colours"),
    [
        ("14OCT15155630-P1BS-500647759080_01_P001", "14OCT15155630-M1BS-500647759080_01_P001"),  # WorldView
        ("IMG_01_PNEO3_PAN", "IMG_01_PNEO3_MS-FS"),  # Pleiades Neo
        ("GF2_PMS1_E113.9_N30.1_L1A000-PAN1", "GF2_PMS1_E113.9_N30.1_L1A000-MSS1"),  # Gaofen
        ("20200501_s4_0012_panchromatic", "20200501_s4_0012_analytic"),  # SkySat
    ],
)
def test_vendors_names_of_the_two_sensors_are_known(pan: str, colours: str) -> None:
    other, own = source(colours.replace("01", "02", 1).replace("000", "009")), source(colours)
    assert partners([source(pan)], [other, own]) == [own]


def test_both_sensors_given_as_images_are_told_where_the_second_belongs(prepared: Any, tmp_path: Path) -> None:
    root, _ = prepared
    images = [*sorted((root / "images").glob("*.tif")), root / "colours/TOWN_001_MS.tif"]
    done = CliRunner().invoke(main, ["prep", *map(str, images), "--out", str(tmp_path)])
    assert done.exit_code == 1
    assert "TOWN_001_MS.tif: found 3 bands, expected 1 as most of the other images have (multispectral" in done.stderr
    assert "--colours FOLDER" in done.stderr


def test_images_of_other_acquisitions_are_refused_in_one_line() -> None:
    pans = [source("A_PAN_1", 0.0)]
    with pytest.raises(InputError, match="found no image with the name or the time of A_PAN_1"):
        partners(pans, [source("B_MS_7", 500.0)])
    with pytest.raises(InputError, match=r"found A_MS_1.tif and A_XS_1.tif for A_PAN_1"):
        partners(pans, [source("A_MS_1"), source("A_XS_1")])


def test_a_folder_without_images_is_refused_before_work(tmp_path: Path, prepared: Any) -> None:
    root, _ = prepared
    images = [str(p) for p in sorted((root / "images").glob("*.tif"))]
    done = CliRunner().invoke(main, ["prep", *images, "--colours", str(tmp_path), "--out", str(tmp_path / "o")])
    assert done.exit_code == 1
    assert "--colours: found no images" in done.stderr
    assert not (tmp_path / "o").exists()


def test_colours_that_lie_beside_their_image_are_told(tmp_path: Path, prepared: Any) -> None:
    root, scene = prepared
    assert not any("beside" in note for note in scene.history[0]["notes"])
    folder = shutil.copytree(root / "colours", tmp_path / "colours")
    with rasterio.open(folder / "TOWN_002_MS.tif", "r+") as data:
        rpc = RPC.from_tags(data.tags(ns="RPC")).shifted(4.0, -3.0)
        data.update_tags(ns="RPC", **rpc.to_tags())
    images = sorted((root / "images").glob("*.tif"))
    run("prep", *images, "--colours", folder, "--metadata", root / "metadata", "--id", "PS", "--out", tmp_path)
    moved = Scene.from_file(tmp_path / "PS/scene.json")
    told = [note for note in moved.history[0]["notes"] if "beside" in note]
    assert told == [
        f"TOWN_002: its colours lie 5 of their pixels beside it: is the RPC of {folder}/TOWN_002_MS.tif that of this "
        "part of the image?"
    ]
    assert moved.items[1].properties["sattools:colours_source"] == f"{folder}/TOWN_002_MS.tif"


def test_images_of_one_band_are_no_colours(tmp_path: Path, prepared: Any) -> None:
    root, _ = prepared
    images = [str(p) for p in sorted((root / "images").glob("*.tif"))]
    done = CliRunner().invoke(
        main, ["prep", *images, "--colours", str(root / "images"), "--out", str(tmp_path / "o"), "--id", "S"]
    )
    assert done.exit_code == 1
    assert "--colours: found one band in " in done.stderr
    assert not list((tmp_path).rglob("*.tif"))


def test_natural_ground_is_simulated_by_one_sensor_only(tmp_path: Path) -> None:
    options = ["--terrain", "natural", "--pan", "4", "--out", str(tmp_path)]
    done = CliRunner().invoke(main, ["simulate", *options])
    assert done.exit_code != 0
    assert "--pan: found natural ground, expected a city" in done.stderr
    assert not list(tmp_path.iterdir())


def test_the_orthophoto_has_the_panchromatic_images_detail_and_the_others_colours(prepared: Any) -> None:
    root, scene = prepared
    path = scene.root / "scene.json"
    run("fit", path, "--epochs", 2)
    run("export", path, "--products", "ortho")
    with rasterio.open(scene.root / "export/ortho.tif") as data:
        assert data.descriptions == ("colour red", "colour green", "colour blue")
    found, grid = read_raster(scene.root / "export/ortho.tif")
    truth = reproject_map(*read_raster(root / "truth/TOWN_ALBEDO.tif"), grid)
    known = np.isfinite(found).all(axis=0) & np.isfinite(truth).all(axis=0)
    assert known.sum() > 0.9 * np.isfinite(truth).all(axis=0).sum()
    green = [v[1] - (v[0] + v[2]) / 2 for v in (found, truth)]
    assert np.corrcoef(*(v[known] for v in green))[0, 1] > 0.25  # grey has none
    grey = [v.mean(axis=0) for v in (found, truth)]
    assert np.corrcoef(*(v[known] for v in grey))[0, 1] > 0.6

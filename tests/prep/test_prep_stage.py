"""`prep` makes a scene of images, and refuses what it cannot use in one line with nothing written."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from synthetic_views import ALT0, LAT0, LON0, parallel_rpc, render, texture

from sattools.camera import RPC
from sattools.camera.ground import from_geographic, to_geographic
from sattools.cli import main
from sattools.errors import InputError, OutputExistsError, SattoolsError
from sattools.prep.options import PrepOptions
from sattools.prep.stage import prepare
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import Scene

RUNS = [(0.3, 0.05), (-0.2, 0.2), (0.0, -0.3)]


def write(path: Any, image: Any, rpc: Any = None, **profile: Any) -> Any:
    image = np.asarray(image)
    image = image[None] if image.ndim == 2 else image
    count, height, width = image.shape
    options = {"driver": "GTiff", "width": width, "height": height, "count": count, "dtype": image.dtype}
    with rasterio.open(path, "w", **options, **profile) as out:
        out.write(image)
        if rpc is not None:
            out.update_tags(ns="RPC", **rpc.to_tags())
    return path


@pytest.fixture(scope="module")
def pixels() -> Any:
    ground = texture()
    return [render(ground, r).clip(1, 2047).astype(np.uint16) for r in RUNS]


def written(folder: Path, pixels: Any) -> Any:
    folder.mkdir()
    return [
        write(folder / f"city_{k}.tif", p, parallel_rpc(r).shifted(0, 5.0 * (k == 2)))
        for k, (p, r) in enumerate(zip(pixels, RUNS, strict=True))
    ]


@pytest.fixture
def images(tmp_path: Path, pixels: Any) -> Any:
    return written(tmp_path / "in", pixels)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory, pixels: Any) -> Any:
    """The scene of the images with no option given, and what its history says; to be looked at only."""
    folder = tmp_path_factory.mktemp("prepared")
    return prepare(written(folder / "in", pixels), PrepOptions(out=str(folder / "out")))


@pytest.fixture
def options(tmp_path: Path) -> Any:
    return PrepOptions(out=str(tmp_path / "out"))


def refused(images: Any, options: Any, words: Any) -> None:
    with pytest.raises(InputError, match=words) as caught:
        prepare(images, options)
    assert "\n" not in str(caught.value)

    assert not [name for _, _, names in os.walk(options.out) for name in names]


def test_a_scene_with_corrected_cameras(images: Any, pixels: Any, options: Any) -> None:
    meta = {"sun_azimuth": "150.0", "sun_elevation": "+40.0", "acquisition_date": "20200621103000"}
    images[0].with_suffix(".json").write_text(json.dumps(meta))
    scene, extra = prepare(images, replace(options, holdout=["city_1"]))
    assert scene.id == "city"
    assert [i.id for i in scene.items] == ["city_0", "city_1", "city_2"]
    assert [i.role for i in scene.items] == ["train", "test", "train"]
    assert scene.grid.crs == "EPSG:32633"
    assert scene.grid.cell_size == 0.5
    low, high = scene.height_range_m
    assert low < ALT0 - 8 < ALT0 + 8 < high < low + 60
    for item, before in zip(scene.items, pixels, strict=True):
        with rasterio.open(scene.path(item.assets["image"].href)) as image:
            assert np.array_equal(image.read(1), before)
            assert image.crs is None
            tags = RPC.from_tags(image.tags(ns="RPC"))
        written = RPC.from_file(scene.path(item.assets["rpc"].href))
        # GDAL hands its tags out with 15 digits
        assert (tags.col_offset, tags.row_offset) == pytest.approx((written.col_offset, written.row_offset), abs=1e-9)
        assert tags.col_num == pytest.approx(written.col_num, rel=1e-12)
    p = scene.items[0].properties
    assert p["datetime"] == "2020-06-21T10:30:00Z"
    assert (p["view:sun_azimuth"], p["view:sun_elevation"], p["sattools:sun"]) == (150.0, 40.0, "metadata")
    assert p["gsd"] == pytest.approx(0.5, abs=1e-3)
    # line of sight 0.3 east, 0.05 north per metre: zenith angle atan(0.304), azimuth atan2(0.3, 0.05)
    assert p["view:incidence_angle"] == pytest.approx(16.92, abs=0.01)
    assert p["view:azimuth"] == pytest.approx(80.54, abs=0.01)
    assert (p["sattools:bits"], p["sattools:dtype"], p["sattools:bands"]) == (8, "uint16", 1)  # none above 255
    assert extra["adjustment"]["median_after_px"] < 0.2
    assert "city_1: sun unknown: neither sun angles nor a time were found" in extra["notes"]
    points = json.loads(scene.path("tie_points.geojson").read_text())
    assert points["features"][0]["geometry"]["coordinates"][0] == pytest.approx(LON0, abs=0.01)
    assert "median residual" in scene.path("adjustment.txt").read_text()
    assert len(json.loads(scene.path("adjustment.json").read_text())["views"]) == 3
    assert Scene.from_json(scene.to_json()).to_json() == scene.to_json()


def test_metadata_beside_the_images_are_found_from_another_folder(
    images: Any, options: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where `prep` was given relative paths; in the other folder may lie images of the same names."""
    item = {"type": "Feature", "properties": {}, "assets": {"data": {"raster:bands": [{"scale": 0.001}]}}}
    for path in images:
        path.with_suffix(".json").write_text(json.dumps(item))
    monkeypatch.chdir(tmp_path)
    scene, _ = prepare([path.relative_to(tmp_path) for path in images], options)
    other = tmp_path / "other/in"
    other.mkdir(parents=True)
    for path in images:
        (other / path.name).with_suffix(".json").write_text(json.dumps(item).replace("0.001", "0.5"))
    monkeypatch.chdir(tmp_path / "other")
    normalise(scene, NormaliseOptions(quantity="toa_reflectance"))
    with rasterio.open(images[0]) as before, rasterio.open(scene.path("radiance/city_0.tif")) as after:
        np.testing.assert_allclose(after.read(), before.read() * 0.001, rtol=1e-6)


def test_relative_errors_of_cameras_are_undone(prepared: Any) -> None:
    scene, _ = prepared
    shifts = np.array([i.properties["sattools:rpc_shift_px"] for i in scene.items])
    undone = shifts + np.array([[0, 0], [0, 0], [0, 5.0]])
    design = np.array([[[2, 0, -2 * x], [0, -2, 2 * y]] for x, y in RUNS], float).reshape(-1, 3)
    left = undone.ravel() - design @ np.linalg.lstsq(design, undone.ravel(), rcond=None)[0]
    assert np.abs(left).max() < 0.15


def test_sun_is_computed_from_the_time_when_metadata_have_none(images: Any, options: Any) -> None:
    for path in images:
        path.with_suffix(".json").write_text(json.dumps({"acquisition_date": "20200621110000"}))
    scene, _ = prepare(images, options)
    p = scene.items[0].properties
    assert p["sattools:sun"] == "time and place"
    # near noon on midsummer's day at 46 N: 90 - 46 + 23.44 = 67.4
    assert p["view:sun_elevation"] == pytest.approx(67.4, abs=0.1)


def test_an_area_crops_images_and_their_cameras(images: Any, options: Any) -> None:
    x, y = from_geographic("EPSG:32633", LON0, LAT0)
    area = [x - 20, y - 15, x + 20, y + 15]
    scene, _ = prepare(images, replace(options, crs="EPSG:32633", bounds=area))
    assert scene.grid.bounds == pytest.approx(area, abs=0.5)
    for item, path in zip(scene.items, images, strict=True):
        col, row, width, height = item.properties["sattools:source_window"]
        assert width < 200
        with rasterio.open(path) as whole, rasterio.open(scene.path(item.assets["image"].href)) as crop:
            assert np.array_equal(whole.read(1)[row : row + height, col : col + width], crop.read(1))
        middle = 0.5 * sum(scene.height_range_m)
        camera = RPC.from_file(scene.path(item.assets["rpc"].href))
        inside = camera.projection(LON0, LAT0, middle)
        assert 0 < inside[0] < width
        assert 0 < inside[1] < height
        # what stands within 16 m of the area may hide and shade parts of it
        for east, north in ((-36, -31), (-36, 31), (36, -31), (36, 31)):
            col, row = camera.projection(*to_geographic("EPSG:32633", x + east, y + north), middle)
            assert 0 <= col <= width - 1
            assert 0 <= row <= height - 1


def test_an_area_far_larger_than_the_images_is_cut_to_what_two_of_them_show(
    images: Any, options: Any, prepared: Any
) -> None:
    whole, _ = prepared
    x, y = from_geographic("EPSG:32633", LON0, LAT0)
    far = [x - 3000, y - 3000, x + 3000, y + 3000]
    scene, extra = prepare(images, replace(options, crs="EPSG:32633", bounds=far))
    assert "less than half of the area lies where two images show it: cut to that" in extra["notes"]
    assert 1.0 <= scene.grid.width * scene.grid.height / (whole.grid.width * whole.grid.height) < 1.5
    assert scene.grid.bounds[0] < x < scene.grid.bounds[2]


def test_correction_none_keeps_the_cameras(images: Any, options: Any) -> None:
    scene, extra = prepare(images, replace(options, correction="none"))
    assert RPC.from_file(scene.path("rpc/city_2_RPC.TXT")).to_tags() == RPC.from_file(images[2]).to_tags()
    assert "cameras were left as they are (correction none)" in extra["notes"]
    assert not any(note.endswith("; corrected") for note in extra["notes"])
    found = extra["adjustment"]
    assert (found["model"], found["median_after_px"]) == ("none", found["median_before_px"])
    assert [item.properties["sattools:rpc_shift_px"] for item in scene.items] == [[0, 0]] * len(scene.items)
    assert "tie points ask for" in scene.path("adjustment.txt").read_text()


def test_an_existing_scene_is_kept_unless_told_otherwise(images: Any, options: Any, tmp_path: Path) -> None:
    (tmp_path / "out/city").mkdir(parents=True)
    (tmp_path / "out/city/scene.json").write_text("{}")
    with pytest.raises(OutputExistsError, match="--overwrite"):
        prepare(images, options)
    prepare(images, options, overwrite=True)


def test_one_image_is_refused(images: Any, options: Any) -> None:
    refused(images[:1], options, "found this one image only")


def test_a_scene_is_no_image(images: Any, options: Any, tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text("{}")
    refused([tmp_path / "scene.json"], options, "found a document .of a scene. it goes on with `sattools prior`.")


def test_two_images_with_one_id_are_refused(images: Any, options: Any, tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    twin = tmp_path / "b" / "city_0.tif"
    twin.write_bytes(images[0].read_bytes())
    refused([images[0], twin], options, "found id 'city_0', which")


def test_an_image_without_rpc_is_refused(images: Any, options: Any, pixels: Any) -> None:
    write(images[1], pixels[1])
    refused(images, options, r"city_1\.tif: found no RPC")


def test_an_rpc_of_another_place_is_refused(images: Any, options: Any, pixels: Any) -> None:
    write(images[1], pixels[1], replace(parallel_rpc(RUNS[1]), lon_offset=15.5))
    refused(images, options, r"city_1\.tif: found its RPC at 46\.0000 N 15\.5000 E, 38\.\d km from the other images")


def test_images_that_do_not_overlap_are_refused(images: Any, options: Any, pixels: Any) -> None:
    write(images[1], pixels[1], replace(parallel_rpc(RUNS[1]), lat_offset=46.1))
    refused(images[:2], options, "found no overlap with")


def test_images_of_different_ground_are_refused(images: Any, options: Any) -> None:
    other = render(texture(seed=9), RUNS[1]).clip(1, 2047).astype(np.uint16)
    write(images[1], other, parallel_rpc(RUNS[1]))
    refused(images[:2], options, "tie points: found")


def test_a_truncated_image_is_refused(images: Any, options: Any) -> None:
    data = images[1].read_bytes()
    images[1].write_bytes(data[: len(data) // 2])
    refused(images, options, r"city_1\.tif: found")


def test_a_band_without_data_is_refused(images: Any, options: Any, pixels: Any) -> None:
    for path, values, run in zip(images, pixels, RUNS, strict=True):
        write(path, np.stack([values, values * (path != images[1])]), parallel_rpc(run))
    refused(images, options, r"city_1\.tif: found band 2 to be 0 everywhere")
    write(images[1], np.full((2, *pixels[1].shape), np.nan, np.float32), parallel_rpc(RUNS[1]))
    refused(images, options, "no-data or NaN everywhere")


def test_copied_pixels_keep_the_scale_that_makes_them_reflectances(images: Any, options: Any) -> None:
    for path in images:
        with rasterio.open(path, "r+") as data:
            data.scales, data.offsets = [1e-4], [-0.01]
    scene, _ = prepare(images, options)
    normalise(scene, NormaliseOptions(quantity="toa_reflectance"))
    with rasterio.open(scene.path("images/city_0.tif")) as data:
        numbers = data.read().astype(np.float64)
    with rasterio.open(scene.path("radiance/city_0.tif")) as data:
        assert np.allclose(data.read(), numbers * 1e-4 - 0.01, atol=1e-7)


def test_nan_pixels_are_masked_and_mentioned(images: Any, options: Any, pixels: Any) -> None:
    holed = pixels[1].astype(np.float32)
    holed[50:80, 60:110] = np.nan
    write(images[1], holed, parallel_rpc(RUNS[1]))
    scene, extra = prepare(images, options)
    assert any(r.startswith("city_1: 2.4 % of the pixels are NaN") for r in extra["notes"])
    assert scene.items[1].properties["sattools:value_range"][1] > 0


@pytest.mark.parametrize("where", ["beside the image", "in the metadata folder"])
def test_unreadable_json_is_refused(images: Any, options: Any, tmp_path: Path, where: Any) -> None:
    folder = tmp_path / "m"
    folder.mkdir()
    target = images[1].with_suffix(".json") if where == "beside the image" else folder / "city_1.json"
    target.write_text('{"rpc": ')
    refused(images, replace(options, metadata=str(folder)), r"city_1\.json: found text that is not JSON")


def test_metadata_of_another_crop_are_refused(images: Any, options: Any) -> None:
    images[1].with_suffix(".json").write_text(json.dumps({"height": 100, "width": 100}))
    refused(images, options, "metadata of an image of 100 x 100 pixels, expected 260 x 240")


def test_an_area_outside_is_refused(images: Any, options: Any) -> None:
    refused(images, replace(options, bounds=[16.0, 46.0, 16.01, 46.01]), "found 0 of 3 images that show it")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"metadata": "/nowhere"}, "found no such folder"),
        ({"crs": "EPSG:4326"}, "not projected in metres"),
        ({"crs": "EPSG:32633+5773"}, "found one with heights of its own, expected that of a map such as EPSG:32633"),
        ({"holdout": ["city_9"]}, "holdout: found 'city_9'"),
        ({"bounds": [1.0, 2.0, 3.0, 4.0], "aoi": "a.geojson"}, "found both --aoi and --bounds"),
    ],
)
def test_wrong_options_are_refused(images: Any, options: Any, change: Any, words: Any) -> None:
    refused(images, replace(options, **change), words)


def test_the_command_prints_one_scene_line(images: Any, tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["prep", *map(str, images), "--out", str(tmp_path / "o"), "--id", "town"])
    assert result.exit_code == 0, result.output
    scene = Scene.from_json(result.stdout)
    assert result.stdout.count("\n") == 1
    assert scene.id == "town"
    assert scene.history[-1]["command"] == "prep"
    assert (tmp_path / "o/town/scene.json").exists()


def test_the_command_says_in_one_line_what_is_wrong(images: Any, tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["prep", str(images[0]), "--out", str(tmp_path / "o")])
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert "expected at least 2 images" in result.stderr


def test_the_command_without_images_is_a_usage_error() -> None:
    assert CliRunner().invoke(main, ["prep"]).exit_code == 2
    assert CliRunner().invoke(main, ["prep", "--dfc2019", "/nowhere"]).exit_code == 2


def test_heights_given_by_hand_are_taken(images: Any, options: Any) -> None:
    scene, _ = prepare(images, replace(options, min_height=50.0, max_height=160.0))
    assert scene.height_range_m == (50.0, 160.0)
    with pytest.raises(InputError, match=r"lowest 160 m and highest 50 m"):
        prepare(images, replace(options, min_height=160.0, max_height=50.0), overwrite=True)


def test_a_full_disk_leaves_no_half_written_image(images: Any, options: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(number: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SattoolsError, match=r"city_0\.tif: cannot be written \(No space left on device\)"):
        prepare(images, options)
    assert not [name for _, _, names in os.walk(options.out) for name in names]


def test_an_output_folder_that_is_a_file_is_refused_before_any_work(images: Any, options: Any, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(SattoolsError, match="expected a writable folder"):
        prepare(images, options)


def test_the_history_says_of_every_pair_how_its_images_see_the_place(prepared: Any) -> None:
    scene, extra = prepared
    pairs = extra["adjustment"]["pairs"]
    sights = {f"city_{k}": np.array([*run, 1.0]) / np.hypot(1.0, np.hypot(*run)) for k, run in enumerate(RUNS)}
    assert {tuple(row["images"]) for row in pairs} == {("city_0", "city_1"), ("city_0", "city_2"), ("city_1", "city_2")}
    for row in pairs:
        first, second = (sights[name] for name in row["images"])
        assert row["angle_deg"] == pytest.approx(np.degrees(np.arccos(first @ second)), abs=0.1)
        assert row["tie_points"] >= 50
        assert row["after_px"] < 0.5
        if "city_2" in row["images"]:  # five pixels off; what lies along the line of sight, the ground takes
            assert 0.5 < row["before_px"] < 5.0
    assert json.loads(scene.path("adjustment.json").read_text())["pairs"] == pairs
    assert "city_0" in scene.path("adjustment.txt").read_text().split("angle")[1]


def test_the_report_keeps_some_residuals_of_every_image(prepared: Any) -> None:
    views = json.loads(prepared[0].path("adjustment.json").read_text())["views"]
    for view in views:
        rows = np.array(view["residuals"])
        assert rows.shape[1] == 4
        assert 20 <= len(rows) <= 100
        assert np.median(np.hypot(rows[:, 2], rows[:, 3])) == pytest.approx(view["median_after_px"], rel=0.5, abs=0.05)


def test_images_in_sensor_geometry_claim_no_crs(prepared: Any) -> None:
    scene, _ = prepared
    assert all("proj:code" in item.properties for item in scene.items)
    assert [item.properties["proj:code"] for item in scene.items] == [None, None, None]

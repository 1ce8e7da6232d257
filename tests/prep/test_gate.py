"""Images, cameras, metadata and options that do not go together: told, and never taken in silence.

What is surely wrong stops with one line; what may be meant is a warning on stderr, and in the history of the scene.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from rasterio.enums import ColorInterp
from spoilt import Town, exchanged, made, prep, refused, roles, southern, warned

from sattools.camera import RPC
from sattools.cli import main
from sattools.prep.camera_gate import mirrored
from sattools.prep.gate import check_cells, check_heights, check_pixels
from sattools.prep.options import PrepOptions
from sattools.prep.pixels import read_gray
from sattools.prep.stage import survey
from sattools.scene import Grid, Scene
from sattools.simulate import SimulateOptions, simulate


@pytest.fixture
def town(town_source: Any, tmp_path: Path) -> Any:
    return Town(tmp_path, town_source, 4)


# ---- nothing to say -------------------------------------------------------------------------------------


def test_a_good_scene_is_made_without_a_word(town: Any) -> None:
    result = prep(town)
    assert result.exit_code == 0
    assert result.stderr == ""
    assert roles(Scene.from_json(result.stdout)) == ["train"] * 4


# ---- places ---------------------------------------------------------------------------------------------


def test_longitude_and_latitude_exchanged(town: Any) -> None:
    town.all("camera", exchanged)
    refused(town, "TOWN_001.tif: found mirrored cameras and suns", "longitudes and latitudes that are not exchanged")


def test_longitude_and_latitude_of_one_camera_exchanged(town: Any) -> None:
    with rasterio.open(town.image(2)) as data:
        rpc = RPC.from_tags(data.tags(ns="RPC"))
    assert mirrored(exchanged(rpc), rpc.lat_offset, rpc.lon_offset)
    assert not mirrored(rpc, rpc.lon_offset, rpc.lat_offset)
    town.camera(2, exchanged)
    refused(town, "TOWN_002.tif: found its RPC at -81.6600 N 30.3500 E")


def test_the_wrong_hemisphere(town: Any) -> None:
    town.all("camera", southern)
    warned(town, "the suns of all images stand", "sign of the latitude")


def test_the_wrong_hemisphere_of_one_camera(town: Any) -> None:
    town.camera(3, southern)
    refused(town, "TOWN_003.tif: found its RPC at -30.3500 N -81.6600 E, 6715.4 km from the other images")


@pytest.mark.parametrize("crs", ["EPSG:32601", "EPSG:3857"])
def test_a_crs_whose_metres_are_none_here(town: Any, crs: Any) -> None:
    refused(town, f"CRS {crs}: found that", "1 m on the ground", "EPSG:32617", options=["--crs", crs])


# ---- suns and times -------------------------------------------------------------------------------------


def test_a_sun_that_does_not_stand_there_at_that_time(town: Any) -> None:
    town.metadata(2, sun_elevation="89")
    warned(town, "TOWN_002: its sun stands 58 degrees from where time and place put it")


def test_suns_that_do_not_stand_there_in_any_image(town: Any) -> None:
    for number in range(1, 5):
        town.metadata(number, sun_elevation="89")
    warned(town, "the suns of all images stand 43 degrees or more from where time and place put them")


@pytest.mark.parametrize(
    ("elevation", "words"), [("400", "found 400 degrees, expected -90 to 90"), ("-20", "an image taken by day")]
)
def test_a_sun_that_no_image_has(town: Any, elevation: Any, words: Any) -> None:
    town.metadata(2, sun_elevation=elevation)
    refused(town, "TOWN_002", words)


@pytest.mark.parametrize("unknown", ["-999", "", None])
def test_a_sun_that_the_vendor_does_not_know_is_computed(town: Any, unknown: Any) -> None:
    town.metadata(2, sun_elevation=unknown)
    result = prep(town, "--dry-run")
    assert (result.exit_code, result.stderr.count("\n")) == (0, 1)


def test_a_date_before_there_were_satellites(town: Any) -> None:
    town.metadata(2, acquisition_date="10661014120000")
    refused(town, "TOWN_002.tif: found the date 1066-10-14")


def test_a_date_still_to_come(town: Any) -> None:
    town.metadata(2, acquisition_date="20991014155000")
    warned(town, "TOWN_002: taken on 2099-10-14, which is still to come")


# ---- whose metadata and cameras -------------------------------------------------------------------------


def test_metadata_of_two_images_exchanged(town: Any) -> None:
    first, fourth = (town.metadata(n) for n in (1, 4))
    town.metadata(1, **fourth | {"height": None, "width": None})
    town.metadata(4, **first | {"height": None, "width": None})
    warned(town, "TOWN_001: its own RPC tags differ from", "TOWN_001.json", "metadata of another image?")
    warned(town, "TOWN_004: its own RPC tags differ from")


def test_metadata_of_an_image_of_another_size(town: Any) -> None:
    town.metadata(1, **town.metadata(4))
    refused(town, "TOWN_001.json: found metadata of an image of", "as TOWN_001.tif has")


def test_suns_of_two_images_exchanged(town: Any) -> None:
    second, fourth = (town.metadata(n) for n in (2, 4))
    suns = ("sun_azimuth", "sun_elevation")
    town.metadata(2, **{name: fourth[name] for name in suns})
    town.metadata(4, **{name: second[name] for name in suns})
    warned(town, "TOWN_002: its sun stands")


def test_one_image_under_two_names(town: Any) -> None:
    shutil.copy(town.image(1), town.image(9))
    shutil.copy(town.folder / "metadata/TOWN_001.json", town.folder / "metadata/TOWN_009.json")
    result = prep(town)
    assert result.exit_code == 1
    assert result.stderr.endswith("images/TOWN_001.tif, expected another image\n")
    assert "TOWN_009.tif: found the same pixels as in" in result.stderr


def test_the_camera_of_another_part_of_an_image_is_blamed_on_that_image(town: Any) -> None:
    town.camera(2, lambda rpc: rpc.shifted(78, 0))
    scene = made(town, "TOWN_002: its camera and those of the others are 78 px apart")
    assert scene.items[1].properties["sattools:rpc_shift_px"] == pytest.approx([-78, 0], abs=1)


@pytest.mark.parametrize("count", [2, 3])
def test_with_few_images_the_wrong_camera_is_told_but_not_whose_it_is(
    town_source: Any, tmp_path: Path, count: Any
) -> None:
    few = Town(tmp_path, town_source, count)
    few.camera(2, lambda rpc: rpc.shifted(78, 0))
    made(few, "px apart", "cannot be told from so few")


def test_an_rpc_that_is_none_of_a_satellite(town: Any) -> None:
    town.camera(2, lambda rpc: replace(rpc, lat_scale=1e-7, lon_scale=1e-7))
    refused(town, "TOWN_002.tif: found")


# ---- heights --------------------------------------------------------------------------------------------


def test_heights_of_another_unit_or_datum(town: Any) -> None:
    result = prep(town, "--min-height", "-98.4", "--max-height", "-95.1")
    assert result.exit_code == 1
    assert "heights: found -98.4 to -95.1 m with 0 % of the tie points" in result.stderr
    assert "expected metres above the WGS84 ellipsoid" in result.stderr
    made(town, "heights 0 to 160 m hold", "are they metres", options=["--min-height", "0", "--max-height", "160"])


def in_feet(rpc: Any) -> Any:
    return replace(rpc, alt_offset=rpc.alt_offset / 0.3048, alt_scale=rpc.alt_scale / 0.3048)


def test_cameras_that_count_heights_in_feet(town: Any) -> None:
    """Their pixels lie on the ground as long as at 30 degrees off nadir, their lines of sight seem to be at 10."""
    town.all("camera", in_feet)
    warned(town, "are the heights of the RPCs feet?")


def test_heights_that_the_earth_has_not(town: Any) -> None:
    refused(town, "'--min-height'", options=["--min-height", "-1e308"], code=2)
    refused(town, "'--max-height'", options=["--max-height", "nan"], code=2)
    refused(town, "found lowest 50 m and highest 5 m", options=["--min-height", "50", "--max-height", "5"])


def test_good_heights_need_no_word() -> None:
    ties = np.linspace(-20, 30, 200)
    assert check_heights(-30, 60, ties, True) == []
    assert check_heights(-10, 5, ties, False) == []


# ---- pixels ---------------------------------------------------------------------------------------------

RGBA = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]


def test_a_transparency_mask_is_no_spectral_band(town: Any) -> None:
    def masked(values: Any) -> Any:
        mask = np.where(np.arange(values.shape[2]) < 20, 0, 2047).astype(values.dtype)
        return np.concatenate([values, np.broadcast_to(mask, values[:1].shape)])

    for number in range(1, 5):
        town.pixels(number, masked, RGBA)
    refused(town, "TOWN_001.tif: found a transparency mask in band 4", "gdal_translate -b 1 -b 2 -b 3")


def test_near_infrared_marked_as_transparency_is_a_spectral_band(town: Any) -> None:
    for number in range(1, 5):
        town.pixels(number, lambda values: np.concatenate([values, values[:1] // 2 + 7]), RGBA)
    warned(town, "TOWN_001: band 4 is marked as transparency and taken for a spectral band")


def test_a_palette_is_no_brightness(town: Any) -> None:
    colours = {k: (255 - k, k, k, 255) for k in range(256)}
    for number in range(1, 5):
        town.pixels(number, lambda values: (values[:1] >> 3).astype(np.uint8), palette=colours)
    refused(town, "TOWN_001.tif: found a palette", "gdal_translate -expand rgb")


def test_pixels_of_one_bit_are_no_brightness(town: Any) -> None:
    with rasterio.open(town.image(1)) as data:
        values = (data.read(1) > np.median(data.read(1))).astype(np.uint8)
    profile = {"driver": "GTiff", "count": 1, "dtype": "uint8", "height": values.shape[0], "width": values.shape[1]}
    with rasterio.open(town.image(1), "w", **profile, NBITS=1) as data:
        data.write(values, 1)
    refused(town, "TOWN_001.tif: found pixels of 1 bit, as masks have, expected brightness")


def test_one_band_beside_three(town: Any) -> None:
    town.pixels(2, lambda values: values[:1])
    refused(town, "TOWN_002.tif: found 1 band, expected 3 as most of the other images have")


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_other_types_of_numbers(town: Any, dtype: Any) -> None:
    town.pixels(2, lambda values: (values >> 3).clip(0, 255).astype(dtype))
    warned(town, f"TOWN_002: its pixels are {np.dtype(dtype)}, those of most others uint16")


def test_numbers_that_are_no_brightness(town: Any) -> None:
    town.pixels(2, lambda values: values.astype(np.float32) * np.float32(1e30))
    result = prep(town)
    assert result.exit_code == 1
    assert "TOWN_002.tif: found numbers of up to" in result.stderr


SPOILT = {
    "mirrored": lambda values: values[:, :, ::-1].copy(),
    "noise": lambda values: np.random.default_rng(0).integers(0, 2047, values.shape).astype(np.uint16),
    "one bit": lambda values: (values > np.median(values)).astype(np.uint16),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_an_image_that_cannot_be_tied_to_the_others_is_set_aside(town: Any, kind: Any) -> None:
    town.pixels(2, SPOILT[kind])
    scene = made(town, "TOWN_002: too few tie points with the other images, set aside (role unused)")
    assert roles(scene) == ["train", "unused", "train", "train"]
    if kind == "one bit":
        assert any("grey levels only" in note for note in scene.history[-1]["notes"])


def test_nothing_that_comes_after_uses_an_image_that_was_set_aside(town: Any) -> None:
    town.pixels(2, SPOILT["noise"])
    scene = Scene.from_json(prep(town).stdout)
    for command, *options in (
        ("normalise",),
        ("prior", "--resolution", "2", "--rough-passes", "0"),
        ("fit", "--resolution", "2", "--coarsest", "2", "--epochs", "1"),
    ):
        result = CliRunner().invoke(main, [command, *options], input=scene.to_json())
        assert result.exit_code == 0, result.output
        scene = Scene.from_json(result.stdout)
        if command != "normalise":
            used = scene.history[-1]["made"][command]["items"]
            assert "TOWN_002" not in used
            assert len(used) == 3


def test_two_images_of_which_one_cannot_be_tied_are_refused(town_source: Any, tmp_path: Path) -> None:
    two = Town(tmp_path, town_source, 2)
    two.pixels(2, SPOILT["noise"])
    result = prep(two)
    assert result.exit_code == 1
    assert "tie points: found" in result.stderr


# ---- options --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", ["1e9", "nan", "inf", "0", "-1"])
def test_cells_of_no_size(town: Any, size: Any) -> None:
    refused(town, "--cell-size", options=["--cell-size", size], code=2)


def test_cells_larger_than_the_area(town: Any) -> None:
    result = prep(town, "--cell-size", "60")
    assert result.exit_code == 1
    assert "cell size: found 60 m, " in result.stderr
    assert "expected at least 8 along each side" in result.stderr


@pytest.mark.parametrize(
    ("cell", "edge", "words"),
    [(0.001, 10.0, "for pixels of 0.5 m"), (0.5, 1e5, "expected at most"), (50.0, 100.0, "along each side")],
)
def test_grids_beyond_sense(cell: Any, edge: Any, words: Any) -> None:
    from sattools.errors import InputError

    with pytest.raises(InputError, match=words):
        check_cells(Grid.from_bounds("EPSG:32617", (0, 0, edge, edge), cell), 0.5)


def test_all_images_held_out(town: Any) -> None:
    options = [part for n in range(1, 5) for part in ("--holdout", f"TOWN_{n:03d}")]
    refused(town, "holdout: found 0 of 4 images left for training", options=options)
    refused(town, "did you mean 'TOWN_002'", options=["--holdout", "TOWN_02"])


@pytest.mark.parametrize("bounds", ["1e308 0 1e308 1", "nan 0 1 1", "0 0 inf 1"])
def test_bounds_that_are_no_numbers(town: Any, bounds: Any) -> None:
    refused(town, "--bounds", "finite", options=["--bounds", *bounds.split()], code=2)


def test_a_dry_run_fails_where_the_run_would(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["prep", str(tmp_path / "a.tif"), str(tmp_path / "b.tif"), "--dry-run"])
    assert result.exit_code == 1
    assert "a.tif: no such file" in result.stderr


# ---- valid scenes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind",
    [
        {"hdr": True, "cars": 20, "size": 48.0},
        {"bits": 8, "bias_px": 2.0},
        {"lat": -33.0, "lon": 151.0},
        {"terrain": "natural", "size": 64.0, "views": 3, "train": 3},
        {"terrain": "natural", "size": 64.0, "views": 3, "train": 3, "sun_elevation": 40.0, "sun_azimuth": 200.0},
    ],
    ids=["hdr", "8 bit", "southern", "natural", "natural in the afternoon"],
)
def test_simulated_scenes_get_no_false_error_and_no_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: Any
) -> None:
    scene = simulate(SimulateOptions(**{"id": "S", "size": 32.0, "views": 3, "dates": 2, "seed": 5} | kind), tmp_path)
    paths = sorted((scene.root / "images").glob("*.tif"))
    notes = []
    sources, _, _ = survey(paths, [p.stem for p in paths], PrepOptions(metadata=str(scene.root / "metadata")), notes)
    check_pixels(sources, [read_gray(source) for source in sources])
    assert notes == []
    assert [r.getMessage() for r in caplog.records if r.levelname == "WARNING" and "compiling" not in r.msg] == []


@pytest.mark.parametrize(
    ("images", "metadata"),
    [
        ("dfc2019/Track3-RGB-crops/JAX_068", "dfc2019/rpc_raw/JAX_068"),
        ("pleiades/marseille_triplet", None),
        ("external/city_214/images", "external/city_214/metadata"),
        ("external/natural_12/images", "external/natural_12/metadata"),
    ],
)
def test_real_scenes_get_no_false_error_and_no_warning(
    data_dir: Any, caplog: pytest.LogCaptureFixture, images: Any, metadata: Any
) -> None:
    paths = sorted((data_dir / images).glob("*.tif"))
    assert len(paths) >= 3
    notes = []
    options = PrepOptions(metadata=str(data_dir / metadata) if metadata else None)
    sources, _, _ = survey(paths, [p.stem for p in paths], options, notes)
    assert len(sources) == len(paths)
    assert notes == []
    assert [r.getMessage() for r in caplog.records if r.levelname == "WARNING"] == []


def test_a_folder_of_metadata_of_other_images_is_told(town: Any) -> None:
    """Suns and cameras would be from elsewhere without a word."""
    for path in sorted((town.folder / "metadata").glob("*.json")):
        path.rename(path.with_name(path.name.replace("TOWN", "CITY")))
    warned(town, "metadata: found no metadata file named like one of the images, expected names such as TOWN_001.json")
    (town.folder / "metadata/CITY_001.json").rename(town.folder / "metadata/TOWN_001.json")
    result = warned(town, "metadata: found no metadata file of", "(TOWN_002, ")
    assert "TOWN_001" not in result.stderr
    for path in town.images()[1:]:
        (town.folder / f"metadata/CITY_{path.stem[-3:]}.json").rename(path.with_suffix(".json"))  # beside it
    assert "metadata file" not in prep(town, "--dry-run").stderr

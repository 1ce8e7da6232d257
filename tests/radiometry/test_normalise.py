"""`normalise`: what the numbers become, what is masked, and what the scene says about it."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from synthetic_views import parallel_rpc

from sattools.camera import RPC
from sattools.errors import SceneError
from sattools.radiometry.linear import invalid_numbers, undo_gamma
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.saturated import conversion_of
from sattools.radiometry.stage import LABELS, normalise
from sattools.scene import Asset, Item, Scene
from sattools.scene.raster import read_image

CAMERA = parallel_rpc()


def numbers(*values: Any, bands: Any = 1) -> Any:
    """An image of one row; value times band number."""
    row = np.array(values, np.uint16)
    return np.stack([row * (b + 1) for b in range(bands)])[:, None]


def result(scene: Any, name: Any = "i0") -> Any:
    return read_image(scene.path(f"radiance/{name}.tif"))[:, 0]


@pytest.mark.drawn
def test_numbers_are_divided_by_the_full_scale_and_nothing_is_clipped(make_scene: Any) -> None:
    scene = make_scene(numbers(100, 30, 2046))
    found = normalise(scene, NormaliseOptions(black=50))
    assert result(scene)[0].tolist() == pytest.approx([50 / 1997, -20 / 1997, 1996 / 1997])
    assert found["images"]["i0"]["below_0"] == pytest.approx(1 / 3, abs=1e-6)
    item = scene.items[0]
    assert (item.properties["sattools:radiance"], item.properties["sattools:tone"]) == ("relative", "linear")
    assert item.assets["radiance"].href == "radiance/i0.tif"
    assert found["notes"] == [
        "linear up to an unknown factor: no metadata with a calibration and a solar irradiance were found"
    ]
    assert scene.path(scene.products["radiance_histogram"]).read_bytes()[:4] == b"\x89PNG"
    with rasterio.open(scene.path("radiance/i0.tif")) as data:
        assert RPC.from_tags(data.tags(ns="RPC"), "test").row_offset == CAMERA.row_offset
        assert math.isnan(data.nodata)


def test_saturated_pixels_and_the_frame_are_masked_in_all_bands_and_counted(make_scene: Any) -> None:
    array = numbers(0, 100, 700, 900, bands=3)  # third band: 0, 300, 2100, 2700
    scene = make_scene(array)
    found = normalise(scene, NormaliseOptions())
    assert np.isnan(result(scene)).tolist() == [[True, False, True, True]] * 3
    assert found["images"]["i0"] == {"no_data": 0.25, "saturated": 0.5, "below_0": 0.0, "above_1": 0.0}
    found = normalise(scene, NormaliseOptions(saturated="keep"))
    assert result(scene)[2].tolist()[1:] == pytest.approx([300 / 2047, 2100 / 2047, 2700 / 2047])
    assert found["images"]["i0"]["above_1"] == pytest.approx(2 / 9, abs=1e-6)


def test_white_of_a_tone_mapped_image_is_kept_and_masked_when_asked(make_scene: Any) -> None:
    scene = make_scene(np.array([[[200, 255, 10]]], np.uint8), **{"sattools:bits": 8, "sattools:dtype": "uint8"})
    normalise(scene, NormaliseOptions())
    assert result(scene)[0].tolist() == pytest.approx([200 / 255, 1.0, 10 / 255])
    normalise(scene, NormaliseOptions(saturated="mask"))
    assert np.isnan(result(scene)[0]).tolist() == [False, True, False]


def test_masked_saturated_pixels_are_noted_as_they_would_have_become_radiance(make_scene: Any) -> None:
    scene = make_scene(numbers(0, 100, 700, 900, bands=3))  # third band: 0, 300, 2100, 2700
    normalise(scene, NormaliseOptions(black=47, bands=["3", "1"]))
    item = scene.items[0]
    noted = item.assets["radiance"].extra["sattools:saturated"]
    assert noted["bands"] == [3, 1]
    assert noted["gain"] == pytest.approx([1 / 2000] * 2, rel=1e-6)  # radiance is of single precision
    assert noted["offset"] == pytest.approx([-47 / 2000] * 2, rel=1e-6)
    again = Scene.from_json(scene.to_json())
    assert again.items[0].assets["radiance"].extra["sattools:saturated"] == noted
    found = conversion_of(item).saturated(result(scene)[:, None], numbers(0, 100, 700, 900, bands=3))
    assert found.at.tolist() == [2, 3]  # not the frame
    assert found.radiance[0].tolist() == pytest.approx([2053 / 2000, 2653 / 2000])
    assert found.radiance[1].tolist() == pytest.approx([653 / 2000, 853 / 2000])
    normalise(scene, NormaliseOptions(saturated="keep"))
    assert conversion_of(item) is None


def test_the_conversion_is_that_of_matched_dates(make_scene: Any) -> None:
    first = np.random.default_rng(0).integers(200, 900, (2, 40, 50)).astype(np.uint16)
    second = (first * 0.5 + 100).astype(np.uint16)
    second[:, 0, 0] = 2047
    scene = make_scene(first, second)
    normalise(scene, NormaliseOptions(match=True))
    radiance, conversion = read_image(scene.path("radiance/i1.tif")), conversion_of(scene.items[1])
    gain, offset = (np.array(part)[:, None, None] for part in (conversion.gain, conversion.offset))
    known = np.isfinite(radiance)
    np.testing.assert_allclose((gain * second + offset)[known], radiance[known], atol=1e-6)


def test_matching_sees_saturated_roofs_and_the_fit_does_not(make_town: Any) -> None:
    from sattools.views import load_sources, with_bands

    scene = make_town()
    before = load_sources(scene, scene.items)[0]
    level = int(np.nanpercentile(before.radiance, 98) * 2047)
    normalise(scene, NormaliseOptions(saturation=level))
    after = load_sources(scene, scene.items)[0]
    masked = np.isnan(after.radiance).any(axis=0) & np.isfinite(before.radiance).all(axis=0)
    assert 0.01 < masked.mean() < 0.2
    np.testing.assert_allclose(after.complete().radiance, before.radiance, atol=1e-6)
    (first,) = with_bands([after], scene.items[:1], ["2"])
    np.testing.assert_allclose(first.complete().radiance[0], before.radiance[1], atol=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"bands": [1, 2, 9]}, {"gain": [1.0]}, {"bands": [1], "gain": [1.0], "offset": [0.0]}]
)
def test_a_conversion_of_another_image_is_told(saturated_town: Scene, caplog: Any, wrong: Any) -> None:
    from sattools.views import load_sources

    scene = Scene.from_json(saturated_town.to_json())
    scene.items[0].assets["radiance"].extra["sattools:saturated"] |= wrong
    assert [source.saturated is None for source in load_sources(scene, scene.items)[:2]] == [True, False]
    assert "saturated pixels stay unknown: found an image of 3 bands" in caplog.text


def test_a_missing_original_costs_no_more_than_its_saturated_pixels(
    saturated_town: Scene, tmp_path: Path, caplog: Any
) -> None:
    from sattools.views import load_sources

    scene = Scene.from_json(saturated_town.to_json())
    scene.root = tmp_path / "TOWN"
    shutil.copytree(saturated_town.root, scene.root)
    item = scene.items[0]
    scene.path(item.assets["image"].href).unlink()
    source = load_sources(scene, scene.items)[0]
    assert source.saturated is None
    assert f"{item.id}: its saturated pixels stay unknown" in caplog.text


def test_a_pixel_that_is_dark_in_one_band_is_no_frame() -> None:
    empty, full = invalid_numbers(np.array([[[0.0, 0.0]], [[0.0, 5.0]]]), 2047)
    assert empty.tolist() == [[True, False]]
    assert not full.any()


def test_red_green_and_blue_of_eight_worldview_bands(make_scene: Any) -> None:
    scene = make_scene(numbers(10, 20, bands=8))
    told = "i0: bands 5, 3, 2 of 8 are taken, red, green and blue (others: --bands)"
    assert told in normalise(scene, NormaliseOptions())["notes"]
    assert result(scene)[:, 0] * 2047 == pytest.approx([50, 30, 20])
    assert not [note for note in normalise(scene, NormaliseOptions(bands=["7", "1"]))["notes"] if "taken" in note]
    assert result(scene)[:, 0] * 2047 == pytest.approx([70, 10])
    with pytest.raises(SceneError, match=r"found '9', expected a number up to 8 or a name that i0 has \(C, B, .*\)$"):
        normalise(scene, NormaliseOptions(bands=["9"]))


def test_bands_are_taken_by_their_names(make_scene: Any) -> None:
    scene = make_scene(numbers(10, 20, bands=8))
    normalise(scene, NormaliseOptions(bands=["nir08", "Red", "b", "1"]))
    assert result(scene)[:, 0] * 2047 == pytest.approx([70, 50, 20, 10])
    with pytest.raises(SceneError, match=r"--bands: found '5,3,2', .* \(each in a --bands of its own\)$"):
        normalise(scene, NormaliseOptions(bands=["5,3,2"]))
    with pytest.raises(SceneError, match=r"^--bands: found bands \[5, 5\] of i0, expected each of them once$"):
        normalise(scene, NormaliseOptions(bands=["red", "5"]))


def test_bands_are_taken_by_the_names_that_a_file_has_for_them(make_scene: Any) -> None:
    scene = make_scene(numbers(10, 20, bands=3), platform=None)
    with pytest.raises(SceneError) as error:  # which are numbers alone
        normalise(scene, NormaliseOptions(bands=["nir"]))
    assert str(error.value) == "--bands: found 'nir', expected a number up to 3: i0 does not name its bands"
    assert not (scene.root / "radiance").exists()
    scene.items[0].assets["image"].extra["eo:bands"] = [{"name": "red"}, {"name": "NIR"}, {"name": "swir"}]
    normalise(scene, NormaliseOptions(bands=["nir", "RED"]))
    assert result(scene)[:, 0] * 2047 == pytest.approx([20, 10])


def test_eight_bit_images_are_recognised_and_linearised_only_when_asked(make_scene: Any) -> None:
    array = numbers(0, 51, 128, 254).astype(np.uint8)
    scene = make_scene(array, **{"sattools:bits": 8})
    found = normalise(scene, NormaliseOptions())
    assert result(scene)[0, 1] == pytest.approx(0.2)
    assert scene.items[0].properties["sattools:tone"] == "tone-mapped"
    assert "8-bit numbers: found a tone-mapped image, left as they are" in found["notes"][-1]
    normalise(scene, NormaliseOptions(gamma=2.2))
    assert result(scene)[0, 1] == pytest.approx(0.2**2.2)
    assert scene.items[0].properties["sattools:tone"] == "linear"


def test_undoing_a_gamma_keeps_the_sign() -> None:
    assert undo_gamma(np.array([-0.5, 0.0, 0.5]), 2.0).tolist() == [-0.25, 0.0, 0.25]


def test_images_of_one_sensor_share_their_bits(make_scene: Any) -> None:
    scene = make_scene(numbers(100, 2000), numbers(100, 900))
    scene.items[1].properties["sattools:bits"] = 10
    found = normalise(scene, NormaliseOptions())
    assert result(scene, "i1")[0, 0] == result(scene, "i0")[0, 0]
    assert "i1: values fit 10 bits, taken as 11 like its sensor's others" in found["notes"]


def test_dates_are_brought_to_the_first_one(make_scene: Any) -> None:
    first = np.random.default_rng(0).integers(200, 900, (2, 40, 50)).astype(np.uint16)
    scene = make_scene(first, (first * 0.5 + 100).astype(np.uint16))
    normalise(scene, NormaliseOptions(match=True))
    a, b = (read_image(scene.path(f"radiance/i{k}.tif")) for k in range(2))
    assert np.abs(a - b).max() < 2 / 2047  # the second image was rounded to whole numbers, then doubled


@pytest.mark.drawn  # tiny numbers along its axes
def test_dates_of_tiny_numbers_are_brought_to_the_first_one_too(make_scene: Any) -> None:
    first = (np.random.default_rng(0).integers(200, 900, (2, 40, 50)) * 1e-9).astype(np.float32)
    scene = make_scene(first, first * np.float32(0.5), **{"sattools:bits": 1})
    normalise(scene, NormaliseOptions(match=True))
    a, b = (read_image(scene.path(f"radiance/i{k}.tif")) for k in range(2))
    np.testing.assert_allclose(a, first, rtol=1e-4)
    np.testing.assert_allclose(b, first, rtol=1e-4)


@pytest.mark.parametrize("flat", [0, 1])
def test_bands_that_are_mostly_one_number_are_matched_by_their_middle_alone(make_scene: Any, flat: int) -> None:
    images = [np.arange(200, 1200, dtype=np.uint16).reshape(1, 25, 40) for _ in range(2)]
    images[flat][0, :24] = 100  # water, say; the rest goes on as it is
    scene = make_scene(*images)
    found = normalise(scene, NormaliseOptions(match=True))
    middle = 100.0 if flat == 0 else 699.5  # of the first
    shift = middle - (699.5 if flat == 0 else 100.0)
    wanted = images[1][0] + shift
    assert read_image(scene.path("radiance/i1.tif"))[0] == pytest.approx(wanted / 2047, abs=1e-6)
    assert "i1: band 1: most pixels here or in the first image are one number, no gain is known" in found["notes"]


def test_what_many_images_have_alike_is_said_in_one_line(make_scene: Any) -> None:
    first = np.arange(200, 1200, dtype=np.uint16).reshape(1, 25, 40).repeat(2, axis=0)
    first[0, :24] = 100
    level = first.copy()
    level[1, :24] = 100
    found = normalise(make_scene(first, first, level, first, first, first), NormaliseOptions(match=True))
    (line,) = [note for note in found["notes"] if "no gain is known" in note]
    assert line.startswith("i1, i3, i4 and 1 more: band 1; i2: band 1, 2: most pixels here or in the first image are")
    pictures = [numbers(10, 250).astype(np.uint8) for _ in range(5)]
    found = normalise(make_scene(*pictures, **{"sattools:bits": 8}), NormaliseOptions())
    assert [note for note in found["notes"] if "tone-mapped image" in note] == [
        "i0, i1, i2 and 2 more: 8-bit numbers: found a tone-mapped image, left as they are (give --gamma)"
    ]


def test_the_fit_reads_the_radiance(make_town: Any) -> None:
    from sattools.views import load_sources

    scene = make_town()
    before = load_sources(scene, scene.items)[0]
    normalise(scene, NormaliseOptions())
    after = load_sources(scene, scene.items)[0]
    known = np.isfinite(after.radiance)
    assert known.mean() > 0.9
    assert np.array_equal(after.radiance[known], before.radiance[known])
    assert after.linear


@pytest.mark.parametrize(("folder", "bits"), [("nitf", 11), ("pleiades/marseille_triplet", 12)])
def test_real_images(data_dir: Any, tmp_path: Path, folder: Any, bits: Any) -> None:
    path = sorted(p for p in (data_dir / folder).iterdir() if p.suffix.lower() in (".ntf", ".tif"))[0]
    scene = Scene("REAL", tmp_path)
    properties = {"sattools:bits": bits, "sattools:dtype": "uint16", "datetime": None}
    scene.items.append(Item("a", None, None, properties, {"image": Asset(str(path))}))
    found = normalise(scene, NormaliseOptions())
    radiance = read_image(scene.path("radiance/a.tif"))
    assert np.allclose(radiance * (2**bits - 1), read_image(path), atol=1e-3)
    assert json.loads(json.dumps(found))["quantity"] == "relative"


@pytest.mark.parametrize("label", LABELS.values())
def test_the_histograms_labels_stay_within_the_picture(
    label: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sattools.radiometry import histogram

    figures: list[Any] = []
    monkeypatch.setattr(histogram, "write_figure", lambda path, figure: figures.append(figure))
    bands = [np.linspace(0.0, 1.0, 50)]
    histogram.histogram_figure(bands, bands, ("digital number", label), "scene", tmp_path / "histogram.png")
    figures[0].canvas.draw()
    drawn = figures[0].axes[1].xaxis.label.get_window_extent()
    assert figures[0].bbox.x0 <= drawn.x0 < drawn.x1 <= figures[0].bbox.x1
    assert drawn.y0 >= figures[0].bbox.y0


@pytest.mark.parametrize(
    ("most", "full"),
    [
        (0.9, 1.0), (1.0, 1.0), (1.3, 3.0), (1500.0, 2047.0), (9000.0, 16383.0),
        (9e-3, 1.0), (1.5e-3, 2**-9), (2e-10, 2**-32),  # no scene is as dark as the last two: small units
    ],
)  # fmt: skip
def test_floating_point_numbers_are_shares_of_what_holds_the_largest(make_scene: Any, most: Any, full: Any) -> None:
    image = np.array([[[0.25 * most, most]]], np.float32)
    scene = make_scene(image, **{"sattools:bits": None, "sattools:value_range": [0.25 * most, most]})
    normalise(scene, NormaliseOptions())
    np.testing.assert_allclose(result(scene)[0], [0.25 * most / full, most / full], rtol=1e-6)
    assert scene.items[0].properties["sattools:tone"] == "linear"


def test_one_dark_image_beside_others_is_dark_and_has_no_scale_of_its_own(make_scene: Any) -> None:
    night, day = (np.array([[[0.25 * most, most]]], np.float32) for most in (2e-3, 0.5))
    scene = make_scene(night, day, **{"sattools:bits": None})
    for item, most, platform in zip(scene.items, (2e-3, 0.5), ("A", "B"), strict=True):
        item.properties |= {"sattools:value_range": [0.25 * most, most], "platform": platform}
    normalise(scene, NormaliseOptions())
    np.testing.assert_allclose(result(scene)[0], night[0, 0], rtol=1e-6)


def test_images_of_other_bands_than_the_first_one_are_told_before_anything_is_written(make_scene: Any) -> None:
    scene = make_scene(numbers(10, 20, bands=3), numbers(10, 20))
    with pytest.raises(SceneError, match=r"^i1: found 1 band, expected 3 as of i0 \(--bands takes the same of all\)$"):
        normalise(scene, NormaliseOptions())
    assert not (scene.root / "radiance").exists()
    normalise(scene, NormaliseOptions(bands=["1"]))
    assert result(scene, "i1").tolist() == result(scene).tolist()

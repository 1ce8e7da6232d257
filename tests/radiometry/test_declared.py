"""`normalise` on numbers that are calibrated already: declared by the user, by metadata, or by the file itself."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import rasterio
from synthetic_views import parallel_rpc

from sattools.errors import InputError, SceneError
from sattools.radiometry.bands import PLATFORM_BANDS, eo_bands, names_of
from sattools.radiometry.declared import Declared, parse_scale, read_declared
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import Asset, Item, Scene
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import read_image

DIMAP = """<Dimap_Document><Product_Information/><Processing_Information><Product_Settings><Radiometric_Settings>
<RADIOMETRIC_PROCESSING>REFLECTANCE</RADIOMETRIC_PROCESSING></Radiometric_Settings></Product_Settings>
</Processing_Information><Radiometric_Data><Band_Measurement_List>
<Band_Reflectance><BAND_ID>B0</BAND_ID><GAIN>10000</GAIN><BIAS>0.01</BIAS></Band_Reflectance>
<Band_Reflectance><BAND_ID>B2</BAND_ID><GAIN>5000</GAIN><BIAS>0</BIAS></Band_Reflectance>
<Band_Radiance><BAND_ID>B0</BAND_ID><GAIN>10</GAIN><BIAS>0</BIAS></Band_Radiance>
</Band_Measurement_List></Radiometric_Data>
<Raster_Index_List><Raster_Index><BAND_ID>B2</BAND_ID><BAND_INDEX>1</BAND_INDEX></Raster_Index>
<Raster_Index><BAND_ID>B0</BAND_ID><BAND_INDEX>2</BAND_INDEX></Raster_Index></Raster_Index_List></Dimap_Document>"""
PLANET = """<ps:EarthObservation xmlns:ps="http://schemas.planet.com/ps/v1/planet_product_metadata_geocorrected_level">
<ps:bandSpecificMetadata><ps:bandNumber>2</ps:bandNumber><ps:radiometricScaleFactor>0.01</ps:radiometricScaleFactor>
<ps:reflectanceCoefficient>2.2e-05</ps:reflectanceCoefficient></ps:bandSpecificMetadata>
<ps:bandSpecificMetadata><ps:bandNumber>1</ps:bandNumber>
<ps:reflectanceCoefficient>2.1e-05</ps:reflectanceCoefficient></ps:bandSpecificMetadata></ps:EarthObservation>"""


def make_scene(folder: Path, array: np.ndarray, *, scales: list[float] | None = None, **properties: object) -> Scene:
    """A scene of one image ``i0`` that lies in ``folder/delivery`` beside its metadata."""
    scene = Scene("N", folder / "N")
    path = scene.output("images/i0.tif")
    source = folder / "delivery/i0.tif"
    source.parent.mkdir(exist_ok=True)
    for place in (path, source):
        with rasterio.open(
            place, "w", driver="GTiff", dtype=array.dtype, count=array.shape[0], height=array.shape[1],
            width=array.shape[2],
        ) as data:  # fmt: skip
            data.write(array)
            data.update_tags(ns="RPC", **parallel_rpc().to_tags())
            if scales:
                data.scales = scales
    known: JsonObject = {"sattools:bits": 14, "sattools:dtype": str(array.dtype), "sattools:bands": array.shape[0]}
    known |= {"sattools:source": str(source), "datetime": "2015-05-02T16:19:43Z", "platform": "WorldView-3"}
    known |= {"view:sun_azimuth": 110.0, "view:sun_elevation": 30.0, **properties}
    scene.items.append(Item("i0", None, None, known, {"image": Asset("images/i0.tif")}))
    return scene


def two_bands() -> np.ndarray:
    return np.array([[[1000, 16383, 0]], [[2000, 65535, 0]]], np.uint16)


def values(scene: Scene) -> np.ndarray:
    return read_image(scene.path("radiance/i0.tif"))[:, 0]


def test_numbers_that_are_reflectance_already_are_declared(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands())
    options = NormaliseOptions(quantity="toa_reflectance", scale="1/10000", offset=-0.1, saturated="keep")
    assert normalise(scene, options)["quantity"] == "toa_reflectance"
    # 16383 is no saturation: reflectance may take any number of the file
    np.testing.assert_allclose(values(scene), [[0.0, 1.5383, np.nan], [0.1, 6.4535, np.nan]], atol=1e-6)
    assert scene.items[0].properties["sattools:radiance"] == "toa_reflectance"
    assert scene.items[0].properties["sattools:tone"] == "linear"


def test_the_largest_number_of_the_file_counts_as_saturated(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands())
    result = normalise(scene, NormaliseOptions(quantity="reflectance_factor", scale="0.0001"))
    assert result["images"]["i0"]["saturated"] == pytest.approx(1 / 3, abs=1e-6)
    np.testing.assert_allclose(values(scene)[:, 0], [0.1, 0.2], atol=1e-6)


def test_reflectance_in_floats_and_in_eight_bits(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, np.array([[[0.25, 0.5, 2.5]]], np.float32))
    normalise(scene, NormaliseOptions(quantity="toa_reflectance", scale="1"))
    np.testing.assert_allclose(values(scene)[0], [0.25, 0.5, 2.5])
    scene = make_scene(tmp_path, np.array([[[51, 102, 204]]], np.uint8), **{"sattools:bits": 8})
    assert not normalise(scene, NormaliseOptions(quantity="toa_reflectance", scale="1/255"))["notes"]
    np.testing.assert_allclose(values(scene)[0], [0.2, 0.4, 0.8], atol=1e-6)


def test_a_scale_that_makes_everything_brighter_than_white_is_noticed(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands())
    notes = normalise(scene, NormaliseOptions(quantity="toa_reflectance", scale="1/100"))["notes"]
    assert any("reflectance above 1 (is the scale right?)" in text for text in notes)


def told_of_bright(notes: list[str]) -> list[str]:
    return [text for text in notes if "a reflectance above 1" in text]


@pytest.mark.parametrize(("count", "told"), [(10, False), (11, True)])
def test_reflectances_above_1_of_more_than_a_hundredth_are_noticed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, count: int, told: bool
) -> None:
    array = np.full((1, 25, 40), 4000, np.uint16)  # 1000 pixels
    array.flat[:count] = 10001
    scene = make_scene(tmp_path, array)
    notes = normalise(scene, NormaliseOptions(quantity="toa_reflectance", scale="1/10000"))["notes"]
    why = "is the scale right? Clouds, snow and walls in a low sun may have that"
    expected = [f"i0: 1 % of the pixels have a reflectance above 1 ({why})"] if told else []
    assert told_of_bright(notes) == told_of_bright(caplog.messages) == expected


def test_images_that_are_too_bright_alike_are_told_of_in_one_line(tmp_path: Path) -> None:
    array = np.full((1, 25, 40), 4000, np.uint16)
    array.flat[:30] = 10001
    scene = make_scene(tmp_path, array)
    one = scene.items[0]
    scene.items.append(replace(one, id="i1", properties=dict(one.properties), assets=dict(one.assets)))
    notes = normalise(scene, NormaliseOptions(quantity="toa_reflectance", scale="1/10000"))["notes"]
    (told,) = told_of_bright(notes)
    assert told.startswith("i0, i1: up to 3 % of the pixels have a reflectance above 1 (is the scale right?")


@pytest.mark.parametrize("saturated", ["mask", "keep"])
def test_glints_that_saturate_say_nothing_of_the_scale(tmp_path: Path, saturated: Literal["mask", "keep"]) -> None:
    array = np.full((1, 25, 40), 4000, np.uint16)
    array.flat[:100] = 65535
    options = NormaliseOptions(quantity="toa_reflectance", scale="1/10000", saturated=saturated)
    found = normalise(make_scene(tmp_path, array), options)
    assert found["images"]["i0"]["above_1"] == (0.1 if saturated == "keep" else 0)
    assert told_of_bright(found["notes"]) == []


def test_an_offset_that_makes_ground_darker_than_black_is_noticed(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands())
    options = NormaliseOptions(quantity="toa_reflectance", scale="1/10000", offset=-2.0, saturated="keep")
    assert any(
        "75 % of the pixels are below 0 (are --black and --offset right?)" in t
        for t in normalise(scene, options)["notes"]
    )
    scene = make_scene(tmp_path / "black", two_bands(), **{"sattools:bits": 16})
    assert any(
        "75 % of the pixels are below 0" in t
        for t in normalise(scene, NormaliseOptions(black=20000, saturated="keep"))["notes"]
    )


def test_floating_point_numbers_of_unknown_range_are_not_saturated(tmp_path: Path) -> None:
    numbers = np.array([[[100.0, 2500.0, 9000.0]]], np.float32)
    scene = make_scene(tmp_path, numbers, **{"sattools:bits": None})
    assert normalise(scene, NormaliseOptions())["images"]["i0"]["saturated"] == 0
    np.testing.assert_allclose(values(scene)[0] * 2047, [100.0, 2500.0, 9000.0], rtol=1e-5)
    scene = make_scene(tmp_path / "bits", numbers, **{"sattools:bits": None})
    assert normalise(scene, NormaliseOptions(bits=12))["images"]["i0"]["saturated"] == pytest.approx(1 / 3, abs=1e-6)


def test_a_gamma_that_is_for_other_images_is_told(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands(), **{"sattools:bits": 16})
    notes = normalise(scene, NormaliseOptions(gamma=2.2))["notes"]
    assert "i0: --gamma is for 8-bit images, not applied" in notes


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"scale": "1/10000"}, "--scale: found --quantity auto, expected toa_reflectance"),
        ({"scale": "1/10000", "quantity": "relative"}, "--scale: found --quantity relative"),
        ({"scale": "ten", "quantity": "toa_reflectance"}, "--scale: found 'ten', expected a positive number"),
        ({"scale": "1/0", "quantity": "toa_reflectance"}, "--scale: found '1/0'"),
        ({"scale": "-1", "quantity": "toa_reflectance"}, "--scale: found '-1'"),
        ({"scale": "nan", "quantity": "toa_reflectance"}, "--scale: found 'nan'"),
        ({"scale": "1e300", "quantity": "toa_reflectance"}, "--scale: found '1e300'"),
        ({"scale": "1e-300", "quantity": "toa_reflectance"}, "--scale: found '1e-300'"),
        ({"black": 65535}, "--black: found 65535, expected less than 65535, white in the 16 bits of i0"),
        ({"black": 1e9}, "--black: found 1e+09, expected less than 65535, white in the 16 bits of i0"),
        ({"offset": 0.5}, "--offset: found it without --scale"),
        ({"saturation": 0.0}, "--saturation: found 0, expected more than 0, the number of no light"),
        ({"saturation": 90.0, "black": 100.0}, "--saturation: found 90, expected more than 100"),
        ({"bands": ["2", "1", "2"]}, "--bands: found bands [2, 1, 2] of i0, expected each of them once"),
    ],
)
def test_a_declaration_that_cannot_be_meant_stops_with_one_line(
    tmp_path: Path, changed: dict[str, object], words: str
) -> None:
    scene = make_scene(tmp_path, two_bands(), **{"sattools:bits": 16})
    with pytest.raises(SceneError) as error:
        normalise(scene, NormaliseOptions(**changed))
    assert str(error.value).startswith(words)
    assert not (scene.root / "radiance").exists()


def test_a_fraction_is_a_scale() -> None:
    assert parse_scale(" 1 / 10000 ") == parse_scale("1e-4") == 1e-4


def test_a_dimap_reflectance_product_says_so_itself(tmp_path: Path) -> None:
    """Not its radiance gains: those do not belong to numbers that are reflectance."""
    scene = make_scene(tmp_path, two_bands(), platform="Pleiades-1A")
    (tmp_path / "delivery/DIM_i0.XML").write_text(DIMAP)
    assert normalise(scene, NormaliseOptions(saturated="keep"))["quantity"] == "toa_reflectance"
    # the raster's first band is B2
    np.testing.assert_allclose(values(scene)[:, 0], [1000 / 5000, 2000 / 10000 + 0.01], atol=1e-6)
    bands = scene.items[0].assets["radiance"].extra["eo:bands"]
    assert [(b["name"], b["common_name"], b["center_wavelength"]) for b in bands] == [
        ("B2", "red", 0.65),
        ("B0", "blue", 0.49),
    ]
    with pytest.raises(SceneError, match="reflectance_factor was asked for, but the images are toa_reflectance"):
        normalise(scene, NormaliseOptions(quantity="reflectance_factor"))


def test_other_dimap_products_say_nothing_of_the_kind(tmp_path: Path) -> None:
    path = tmp_path / "DIM_X.XML"
    path.write_text(DIMAP.replace("REFLECTANCE</RADIO", "BASIC</RADIO"))
    assert read_declared(path, tmp_path / "X.tif") is None
    path.write_text(DIMAP.replace("<GAIN>5000<", "<GAIN>0<"))
    with pytest.raises(InputError, match=r"DIM_X.XML: found '0' as GAIN of band B2, expected a positive number"):
        read_declared(path, tmp_path / "X.tif")


def test_planet_coefficients_in_the_order_of_the_bands(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands(), platform=None)
    (tmp_path / "delivery/i0_metadata.xml").write_text(PLANET)
    assert normalise(scene, NormaliseOptions(saturated="keep"))["quantity"] == "toa_reflectance"
    np.testing.assert_allclose(values(scene)[:, 0], [0.021, 0.044], atol=1e-6)
    (tmp_path / "delivery/i0_metadata.xml").write_text(PLANET.replace("2.2e-05", "often"))
    with pytest.raises(InputError, match="found 'often' as reflectanceCoefficient of band 2"):
        normalise(scene, NormaliseOptions())


@pytest.mark.parametrize("version", ["raster:bands", "bands"])
def test_a_stac_item_states_a_scale_but_not_of_what(tmp_path: Path, version: str) -> None:
    prefix = "" if version == "raster:bands" else "raster:"
    bands = [{f"{prefix}scale": 0.0001, f"{prefix}offset": -0.1}] * 2
    item = {"type": "Feature", "properties": {}, "assets": {"data": {"href": "./i0.tif", version: bands}, "thumb": {}}}
    scene = make_scene(tmp_path, two_bands(), platform=None)
    (tmp_path / "delivery/i0.json").write_text(json.dumps(item))
    result = normalise(scene, NormaliseOptions())
    assert result["quantity"] == "relative"
    assert any("i0.json states a scale but not of what (expected --quantity)" in text for text in result["notes"])
    normalise(scene, NormaliseOptions(quantity="toa_reflectance", saturated="keep"))
    np.testing.assert_allclose(values(scene)[:, 0], [0.0, 0.1], atol=1e-6)


def test_a_stac_item_may_state_the_scale_of_all_bands_once(tmp_path: Path) -> None:
    image, path = tmp_path / "a b.tif", tmp_path / "a b.json"
    whole = {"href": "https://x.org/v/a%20b.tif?sig=1", "raster:scale": 0.0001, "raster:offset": -0.1}

    def declared(**more: object) -> tuple[tuple[float, ...], tuple[float, ...]]:
        other = {"href": "other.tif", "raster:scale": 7.0}
        path.write_text(json.dumps({"type": "Feature", "assets": {"other": other, "data": whole | more}}))
        found = read_declared(path, image)
        assert found is not None
        return found.gain, found.offset

    assert declared() == ((0.0001,), (-0.1,))
    own = {"name": "nir", "raster:scale": 0.0002}
    assert declared(bands=[{"name": "red"}, own]) == ((0.0001, 0.0002), (-0.1, -0.1))


def test_so_does_a_geotiff_with_scales(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands(), scales=[1e-4, 2e-4], platform=None)
    assert normalise(scene, NormaliseOptions())["quantity"] == "relative"
    normalise(scene, NormaliseOptions(quantity="reflectance_factor", saturated="keep", bands=["2"]))
    np.testing.assert_allclose(values(scene)[:, 0], [0.4], atol=1e-6)


def test_a_scale_that_is_not_the_files_own_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The file's offset is dropped with its scale: every value would be off by it without a word."""
    scene = make_scene(tmp_path, two_bands(), scales=[1e-4, 2e-4], platform=None)
    entry = normalise(scene, NormaliseOptions(quantity="toa_reflectance", scale="1/10000"))
    told = "states scale 0.0001 and offset 0, which --scale 0.0001 and --offset 0 replace"
    assert [told in note for note in entry["notes"]].count(True) == 1
    assert told in caplog.text
    assert values(scene)[1].flat[0] == pytest.approx(0.2)  # 2000 / 10000, not 0.4 as the file has it


def test_the_files_own_scale_given_once_more_is_nothing_to_tell(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands(), scales=[1e-4, 1e-4], platform=None)
    entry = normalise(scene, NormaliseOptions(quantity="toa_reflectance", scale="1/10000"))
    assert not any("replace" in note for note in entry["notes"])


def test_a_broken_scale_of_the_file_may_be_replaced(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands(), scales=[0.0, 0.0], platform=None)
    normalise(scene, NormaliseOptions(quantity="toa_reflectance", scale="1/10000"))
    assert values(scene)[1].flat[0] == pytest.approx(0.2)


def test_a_scale_for_fewer_bands_than_are_asked_for_is_an_error() -> None:
    declared = Declared("toa_reflectance", (1e-4, 1e-4), (0.0, 0.0), "x.xml")
    with pytest.raises(SceneError, match=r"x\.xml: found scales of 2 bands, expected one of band 3"):
        declared.apply(np.zeros((1, 1, 1)), [3])


def test_radiance_becomes_reflectance_by_the_platforms_irradiance(tmp_path: Path) -> None:
    """Pan of WorldView-3: E = 1574.41 W/m2/um, d = 1.00778 AU, sun 30 degrees high; 0.1 * 590 + 1 = 60 W/m2/sr/um."""
    scene = make_scene(tmp_path, np.array([[[590, 100]]], np.uint16), **{"sattools:bits": 11})
    options = NormaliseOptions(quantity="radiance", scale="1/10", offset=1.0)
    assert normalise(scene, options)["quantity"] == "toa_reflectance"
    assert values(scene)[0, 0] == pytest.approx(math.pi * 60.0 * 1.00778**2 / (1574.41 * 0.5), rel=1e-4)
    scene = make_scene(tmp_path, np.array([[[590, 100]]], np.uint16), platform="Nobody-1")
    with pytest.raises(
        SceneError, match=r"radiance was asked for, but of i0 neither metadata nor .* \(Nobody-1\) tell"
    ):
        normalise(scene, options)


def test_numbers_that_nothing_calibrates_may_be_reflectance_already(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands())
    with pytest.raises(SceneError, match=r"found \(numbers that are it already need --scale, 1 or 1/10000, say\)"):
        normalise(scene, NormaliseOptions(quantity="reflectance_factor"))


def test_matched_reflectances_are_none_any_more_and_that_is_told(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands())
    options = NormaliseOptions(quantity="reflectance_factor", scale="1/10000", match=True)
    found = normalise(scene, options)
    assert found["quantity"] == "relative"
    assert found["notes"][0].startswith("--match: found reflectance_factor, which the other images are no longer")


def test_bands_have_names_where_the_platform_has_one_order() -> None:
    assert names_of("WorldView-3", 4) == ("B", "G", "R", "N")
    assert names_of("WorldView-3", 3) == () == names_of(None, 4)
    assert eo_bands("WorldView-2", names_of("WorldView-2", 8), [5])[0]["common_name"] == "red"
    assert eo_bands(None, (), [2]) == [{"name": "band 2"}]
    for bands in PLATFORM_BANDS.values():
        assert all(0.3 < band.low_um < band.centre_um < band.high_um < 1.1 for band in bands)


def planet(*bands: int) -> str:
    """Metadata in which a band's coefficient is a hundred thousandth of its number."""
    rows = "".join(
        f"<bandSpecificMetadata><bandNumber>{band}</bandNumber>"
        f"<reflectanceCoefficient>{band}e-05</reflectanceCoefficient></bandSpecificMetadata>"
        for band in bands
    )
    return f"<EarthObservation>{rows}</EarthObservation>"


@pytest.mark.parametrize("bands", [(1, 2, 3), (1, 2, 3, 4)])
def test_scales_of_an_image_of_other_bands_are_not_taken(tmp_path: Path, bands: tuple[int, ...]) -> None:
    """Somebody has cut red, green and blue out of it: which scale is of which band nobody knows."""
    scene = make_scene(tmp_path, two_bands(), platform=None)
    (tmp_path / "delivery/i0_metadata.xml").write_text(planet(*bands))
    found = normalise(scene, NormaliseOptions())
    why = f"i0_metadata.xml states the scales of {len(bands)} bands, the image has 2"
    assert (found["quantity"], found["notes"][0]) == ("relative", f"linear up to an unknown factor: {why}")
    named = [band["name"] for band in scene.items[0].assets["radiance"].extra["eo:bands"]]
    assert named == ["band 1", "band 2"]  # not blue and green
    with pytest.raises(SceneError, match=f"toa_reflectance was asked for, but of i0 {why}"):
        normalise(scene, NormaliseOptions(quantity="toa_reflectance"))
    normalise(scene, NormaliseOptions(quantity="toa_reflectance", scale="1/10000"))
    np.testing.assert_allclose(values(scene)[:, 0], [0.1, 0.2], atol=1e-6)


def test_radiances_with_scales_of_an_image_of_other_bands_are_not_taken(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, two_bands()[:1])
    item = {"type": "Feature", "assets": {"data": {"href": "i0.tif", "raster:bands": [{"scale": 0.1}, {"scale": 0.2}]}}}
    (tmp_path / "delivery/i0.json").write_text(json.dumps(item))
    with pytest.raises(SceneError, match=r"i0\.json states the scales of 2 bands, the image has 1"):
        normalise(scene, NormaliseOptions(quantity="radiance"))


@pytest.mark.parametrize(
    ("count", "taken", "names"),
    [(8, (6, 4, 2), ["red", "green", "blue"]), (4, (1, 2, 3, 4), ["blue", "green", "red", "nir"])],
)
def test_planets_bands_are_called_as_its_products_have_them(
    tmp_path: Path, count: int, taken: tuple[int, ...], names: list[str]
) -> None:
    """Red, green and blue of its eight are others than WorldView's."""
    array = np.full((count, 1, 3), 10000, np.uint16)
    scene = make_scene(tmp_path, array, platform=None)
    (tmp_path / "delivery/i0_metadata.xml").write_text(planet(*range(1, count + 1)))
    normalise(scene, NormaliseOptions())
    np.testing.assert_allclose(values(scene)[:, 0], [0.1 * number for number in taken], atol=1e-6)
    assert [band["name"] for band in scene.items[0].assets["radiance"].extra["eo:bands"]] == names

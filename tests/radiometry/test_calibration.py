"""`normalise` on numbers that a vendor's metadata calibrate: radiance per number, and the sun's irradiance."""

import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sattools.errors import InputError, SceneError
from sattools.radiometry.calibration import BandCalibration, earth_sun_distance, read_calibration, reflectance
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene.raster import read_image

FACTORS = {"P": 9.5, "C": 9.3, "B": 7.0, "G": 5.7, "Y": 5.1, "R": 5.9, "RE": 4.2, "N": 5.3, "N2": 4.9}
XML_BAND = "<BAND_P><ABSCALFACTOR>0.01</ABSCALFACTOR><EFFECTIVEBANDWIDTH>0.3</EFFECTIVEBANDWIDTH></BAND_P>"
EIGHT = "C B G Y R RE N N2"
DIMAP = """<Dimap_Document><Radiometric_Data><Radiometric_Calibration><Instrument_Calibration><Band_Measurement_List>
<Band_Radiance><BAND_ID>B0</BAND_ID><BIAS>1</BIAS><GAIN>10</GAIN></Band_Radiance>
<Band_Radiance><BAND_ID>B2</BAND_ID><BIAS>0</BIAS><GAIN>8</GAIN></Band_Radiance>
<Band_Solar_Irradiance><BAND_ID>B0</BAND_ID><VALUE>1915</VALUE></Band_Solar_Irradiance>
<Band_Solar_Irradiance><BAND_ID>B2</BAND_ID><VALUE>1594</VALUE></Band_Solar_Irradiance>
</Band_Measurement_List></Instrument_Calibration></Radiometric_Calibration></Radiometric_Data>
<Raster_Index_List><Raster_Index><BAND_ID>B2</BAND_ID><BAND_INDEX>1</BAND_INDEX></Raster_Index>
<Raster_Index><BAND_ID>B0</BAND_ID><BAND_INDEX>2</BAND_INDEX></Raster_Index></Raster_Index_List></Dimap_Document>"""


def imd(names: str, **said: str) -> str:
    """Metadata of WorldView bands in the order in which they are listed."""
    lines = [f'{name} = "{value}";' for name, value in said.items()]
    for name in names.split():
        lines += [f"BEGIN_GROUP = BAND_{name}", f"\tabsCalFactor = {FACTORS[name]}e-03;"]
        lines += ["\teffectiveBandwidth = 5.0e-02;", f"END_GROUP = BAND_{name}"]
    return "\n".join(lines)


def eight_bands(value: int) -> np.ndarray:
    """One pixel; value times band number."""
    return (value * np.arange(1, 9)).reshape(8, 1, 1).astype(np.uint16)


def result(scene: Any) -> Any:
    """Of its only pixel."""
    return read_image(scene.path("radiance/i0.tif"))[:, 0, 0]


def test_reflectance_from_the_calibration_of_a_worldview_image(make_scene: Any, tmp_path: Path) -> None:
    """Red: L = 5.9e-3 / 0.05 * 500 = 59 W/m2/sr/um; E = 1535.33 W/m2/um, d = 1.00778 AU (NREL), sun 30 degrees high."""
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/i0.IMD").write_text(imd(EIGHT))
    options = NormaliseOptions(metadata=str(tmp_path / "meta"))
    scene = make_scene(eight_bands(100))
    assert normalise(scene, options)["quantity"] == "toa_reflectance"
    expected = math.pi * 59.0 * 1.00778**2 / (1535.33 * 0.5)
    assert result(scene)[0] == pytest.approx(expected, rel=1e-4)
    normalise(scene, replace(options, quantity="reflectance_factor"))
    assert result(scene)[0] == pytest.approx(expected / 2, rel=1e-4)
    assert scene.items[0].properties["sattools:radiance"] == "reflectance_factor"
    # without the sun, or with one below the horizon: the quantity that needs none, or a refusal
    scene.items[0].properties["view:sun_elevation"] = -3.0
    assert normalise(scene, options)["quantity"] == "reflectance_factor"
    del scene.items[0].properties["view:sun_elevation"]
    assert normalise(scene, options)["quantity"] == "reflectance_factor"
    with pytest.raises(SceneError, match="toa_reflectance was asked for, but of i0 its sun is unknown"):
        normalise(scene, replace(options, quantity="toa_reflectance"))
    # without a time: the distance of the sun is not known
    scene.items[0].properties["datetime"] = None
    found = normalise(scene, options)
    assert (found["quantity"], found["notes"][0]) == (
        "relative",
        "linear up to an unknown factor: its time is unknown",
    )
    with pytest.raises(SceneError, match="reflectance_factor was asked for, but of i0 its time is unknown"):
        normalise(scene, replace(options, quantity="reflectance_factor"))


def test_dimap_calibration_in_the_order_of_the_raster(tmp_path: Path) -> None:
    path = tmp_path / "DIM_X.XML"
    path.write_text(DIMAP)
    assert read_calibration(path) == [
        BandCalibration("B2", 1 / 8, 0.0, 1594.0),
        BandCalibration("B0", 0.1, 1.0, 1915.0),
    ]
    path.write_text(DIMAP.replace("<GAIN>10<", "<GAIN>0<"))
    with pytest.raises(InputError, match=r"DIM_X.XML: found '0' as GAIN of band B0"):
        read_calibration(path)
    for bias in ("n/a", "nan"):
        path.write_text(DIMAP.replace("<BIAS>1<", f"<BIAS>{bias}<"))
        with pytest.raises(InputError, match=rf"DIM_X.XML: found '{bias}' as BIAS of band B0, expected a number"):
            read_calibration(path)


def test_bands_of_a_dimap_without_numbers_are_in_the_order_of_the_list(tmp_path: Path) -> None:
    path = tmp_path / "DIM_X.XML"
    path.write_text(DIMAP.replace("<BAND_INDEX>1<", "<BAND_INDEX>first<"))
    assert [band.name for band in read_calibration(path)] == ["B0", "B2"]


def test_bands_of_a_dimap_that_the_raster_has_not_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "DIM_X.XML"
    more = "<Band_Radiance><BAND_ID>B1</BAND_ID><GAIN>7</GAIN></Band_Radiance><Band_Radiance><BAND_ID>B0<"
    path.write_text(DIMAP.replace("<Band_Radiance><BAND_ID>B0<", more))
    assert [(band.name, band.gain) for band in read_calibration(path)] == [("B2", 1 / 8), ("B0", 0.1)]


def test_the_sun_is_nearest_in_january() -> None:
    assert earth_sun_distance(datetime(2015, 1, 4, tzinfo=UTC)) == pytest.approx(0.98328, abs=1e-4)
    assert earth_sun_distance(datetime(2015, 7, 6, tzinfo=UTC)) == pytest.approx(1.01668, abs=1e-4)


def test_a_white_lambertian_surface_has_reflectance_one() -> None:
    """It returns pi L = E cos(sun zenith)."""
    radiance = 1500.0 * math.sin(math.radians(40)) / math.pi
    band = [BandCalibration("R", 0.1, 0.0, 1500.0)]
    dn = np.full((1, 1, 1), radiance / 0.1)
    assert reflectance(dn, band, 1.0, 40.0)[0, 0, 0] == pytest.approx(1)


@pytest.mark.parametrize(
    ("listed", "said", "order"),
    [
        ("R G B", {}, "R G B"),
        ("N R G", {"bandId": "NRG"}, "N R G"),
        ("B G R", {"bandId": "RGB"}, "R G B"),
        ("B G N R", {"bandId": "Multi"}, "B G R N"),
        ("B C G N N2 R RE Y", {"bandId": "Multi"}, "C B G Y R RE N N2"),
    ],
)
def test_worldview_bands_have_the_order_of_their_product(
    tmp_path: Path, listed: str, said: dict[str, str], order: str
) -> None:
    """Natural colours are red, green and blue; all bands are in the order of their wavelengths."""
    path = tmp_path / "X.IMD"
    path.write_text(imd(listed, **said))
    assert [band.name for band in read_calibration(path)] == order.split()
    assert [band.gain for band in read_calibration(path)] == pytest.approx(
        [FACTORS[name] / 50 for name in order.split()]
    )


def test_dimap_bands_named_as_worldviews_have_the_order_of_the_raster(make_scene: Any, tmp_path: Path) -> None:
    """Pleiades Neo calls its bands R, G, B."""
    bands = "".join(
        f"<Band_Radiance><BAND_ID>{name}</BAND_ID><GAIN>{gain}</GAIN></Band_Radiance>"
        f"<Band_Solar_Irradiance><BAND_ID>{name}</BAND_ID><VALUE>1500</VALUE></Band_Solar_Irradiance>"
        for name, gain in (("R", 5), ("G", 10), ("B", 20))
    )
    (tmp_path / "DIM_i0.XML").write_text(f"<Dimap_Document>{bands}</Dimap_Document>")
    scene = make_scene(np.full((3, 1, 1), 1000, np.uint16), platform="Pleiades-Neo-3")
    normalise(scene, NormaliseOptions(metadata=str(tmp_path)))
    assert result(scene) / result(scene)[2] == pytest.approx([4, 2, 1])


@pytest.mark.parametrize(
    ("name", "text", "processing"),
    [
        ("i0.IMD", imd(EIGHT, radiometricEnhancement="ACOMP"), "ACOMP"),
        ("i0.IMD", imd(EIGHT, radiometricEnhancement="DRA"), "DRA"),
        ("i0.XML", f"<isd><RADIOMETRICENHANCEMENT>ACOMP</RADIOMETRICENHANCEMENT>{XML_BAND}</isd>", "ACOMP"),
        ("DIM_i0.XML", DIMAP.replace("<Radio", "<RADIOMETRIC_PROCESSING>SEAMLESS</RADIOMETRIC_PROCESSING><Radio", 1),
         "SEAMLESS"),
        ("DIM_i0.XML", DIMAP.replace("<Radio", "<RADIOMETRIC_PROCESSING>REFLECTANCE</RADIOMETRIC_PROCESSING><Radio", 1),
         "REFLECTANCE"),
    ],
)  # fmt: skip
def test_numbers_that_the_vendor_has_processed_are_not_those_of_its_calibration(
    make_scene: Any, tmp_path: Path, name: str, text: str, processing: str
) -> None:
    (tmp_path / name).write_text(text)
    count = {"i0.IMD": 8, "i0.XML": 1, "DIM_i0.XML": 2}[name]
    scene = make_scene(np.full((count, 1, 1), 1000, np.uint16))
    options = NormaliseOptions(metadata=str(tmp_path), bands=["1"])
    found = normalise(scene, options)
    assert found["quantity"] == "relative"
    why = f"{name} says that its numbers are {processing}, which are not those of its calibration"
    assert found["notes"] == [f"linear up to an unknown factor: {why}"]
    with pytest.raises(SceneError, match=f"toa_reflectance was asked for, but of i0 {why}"):
        normalise(scene, replace(options, quantity="toa_reflectance"))
    declared = replace(options, quantity="toa_reflectance", scale="1/10000")
    assert normalise(scene, declared)["quantity"] == "toa_reflectance"
    assert result(scene) == pytest.approx([0.1])


def test_a_band_without_a_calibration_is_no_error(make_scene: Any, tmp_path: Path) -> None:
    """DigitalGlobe writes -1 where it states none."""
    (tmp_path / "i0.IMD").write_text(imd("P", radiometricEnhancement="Off").replace("9.5e-03", "-1.0"))
    scene = make_scene(np.full((1, 1, 1), 1000, np.uint16))
    assert normalise(scene, NormaliseOptions(metadata=str(tmp_path)))["quantity"] == "relative"


def test_a_time_that_names_no_clock_is_utc(make_scene: Any, tmp_path: Path) -> None:
    (tmp_path / "i0.IMD").write_text(imd(EIGHT))
    found = []
    for time in ("2015-05-02T00:00:00Z", "2015-05-02T02:00:00+02:00", "2015-05-02T00:00:00", "2015-05-02"):
        scene = make_scene(eight_bands(100), datetime=time)
        normalise(scene, NormaliseOptions(metadata=str(tmp_path)))
        found.append(result(scene).tolist())
    assert found == [found[0]] * 4

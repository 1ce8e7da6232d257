"""Time, sun and platform are found in vendors' files whatever their dress, and left unknown rather than guessed."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from sattools.errors import InputError
from sattools.prep.metadata import Metadata, find_platform, from_tags, parse_sun, read_sidecar
from sattools.prep.times import parse_time
from sattools.scene.sidecars import sidecars


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("20150502161943", datetime(2015, 5, 2, 16, 19, 43, tzinfo=UTC)),
        ("2015-09-30T10:56:56.973685Z", datetime(2015, 9, 30, 10, 56, 56, 973685, tzinfo=UTC)),
        ("2020-03-04T01:30:00+02:00", datetime(2020, 3, 3, 23, 30, tzinfo=UTC)),
        ("2020-03-03 18:00:00.5-0530", datetime(2020, 3, 3, 23, 30, 0, 500000, tzinfo=UTC)),
        ("2020-03-03T23:30:00-01_R1C1", datetime(2020, 3, 3, 23, 30, tzinfo=UTC)),
        ("2020-03-03T23:30:00+25:00", None),
        ("2014-10-17T17:48:58 +02:00", datetime(2014, 10, 17, 15, 48, 58, tzinfo=UTC)),
        ("2014-10-17T17:48:58+02", datetime(2014, 10, 17, 15, 48, 58, tzinfo=UTC)),
        ("2014-10-17 17:48:58.25 -0230 ", datetime(2014, 10, 17, 20, 18, 58, 250000, tzinfo=UTC)),
        ("20141017T154858", datetime(2014, 10, 17, 15, 48, 58, tzinfo=UTC)),
        ("20141017T154858.5Z", datetime(2014, 10, 17, 15, 48, 58, 500000, tzinfo=UTC)),
        ("20141017T174858+0200", datetime(2014, 10, 17, 15, 48, 58, tzinfo=UTC)),
        ("town_20141017-154858_pan", datetime(2014, 10, 17, 15, 48, 58, tzinfo=UTC)),
        ("order_12345678-123456", None),
        ("20141017-99999999_20150502161943", datetime(2015, 5, 2, 16, 19, 43, tzinfo=UTC)),
        ("20191015_073816_ssc1d3_0011_basic", datetime(2019, 10, 15, 7, 38, 16, tzinfo=UTC)),
        ("JAX_068_001_RGB", None),
        ("20151399999999", None),
        (None, None),
    ],
)
def test_times(text: Any, time: Any) -> None:
    parsed = parse_time(text)
    assert (parsed and parsed.replace(microsecond=round(parsed.microsecond, -1))) == (
        time and time.replace(microsecond=round(time.microsecond, -1))
    )


@pytest.mark.parametrize(
    ("text", "told"), [("31.02.2014", True), ("20141399999999", True), ("", False), ("N/A", False)]
)
def test_a_time_that_is_none_is_told_and_a_missing_one_is_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str, told: bool
) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"acquisition_date": text, "sun_azimuth": 158.0, "sun_elevation": 33.0}))
    assert read_sidecar(path).time is None
    wanted = [f"{path}: found the time '{text}', expected YYYY-MM-DDThh:mm:ss or YYYYMMDDhhmmss: taken for unknown"]
    assert caplog.messages == (wanted if told else [])


def test_sun_angles_may_be_text_with_a_sign_and_come_in_pairs() -> None:
    assert parse_sun("158.9", "+33.5") == (158.9, 33.5)
    assert parse_sun("-10", 20) == (350.0, 20.0)
    assert parse_sun("158.9", None) is None
    assert parse_sun("-999", "-999") is None
    assert parse_sun("nan", "33") is None


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("02MAY15WV031100015MAY02161943-M1BS-500648061030_01_P001", "WorldView-3"),
        ("PHR1A", "Pleiades-1A"),
        ("SPOT6", "SPOT-6"),
        ("JAX_068_001", None),
    ],
)
def test_platforms(text: Any, name: Any) -> None:
    assert find_platform(text) == name


def test_nitf_tags_give_time_platform_and_bits() -> None:
    tags = {
        "NITF_FTITLE": "02MAY15WV031100015MAY02161943-M1BS-500648061030_01_P001",
        "NITF_IDATIM": "20150502161943",
        "NITF_ABPP": "11",
    }
    found = from_tags(tags, "JAX_068_016_RGB")
    assert (found.time, found.platform, found.bits) == (
        datetime(2015, 5, 2, 16, 19, 43, tzinfo=UTC),
        "WorldView-3",
        11,
    )


def test_other_tags_and_the_name_tell_the_time_where_nothing_better_does() -> None:
    sun = {"NITF_USE00A_SUN_AZ": "131.6", "NITF_USE00A_SUN_EL": "+69.2", "NITF_ABPP": " 8 "}
    found = from_tags({"ACQUISITIONDATETIME": "2015:05:02 2015-05-02 16:19:43"} | sun, "20200101000000_WV02")
    time = datetime(2015, 5, 2, 16, 19, 43, tzinfo=UTC)
    assert found == Metadata(time=time, platform="WorldView-2", bits=8, sun=(131.6, 69.2))
    named = from_tags({"NITF_ABPP": "?"}, "20200101000000_img")
    assert named == Metadata(time=datetime(2020, 1, 1, tzinfo=UTC))


def test_the_date_that_gdal_makes_up_for_nitf_is_not_believed() -> None:
    assert from_tags({"NITF_IDATIM": "20021216151629", "NITF_OSTAID": "GDAL", "NITF_FTITLE": ""}, "wv3_30").time is None


@pytest.mark.parametrize(
    "tags",
    [
        {"NITF_STDIDC_ACQUISITION_DATE": "20150502161943", "NITF_FTITLE": "chip of 20160101000000"},
        {"NITF_STDIDC_ACQUISITION_DATE": "20150502161943", "NITF_OSTAID": "GDAL"},
        {"NITF_STDIDC_ACQUISITION_DATE": " ", "NITF_FTITLE": "02MAY15WV031100015MAY02161943-M1BS-500648061030_01_P001"},
    ],
)
def test_the_acquisition_comes_before_the_date_of_the_file(tags: dict[str, str]) -> None:
    found = from_tags({"NITF_IDATIM": "20231109101112"} | tags, "chip")
    assert found.time == datetime(2015, 5, 2, 16, 19, 43, tzinfo=UTC)


def test_airbus_identifier_in_the_tags_gives_time_and_platform() -> None:
    found = from_tags({"gml": "<gml:name>DS_PHR1A_201304171036448_FR1_PX_E005N43_0707_01658</gml:name>"}, "img_01")
    assert (found.time, found.platform) == (datetime(2013, 4, 17, 10, 36, 44, tzinfo=UTC), "Pleiades-1A")


def test_satnerf_json(tmp_path: Path) -> None:
    document = {
        "height": 5,
        "width": 4,
        "sun_elevation": "+33.5",
        "sun_azimuth": "158.9",
        "acquisition_date": "20141227161109",
    }
    (tmp_path / "a.json").write_text(json.dumps(document))
    found = read_sidecar(tmp_path / "a.json")
    assert (found.sun, found.size, found.rpc) == ((158.9, 33.5), (5, 4), None)
    assert found.time == datetime(2014, 12, 27, 16, 11, 9, tzinfo=UTC)


@pytest.mark.parametrize(
    ("said", "name"),
    [
        ("worldview-3", "WorldView-3"),
        ("WV02", "WorldView-2"),
        ("WorldView03", "WorldView-3"),
        ("pleiades-1a", "Pleiades-1A"),
        ("Pl\u00e9iades Neo 3", "Pleiades-Neo-3"),
        ("landsat-8", "landsat-8"),
        ("WorldView-30", "WorldView-30"),
    ],
)
def test_a_platform_of_a_stac_item_is_known_in_any_spelling(tmp_path: Path, said: str, name: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"type": "Feature", "properties": {"platform": said}}))
    assert read_sidecar(tmp_path / "a.json").platform == name


def test_a_stac_item_gives_time_platform_and_sun(tmp_path: Path) -> None:
    properties = {"datetime": "2020-03-04T05:06:07Z", "platform": "X-1"}
    sun = {"view:sun_azimuth": 140.5, "view:sun_elevation": 41.0}
    (tmp_path / "a.json").write_text(json.dumps({"type": "Feature", "properties": properties | sun}))
    time = datetime(2020, 3, 4, 5, 6, 7, tzinfo=UTC)
    assert read_sidecar(tmp_path / "a.json") == Metadata(time=time, platform="X-1", sun=(140.5, 41.0))
    nothing = {"datetime": None, "platform": ""}
    (tmp_path / "b.json").write_text(json.dumps({"type": "Feature", "properties": nothing}))
    (tmp_path / "c.json").write_text(json.dumps({"type": "FeatureCollection", "properties": None}))
    assert read_sidecar(tmp_path / "b.json") == read_sidecar(tmp_path / "c.json") == Metadata()


@pytest.mark.parametrize(
    ("azimuth", "elevation", "words"),
    [
        (361.0, 30.0, "azimuth of the sun: found 361 degrees, expected -360 to 360"),
        (120.0, 91.5, "elevation of the sun: found 91.5 degrees, expected -90 to 90"),
        ("120", "-95", "elevation of the sun: found -95 degrees, expected -90 to 90"),
    ],
)
def test_angles_that_no_sun_has_are_refused(azimuth: Any, elevation: Any, words: str) -> None:
    with pytest.raises(InputError, match=f"^a.json: {words}$"):
        parse_sun(azimuth, elevation, "a.json")


def test_a_misspelt_member_is_named_with_the_one_that_is_meant(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"sun_elevatoin": 33.5, "sun_azimuth": 158.9}))
    with pytest.raises(InputError, match=r"unknown member 'sun_elevatoin', .* \(did you mean 'sun_elevation'\?\)"):
        read_sidecar(tmp_path / "a.json")
    # what is there under its own name is not meant by another
    (tmp_path / "a.json").write_text(json.dumps({"sun_elevation": 1, "sun_azimuth": 2, "sun_elevations": [1, 2]}))
    assert read_sidecar(tmp_path / "a.json").sun == (2.0, 1.0)


def test_digitalglobe_imd(tmp_path: Path) -> None:
    (tmp_path / "a.IMD").write_text(
        'version = "R";\r\nBEGIN_GROUP = IMAGE_1\r\n\tsatId = "WV03";\r\n\tfirstLineTime = 2015-05-02T16:19:43.5Z;\r\n'
        "\tmeanSunAz = 131.6;\r\n\tmeanSunEl = 69.2;\r\nEND_GROUP = IMAGE_1\r\n"
    )
    found = read_sidecar(tmp_path / "a.IMD")
    assert (found.sun, found.platform, found.time.second) == ((131.6, 69.2), "WorldView-3", 43)


def test_an_imd_of_several_images_gives_the_first_ones_time_and_sun(tmp_path: Path) -> None:
    (tmp_path / "a.IMD").write_text(
        'BEGIN_GROUP = IMAGE_1\n\tsatId = "WV03";\n\tfirstLineTime = 2015-05-02T16:19:43.5Z;\n\tmeanSunAz = 131.6;\n'
        '\tmeanSunEl = 69.2;\nEND_GROUP = IMAGE_1\nBEGIN_GROUP = IMAGE_2\n\tsatId = "WV02";\n'
        "\tfirstLineTime = 2015-11-09T16:10:07.5Z;\n\tmeanSunAz = 165.0;\n\tmeanSunEl = 41.0;\nEND_GROUP = IMAGE_2\n"
    )
    found = read_sidecar(tmp_path / "a.IMD")
    assert (found.sun, found.platform, found.time.month) == ((131.6, 69.2), "WorldView-3", 5)


def test_dimap_takes_the_angles_of_the_centre(tmp_path: Path) -> None:
    def located(kind: Any, azimuth: Any) -> Any:
        return (
            f"<Located_Geometric_Values><LOCATION_TYPE>{kind}</LOCATION_TYPE><Solar_Incidences><SUN_AZIMUTH>{azimuth}"
            "</SUN_AZIMUTH><SUN_ELEVATION>54.0</SUN_ELEVATION></Solar_Incidences></Located_Geometric_Values>"
        )

    (tmp_path / "DIM_a.XML").write_text(
        "<Dimap_Document><Strip_Source><MISSION>PHR</MISSION><MISSION_INDEX>1B</MISSION_INDEX>"
        "<IMAGING_DATE>2013-04-17</IMAGING_DATE><IMAGING_TIME>10:36:44.8Z</IMAGING_TIME></Strip_Source>"
        "<NBITS_VALID>12</NBITS_VALID>" + located("Top Center", 150.0) + located("Center", 151.0) + "</Dimap_Document>"
    )
    found = read_sidecar(tmp_path / "DIM_a.XML")
    assert (found.sun, found.platform, found.bits) == ((151.0, 54.0), "Pleiades-1B", 12)
    assert found.time.replace(microsecond=0) == datetime(2013, 4, 17, 10, 36, 44, tzinfo=UTC)


def test_worldview_xml(data_dir: Any) -> None:
    found = read_sidecar(data_dir / "rpc_formats/rpc_WV2.xml")
    assert (found.sun, found.platform) == ((162.1, 40.3), "WorldView-2")
    assert found.time.isoformat().startswith("2015-09-30T10:56:56.97")
    assert found.rpc is not None


def test_sidecars_are_found_by_name_whatever_the_case(tmp_path: Path) -> None:
    for name in ("IMG_PHR1A_X_R1C1.TIF", "RPC_PHR1A_X.XML", "DIM_PHR1A_X.XML", "OTHER.XML"):
        (tmp_path / name).write_text("x")
    names = [p.name for p in sidecars(tmp_path / "IMG_PHR1A_X_R1C1.TIF", [tmp_path])]
    assert names == ["RPC_PHR1A_X.XML", "DIM_PHR1A_X.XML"]
    (tmp_path / "b_rpc.txt").write_text("x")
    assert [p.name for p in sidecars(Path(tmp_path / "B.tif"), [tmp_path])] == ["b_rpc.txt"]


@pytest.mark.parametrize(
    ("image", "item"),
    [
        ("20191015_073816_ssc1d3_0011_basic_l1a_panchromatic_dn.tif", "20191015_073816_ssc1d3_0011"),
        ("20200401_101530_1_105E_1B_AnalyticMS.TIF", "20200401_101530_1_105e"),
    ],
)
def test_planets_metadata_are_found_by_the_item(tmp_path: Path, image: str, item: str) -> None:
    for name in (f"{item}_metadata.json", "20191015_073816_ssc1d3_0012_metadata.json"):
        (tmp_path / name).write_text("x")
    assert [path.name for path in sidecars(tmp_path / image, [tmp_path])] == [f"{item}_metadata.json"]
    assert sidecars(tmp_path / "20191015_073816_ssc1d3_0011_thumb.tif", [tmp_path]) == []


def test_the_first_source_wins_and_the_next_fills_the_gaps() -> None:
    first, second = Metadata(sun=(1.0, 2.0)), Metadata(sun=(3.0, 4.0), platform="x")
    assert first.filled(second) == Metadata(sun=(1.0, 2.0), platform="x")


def test_an_imd_without_members_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.imd").write_text("nothing\n")
    with pytest.raises(InputError, match="expected DigitalGlobe image metadata"):
        read_sidecar(tmp_path / "a.imd")


def test_of_names_that_differ_in_case_only_an_image_has_those_spelt_as_its_own(tmp_path: Path) -> None:
    """A.tif had the camera of a.tif."""
    for name in ("A_RPC.TXT", "a_rpc.txt", "RPC_A.XML", "RPC_a.XML", "B.JSON"):
        (tmp_path / name).touch()
    if len(list(tmp_path.iterdir())) < 5:
        pytest.skip("a file system that takes them for one")
    found = {
        image: [path.name for path in sidecars(tmp_path / image, [tmp_path])] for image in ("A.tif", "a.tif", "b.tif")
    }
    assert found == {"A.tif": ["A_RPC.TXT", "RPC_A.XML"], "a.tif": ["a_rpc.txt", "RPC_a.XML"], "b.tif": ["B.JSON"]}
    for image in ("IMG_A_R1C1.TIF", "IMG_a_R1C1.TIF"):
        assert [path.name for path in sidecars(tmp_path / image, [tmp_path])] == [f"RPC_{image[4]}.XML"]

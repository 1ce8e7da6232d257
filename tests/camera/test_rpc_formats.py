"""Vendors' RPC files are read with their quirks: origin of pixels, units, byte order marks, line ends, names."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_views import cubic_rpc
from test_rpc import gdal_pixels, scatter

from sattools.camera import RPC
from sattools.errors import InputError

# file, (line offset, sample offset) with (0, 0) = centre of the first pixel
REAL = [
    ("rpc_formats/rpc_IKONOS.txt", (5124.0, 6334.0)),
    ("rpc_formats/rpc_PLANET_L1A.txt", (540.400296515938, 1280.40012503907)),
    ("rpc_formats/rpc_PLANET_L1B.txt", (675.0, 1600.0)),
    ("rpc_formats/20191015_073816_ssc1d3_0011_basic_l1a_panchromatic_dn_RPC.TXT", (539.48675, 1293.51565)),
    ("rpc_formats/rpc_PLEIADES.xml", (18087.5, 19999.5)),  # 18088.5, 20000.5 in the file, which counts from 1
    ("rpc_formats/rpc_SPOT6.xml", (12387.5, 10975.5)),
    ("rpc_formats/rpc_WV2.xml", (10108.0, 14104.0)),
    ("nitf/wv3_30.NTF", (17543.0, 20749.0)),
    ("pleiades/marseille_triplet/img_01.tif", (18339.5, 18656.5)),
    ("dfc2019/Track3-RGB-crops/JAX_068/JAX_068_016_RGB.tif", (16432.3921265118, 7180.11931904364)),
    ("dfc2019/rpc_raw/JAX_068/JAX_068_016_RGB.json", (16432.3921265118, 7180.11931904364)),
]


@pytest.mark.parametrize(("name", "offsets"), REAL)
def test_real_files_project_as_gdal_does_and_localise_back(data_dir: Any, name: Any, offsets: Any) -> None:
    rpc = RPC.from_file(data_dir / name)
    assert (rpc.row_offset, rpc.col_offset) == pytest.approx(offsets, abs=1e-9)
    lon, lat, h = scatter(rpc)
    col, row = rpc.projection(lon, lat, h)
    gdal_col, gdal_row = gdal_pixels(rpc, lon, lat, h)
    assert max(np.abs(col - gdal_col).max(), np.abs(row - gdal_row).max()) <= 1e-6
    back_lon, back_lat = rpc.localization(col, row, h)
    assert max(np.abs(back_lon - lon).max(), np.abs(back_lat - lat).max()) <= 1e-9


def test_the_inverse_model_of_dimap_is_the_one_from_ground_to_image(data_dir: Any) -> None:
    # Its constant differs from the direct model's in the file (0.0023...).
    assert RPC.from_file(data_dir / "rpc_formats/rpc_PLEIADES.xml").col_num[0] == -0.002348990492619796


def test_unsupported_xml_is_refused_in_one_line(data_dir: Any) -> None:
    with pytest.raises(InputError, match=r"rpc_unsupported\.xml: found XML with root <VRTDataset>") as caught:
        RPC.from_file(data_dir / "rpc_formats/rpc_unsupported.xml")
    assert "\n" not in str(caught.value)


def same(a: Any, b: Any) -> Any:
    return a.to_tags() == b.to_tags()


def test_text_with_mark_crlf_units_and_plus_signs(tmp_path: Path) -> None:
    rpc = cubic_rpc()
    path = tmp_path / "a_RPC.TXT"
    text = rpc.to_rpc_txt().replace("LAT_OFF: 46.0 ", "LAT_OFF: +46.000 ").replace("\n", "\r\n")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode() + b"ERR_BIAS: 0003.31 meters\r\n")
    assert same(RPC.from_file(path), rpc)


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_text_of_two_bytes_a_character(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a_RPC.TXT"
    path.write_bytes(("\ufeff" + cubic_rpc().to_rpc_txt()).encode(encoding))
    assert same(RPC.from_file(path), cubic_rpc())


def test_twenty_coefficients_may_stand_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a_RPC.TXT"
    path.write_text("".join(f"{key} = {value} ;\n" for key, value in cubic_rpc().to_tags().items()))
    assert same(RPC.from_file(path), cubic_rpc())


def test_text_in_another_unit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a_RPC.TXT"
    path.write_text(cubic_rpc().to_rpc_txt().replace("meters", "feet"))
    with pytest.raises(InputError, match="HEIGHT_OFF in 'feet'"):
        RPC.from_file(path)


def test_rpb(tmp_path: Path) -> None:
    rpc = cubic_rpc()
    names = {"LINE": "line", "SAMP": "samp", "LAT": "lat", "LONG": "long", "HEIGHT": "height"}
    lines = ['satId = "WV03";', 'bandId = "P";', 'SpecId = "RPC00B";', "BEGIN_GROUP = IMAGE"]
    for key, value in rpc.to_tags().items():
        head, kind = key.split("_", 1)
        if kind in ("OFF", "SCALE"):
            lines.append(f"\t{names[head]}{'Offset' if kind == 'OFF' else 'Scale'} = {value};")
        else:
            numbers = ",\n\t\t\t".join(value.split())
            lines.append(f"\t{names[head]}{'Num' if 'NUM' in kind else 'Den'}Coef = (\n\t\t\t{numbers});")
    path = tmp_path / "a.RPB"
    path.write_text("\n".join([*lines, "END_GROUP = IMAGE", "END;"]))
    assert same(RPC.from_file(path), rpc)


def satnerf(rpc: Any) -> Any:
    fields = ["row_offset", "col_offset", "lat_offset", "lon_offset", "alt_offset"]
    fields += ["row_scale", "col_scale", "lat_scale", "lon_scale", "alt_scale"]
    document = {f: getattr(rpc, f) for f in fields}
    return document | {f: getattr(rpc, f).tolist() for f in ("row_num", "row_den", "col_num", "col_den")}


def test_satnerf_json_bare_or_as_a_member(tmp_path: Path) -> None:
    rpc = cubic_rpc()
    (tmp_path / "bare.json").write_text(json.dumps(satnerf(rpc)))
    (tmp_path / "member.json").write_text(json.dumps({"img": "a.tif", "rpc": satnerf(rpc)}))
    assert same(RPC.from_file(tmp_path / "bare.json"), rpc)
    assert same(RPC.from_file(tmp_path / "member.json"), rpc)


@pytest.mark.parametrize("value", [5, "1 2 3", None])
def test_json_coefficients_that_are_no_list_are_refused(tmp_path: Path, value: Any) -> None:
    (tmp_path / "a.json").write_text(json.dumps(satnerf(cubic_rpc()) | {"col_num": value}))
    with pytest.raises(InputError, match="found col_num that is no list, expected 20 numbers"):
        RPC.from_file(tmp_path / "a.json")


def dimap(rpc: Any, origin: Any, version: Any, model: Any, validity: Any) -> Any:
    scalars = "".join(f"<{k}>{v}</{k}>" for k, v in rpc.to_tags().items() if k.endswith(("_SCALE", "_OFF")))
    for key, value in (("LINE_OFF", rpc.row_offset), ("SAMP_OFF", rpc.col_offset)):
        scalars = scalars.replace(f"<{key}>{value}<", f"<{key}>{value + origin}<")
    numbers = "".join(
        f"<{k}_{i + 1}>{c}</{k}_{i + 1}>"
        for k, v in rpc.to_tags().items()
        if k.endswith("COEFF")
        for i, c in enumerate(v.split())
    )
    return (
        f'<Dimap_Document><METADATA_FORMAT version="{version}">DIMAP</METADATA_FORMAT><Global_RFM>'
        f"<Direct_Model><LINE_NUM_COEFF_1>9</LINE_NUM_COEFF_1></Direct_Model><{model}>{numbers}</{model}>"
        f"<RFM_Validity>{validity}{scalars}</RFM_Validity></Global_RFM></Dimap_Document>"
    )


def test_dimap_2_counts_from_1_and_dimap_3_says_from_where(tmp_path: Path) -> None:
    rpc = cubic_rpc()
    (tmp_path / "v2.xml").write_text(dimap(rpc, 1.0, "2.0", "Inverse_Model", ""))
    name = "ImagetoGround_Validity_Domain"
    first = f"<{name}><FIRST_ROW>0</FIRST_ROW><FIRST_COL>0</FIRST_COL></{name}>"
    (tmp_path / "v3.xml").write_text(dimap(rpc, 0.0, "3.0", "GroundtoImage_Values", first))
    assert same(RPC.from_file(tmp_path / "v2.xml"), rpc)
    assert same(RPC.from_file(tmp_path / "v3.xml"), rpc)
    spoilt = first.replace("<FIRST_COL>0", "<FIRST_COL>one")
    (tmp_path / "v3.xml").write_text(dimap(rpc, 0.0, "3.0", "GroundtoImage_Values", spoilt))
    with pytest.raises(InputError, match=r"v3\.xml: found FIRST_COL = 'one', expected a number$"):
        RPC.from_file(tmp_path / "v3.xml")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.json", b'{"rpc": ', "text that is not JSON"),
        ("a.json", b'{"img": "a.tif"}', "JSON without RPC members"),
        ("a.xml", b"<Dimap_Document><a></Dimap_Document>", "unreadable XML"),
        ("a.xml", b"<Dimap_Document/>", "DIMAP without an RPC"),
        ("a.xml", b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "unreadable XML"),
        ("a.txt", b"hello\n", "text without RPC members"),
        ("a.tif", b"II*\0\0\0\0\0", "no readable image .*expected an image or metadata"),
        ("a.bin", b"", "text without RPC members"),
    ],
)
def test_broken_files_are_refused_in_one_line(tmp_path: Path, name: Any, content: Any, words: Any) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        RPC.from_file(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named() -> None:
    with pytest.raises(InputError, match=r"/nowhere/a\.tif: found No such file"):
        RPC.from_file("/nowhere/a.tif")


def test_an_image_without_rpc_says_so(tmp_path: Path) -> None:
    import rasterio

    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", width=4, height=4, count=1, dtype="uint8") as image:
        image.write(np.ones((1, 4, 4), np.uint8))
    with pytest.raises(InputError, match="image without RPC"):
        RPC.from_file(tmp_path / "a.tif")

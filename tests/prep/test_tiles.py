"""A file of a product in tiles begins where the product's metadata say, not where its whole begins."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_views import cubic_rpc

from sattools.errors import InputError
from sattools.prep.loading import load_source
from sattools.prep.metadata import read_sidecar
from sattools.scene.opening import opened
from sattools.scene.sensor_files import write_sensor_image
from sattools.scene.sidecars import sidecars

WHOLE = cubic_rpc()
DIM = '<Dimap_Document><Regular_Tiling><NTILES_SIZE ncols="300" nrows="200"/></Regular_Tiling></Dimap_Document>'
TIL = """numTiles = 2;
BEGIN_GROUP = TILE_1
\tfilename = "14OCT17-M1BS_R1C1-012_01_P001.TIF";
\tULColOffset = 0;
\tULRowOffset = 0;
END_GROUP = TILE_1
BEGIN_GROUP = TILE_2
\tfilename = "14OCT17-M1BS_R2C1-012_01_P001.TIF";
\tULColOffset = 0;
\tULRowOffset = 512;
END_GROUP = TILE_2
END;
"""
ISD = (
    "<isd><TIL><TILE><FILENAME>14OCT17-M1BS_R2C1-012_01_P001.TIF</FILENAME><ULCOLOFFSET>0</ULCOLOFFSET>"
    "<ULROWOFFSET>512</ULROWOFFSET></TILE></TIL></isd>"
)


def image(folder: Path, name: str, tags: Any = None) -> Path:
    write_sensor_image(folder / name, np.zeros((1, 8, 8), np.uint8), tags)
    return folder / name


def dimap(folder: Path) -> None:
    """RPC_X.XML as Airbus writes it: pixels are counted from 1."""
    tags = WHOLE.to_tags()
    members = "".join(
        f"<{key}_{k}>{value}</{key}_{k}>"
        for key in tags
        if key.endswith("COEFF")
        for k, value in enumerate(tags[key].split(), 1)
    )
    scalars = {k: float(v) for k, v in tags.items() if k.endswith(("_OFF", "_SCALE"))}
    scalars["LINE_OFF"] += 1.0
    scalars["SAMP_OFF"] += 1.0
    validity = "".join(f"<{k}>{v!r}</{k}>" for k, v in scalars.items())
    (folder / "RPC_X.XML").write_text(
        f"<Dimap_Document><Inverse_Model>{members}</Inverse_Model><RFM_Validity>{validity}</RFM_Validity>"
        "</Dimap_Document>"
    )


def rpb(folder: Path) -> None:
    tags = WHOLE.to_tags()
    names = {"LINE_OFF": "lineOffset", "SAMP_OFF": "sampOffset", "LAT_OFF": "latOffset", "LONG_OFF": "longOffset"}
    names |= {"HEIGHT_OFF": "heightOffset", "LINE_SCALE": "lineScale", "SAMP_SCALE": "sampScale"}
    names |= {"LAT_SCALE": "latScale", "LONG_SCALE": "longScale", "HEIGHT_SCALE": "heightScale"}
    text = "".join(f"{name} = {tags[key]};\n" for key, name in names.items())
    for key in ("LINE_NUM", "LINE_DEN", "SAMP_NUM", "SAMP_DEN"):
        side, part = key.split("_")
        terms = ", ".join(tags[f"{key}_COEFF"].split())
        text += f"{side.lower()}{part.capitalize()}Coef = ({terms});\n"
    (folder / "14OCT17-M1BS-012_01_P001.RPB").write_text(text)


def offsets(path: Path) -> Any:
    rpc = load_source(path, "a", None).rpc
    return pytest.approx((rpc.col_offset - WHOLE.col_offset, rpc.row_offset - WHOLE.row_offset), abs=1e-6)


def test_a_tile_of_airbus_begins_after_those_before_it(tmp_path: Path) -> None:
    dimap(tmp_path)
    (tmp_path / "DIM_X.XML").write_text(DIM)
    assert offsets(image(tmp_path, "IMG_X_R1C1.TIF")) == (0.0, 0.0)
    assert offsets(image(tmp_path, "IMG_X_R1C2.TIF")) == (-300.0, 0.0)
    assert offsets(image(tmp_path, "IMG_X_R3C2.TIF")) == (-300.0, -400.0)


def test_a_tile_of_airbus_without_the_size_of_tiles_is_refused(tmp_path: Path) -> None:
    dimap(tmp_path)
    assert offsets(image(tmp_path, "IMG_X_R1C1.TIF")) == (0.0, 0.0)
    tile = image(tmp_path, "IMG_X_R1C2.TIF")
    with pytest.raises(InputError, match=r"IMG_X_R1C2\.TIF: found row 1, column 2 of a product in tiles .* DIM_"):
        load_source(tile, "a", None)


def test_tiles_of_airbus_that_overlap_are_refused(tmp_path: Path) -> None:
    dimap(tmp_path)
    overlap = "<OVERLAP_ROW>0</OVERLAP_ROW><OVERLAP_COL>16</OVERLAP_COL>"
    text = DIM.replace("<Regular_Tiling>", f"<Regular_Tiling>{overlap}")
    (tmp_path / "DIM_X.XML").write_text(text)
    with pytest.raises(InputError, match=r"IMG_X_R1C2\.TIF: found row 1, column 2 of a product in tiles"):
        load_source(image(tmp_path, "IMG_X_R1C2.TIF"), "a", None)
    (tmp_path / "DIM_X.XML").write_text(text.replace("16", "0"))
    assert offsets(image(tmp_path, "IMG_X_R1C2.TIF")) == (-300.0, 0.0)


@pytest.mark.parametrize("bands", ["P", "RGB", "NED"])
def test_images_of_pleiades_neo_have_the_metadata_of_all_their_bands(tmp_path: Path, bands: str) -> None:
    dimap(tmp_path)
    product = "PNEO3_202109291034012_SEN_PWOI_000011543_1_2_F_1"
    (tmp_path / "RPC_X.XML").rename(tmp_path / f"RPC_{product}.XML")
    (tmp_path / f"DIM_{product}.XML").write_text(DIM)
    assert offsets(image(tmp_path, f"IMG_{product}_{bands}_R2C1.TIF")) == (0.0, -200.0)


def test_a_tile_with_tags_of_its_own_needs_no_size_of_tiles(tmp_path: Path) -> None:
    dimap(tmp_path)
    assert offsets(image(tmp_path, "IMG_X_R1C2.TIF", WHOLE.cropped(300, 0).to_tags())) == (-300.0, 0.0)


def test_metadata_of_the_tile_itself_are_taken_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "town_R1C2_RPC.TXT").write_text(WHOLE.to_rpc_txt())
    assert offsets(image(tmp_path, "town_R1C2.tif")) == (0.0, 0.0)


@pytest.mark.parametrize(("ending", "text"), [("TIL", TIL), ("XML", ISD)])
def test_a_tile_of_digitalglobe_has_the_products_metadata_and_its_own_corner(
    tmp_path: Path, ending: str, text: str
) -> None:
    rpb(tmp_path)
    (tmp_path / "14OCT17-M1BS-012_01_P001.IMD").write_text('satId = "WV02";\nmeanSunAz = 1;\nmeanSunEl = 2;\n')
    (tmp_path / f"14OCT17-M1BS-012_01_P001.{ending}").write_text(text)
    first = image(tmp_path, "14OCT17-M1BS_R1C1-012_01_P001.TIF")
    assert offsets(first) == (0.0, 0.0)
    assert load_source(first, "a", None).metadata.sun == (1.0, 2.0)
    assert offsets(image(tmp_path, "14OCT17-M1BS_R2C1-012_01_P001.TIF")) == (0.0, -512.0)
    names = {path.suffix for path in sidecars(first, [tmp_path])}
    assert names == {".RPB", ".IMD", f".{ending}"}


def test_a_tile_of_digitalglobe_without_a_til_file_is_refused(tmp_path: Path) -> None:
    rpb(tmp_path)
    tile = image(tmp_path, "14OCT17-M1BS_R2C1-012_01_P001.TIF")
    with pytest.raises(InputError, match=r"P001\.TIF: found row 2, column 1 of a product in tiles .* a \.TIL file"):
        load_source(tile, "a", None)
    # another part of the same order has files of its own
    assert sidecars(image(tmp_path, "14OCT17-M1BS_R1C1-012_01_P002.TIF"), [tmp_path]) == []


def test_a_til_file_without_corners_tells_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.til").write_text("BEGIN_GROUP = TILE_1\nfilename = x.tif;\nULColOffset = ?;\nEND_GROUP\n")
    assert read_sidecar(tmp_path / "a.til").tiles is None
    (tmp_path / "a.xml").write_text('<Dimap_Document><NTILES_SIZE ncols="?" nrows="1"/></Dimap_Document>')
    assert read_sidecar(tmp_path / "a.xml").tiles is None


def test_a_til_file_is_no_image_and_its_tiles_are_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "14OCT17-M1BS-012_01_P001.TIL"
    path.write_text(TIL)
    wanted = r"P001\.TIL: found no readable image \(a list of the tiles .*: give the \.TIF files that it names\)"
    with pytest.raises(InputError, match=wanted), opened(path):
        pass

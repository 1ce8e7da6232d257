"""Of an image's own RPC tags and a file beside it, the camera of the window that the image holds is taken."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from synthetic_views import LAT0, LON0, parallel_rpc

from sattools.camera import RPC
from sattools.camera.ground import from_geographic
from sattools.prep.cameras import of_another_window, of_other_pixels, own_camera
from sattools.prep.gate import check_sources
from sattools.prep.loading import load_source
from sattools.scene.sensor_files import write_sensor_image

SIZE = (150, 160)
OWN = parallel_rpc((0.3, 0.1), size=SIZE)
OTHER = "has the camera of another window of the image"


def image(folder: Path, rpc: Any = OWN) -> Path:
    write_sensor_image(folder / "a.tif", np.ones((1, *SIZE), np.uint8), None if rpc is None else rpc.to_tags())
    return folder / "a.tif"


def aux(folder: Path, rpc: RPC) -> None:
    members = "".join(f'<MDI key="{key}">{text}</MDI>' for key, text in rpc.to_tags().items())
    text = f'<PAMDataset><Metadata domain="RPC">{members}</Metadata></PAMDataset>'
    (folder / "a.tif.aux.xml").write_text(text)


def corner(rpc: RPC) -> Any:
    return pytest.approx((rpc.col_offset - OWN.col_offset, rpc.row_offset - OWN.row_offset), abs=1e-6)


def loaded(path: Path, metadata: Any = None) -> Any:
    source = load_source(path, "a", metadata)
    check_sources([source])
    return source


def test_a_file_left_beside_an_image_that_was_cut_is_told_and_not_taken(tmp_path: Path) -> None:
    path = image(tmp_path)
    OWN.shifted(30, 25).write(tmp_path / "a_RPC.TXT")
    source = loaded(path)
    assert corner(source.rpc) == (0.0, 0.0)
    assert source.metadata.rpc_source == str(path)
    assert f"a_RPC.TXT {OTHER} (+30 columns, +25 rows): its own RPC tags are taken" in source.notes


def test_a_file_left_beside_an_image_that_was_reduced_is_told_and_not_taken(tmp_path: Path) -> None:
    whole = replace(OWN, col_offset=159.5, row_offset=149.5, col_scale=160.0, row_scale=150.0)
    reduced = whole.reduced(2)
    path = image(tmp_path, reduced)
    whole.write(tmp_path / "a_RPC.TXT")
    source = loaded(path)
    assert (source.rpc.col_offset, source.rpc.col_scale) == (79.5, 80.0)
    assert source.metadata.rpc_source == str(path)
    words = "a_RPC.TXT has the camera of the image in other pixels (2 along one of its own): its own RPC tags are taken"
    assert source.notes == [words]


def test_tags_of_other_pixels_than_the_image_has_do_not_count() -> None:
    """As of a multispectral image that was sharpened to panchromatic pixels and kept its tags."""
    fine = replace(OWN, col_offset=79.5, row_offset=74.5, col_scale=80.0, row_scale=75.0)
    assert of_other_pixels(fine, fine.reduced(4), SIZE) is None
    assert of_other_pixels(fine, fine.reduced(4), (37, 40)) == pytest.approx(4.0)
    assert of_other_pixels(fine.shifted(9, 0), fine.reduced(4), (37, 40)) == pytest.approx(4.0)
    assert of_other_pixels(replace(fine, lat_offset=LAT0 + 1e-4), fine.reduced(4), (37, 40)) is None
    assert of_other_pixels(fine, fine, SIZE) is None


@pytest.mark.parametrize(
    ("name", "half", "words"),
    [
        (
            "a",
            (160.0, 150.0),
            "is made for 2 times as many pixels along both sides as the image has: was it reduced with",
        ),
        (
            "a",
            (40.0, 37.5),
            "is made for 0.5 times as many pixels along both sides as the image has: was it enlarged wi",
        ),
        ("a", (161.8, 161.8), "is made for 2.09 times as many pixels along both sides as the image has: was it re"),
        ("a", (80.9, 80.9), ""),  # as of a WorldView-2 whose rows have a margin of 8 %
        ("a", (160.0, 75.0), ""),  # a strip of its left half
        ("a_R1C1", (160.0, 150.0), ""),
    ],
)
def test_an_image_that_was_reduced_without_its_camera_is_told(
    tmp_path: Path, name: str, half: tuple[float, float], words: str
) -> None:
    path = image(tmp_path, None).rename(tmp_path / f"{name}.tif")
    rpc = OWN.shifted(half[0] - 0.5 - OWN.col_offset, half[1] - 0.5 - OWN.row_offset)
    replace(rpc, col_scale=half[0], row_scale=half[1]).write(tmp_path / f"{name}_RPC.TXT")
    notes = loaded(path).notes
    assert [f"its camera, of {tmp_path}/{name}_RPC.TXT, {words}" in note for note in notes] == [True] * bool(words)


IMD = ("a.IMD", "numRows = {};\nnumColumns = {};\n")
ISD = ("a.XML", "<isd><IMD><NUMROWS>{}</NUMROWS><NUMCOLUMNS>{}</NUMCOLUMNS></IMD></isd>")
DIM = (
    "DIM_a.XML",
    "<Dimap_Document><Raster_Dimensions><NROWS>{}</NROWS><NCOLS>{}</NCOLS></Raster_Dimensions></Dimap_Document>",
)


@pytest.mark.parametrize(("name", "text"), [IMD, ISD, DIM])
def test_an_image_that_was_cut_without_its_camera_is_told(tmp_path: Path, name: str, text: str) -> None:
    path = image(tmp_path, None)
    OWN.write(tmp_path / "a_RPC.TXT")
    (tmp_path / name).write_text(text.format(900, 800))
    words = "is of an image of 800 x 900 pixels by the vendor's metadata, this one has 160 x 150: was it cut or reduced"
    (note,) = loaded(path).notes
    assert note.startswith(f"its camera, of {tmp_path}/a_RPC.TXT, {words}")
    assert loaded(image(tmp_path)).notes == []  # its own tags agree
    (tmp_path / name).write_text(text.format(150, 160))
    assert loaded(image(tmp_path, None)).notes == []


def test_what_gdal_alone_reads_beside_an_image_is_no_camera_of_its_own(tmp_path: Path) -> None:
    aux(tmp_path, OWN.shifted(30, 25))
    assert corner(loaded(image(tmp_path)).rpc) == (0.0, 0.0)
    path = image(tmp_path, None)
    aux(tmp_path, OWN.shifted(30, 25))
    assert own_camera(path) is None
    assert corner(loaded(path).rpc) == (30.0, 25.0)


def test_a_corrected_camera_beside_an_image_is_taken_and_told(tmp_path: Path) -> None:
    OWN.shifted(2.25, -3.5).write(tmp_path / "a_RPC.TXT")
    source = loaded(image(tmp_path))
    assert corner(source.rpc) == (2.25, -3.5)
    beside = tmp_path / "a_RPC.TXT"
    assert f"its own RPC tags differ by 4.2 px from the camera of {beside}, which is taken" in source.notes


def test_a_camera_beside_an_image_without_tags_or_with_the_same_is_taken_silently(tmp_path: Path) -> None:
    OWN.shifted(0.5, 0.25).write(tmp_path / "a_RPC.TXT")
    for path in (image(tmp_path), image(tmp_path, None)):
        source = loaded(path)
        assert corner(source.rpc) == (0.5, 0.25)
        assert source.notes == []
    assert own_camera(path) is None


def test_a_folder_that_the_user_pointed_to_is_believed(tmp_path: Path) -> None:
    path = image(tmp_path)
    folder = tmp_path / "cameras"
    folder.mkdir()
    OWN.shifted(30, 25).write(folder / "a_RPC.TXT")
    source = loaded(path, folder)
    assert corner(source.rpc) == (30.0, 25.0)
    assert any("its own RPC tags differ" in note for note in source.notes)


@pytest.mark.parametrize(
    ("pixel", "east", "told"),
    [
        (0.5, 0.0, False),
        (0.5, 20.0, False),  # map projected onto another height
        (0.75, 0.0, True),  # an orthophoto: of 150 x 160 pixels, half of the diagonal lies 55 off
        (0.75, 900.0, False),  # a georeference that means nothing
    ],
)
def test_an_orthophoto_with_the_camera_of_the_raw_image_is_told(
    tmp_path: Path, pixel: float, east: float, told: bool
) -> None:
    x, y = from_geographic("EPSG:32633", LON0, LAT0)
    place = Affine(pixel, 0, x + east - 80 * pixel, 0, -pixel, y + 75 * pixel)
    profile = {"width": 160, "height": 150, "count": 1, "dtype": "uint8", "crs": "EPSG:32633", "transform": place}
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", **profile) as data:
        data.write(np.ones((1, *SIZE), np.uint8))
        data.update_tags(ns="RPC", **OWN.to_tags())
    message = f"its georeference and its RPC ({tmp_path}/a.tif) are 55 px apart across it: an orthophoto "
    assert any(note.startswith(message) for note in loaded(tmp_path / "a.tif").notes) == told


def test_tags_that_were_not_moved_when_the_image_was_cut_do_not_count() -> None:
    whole = replace(OWN, col_offset=5000.0, col_scale=5001.0, row_offset=4000.0, row_scale=4001.0)
    assert of_another_window(whole.cropped(700, 900), whole, SIZE) is None
    assert of_another_window(whole, whole.cropped(700, 900), SIZE) == (700.0, 900.0)
    assert of_another_window(replace(OWN.shifted(30, 25), lat_offset=LAT0 + 1e-4), OWN, SIZE) is None

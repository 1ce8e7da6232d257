"""A folder given in place of images: a map or quick look in it is left out, and what should be an image is not."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from synthetic_views import parallel_rpc

from sattools.cli import main
from sattools.errors import InputError
from sattools.prep.folders import images_with_cameras
from sattools.scene.location import IMAGE_SUFFIXES
from sattools.scene.sensor_files import write_sensor_image

TAGS = parallel_rpc().to_tags()


def image(folder: Path, name: str, tags: Any = None) -> Path:
    write_sensor_image(folder / name, np.ones((1, 8, 8), np.uint8), tags)
    return folder / name


def test_files_without_camera_are_left_out_and_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    images = [image(tmp_path, f"{name}.tif", TAGS) for name in "ab"]
    maps = [image(tmp_path, f"{name}.tif") for name in ("dem", "x-BROWSE")]
    with caplog.at_level(logging.WARNING):
        assert images_with_cameras([str(tmp_path)], None) == images
    assert caplog.messages == [f"{tmp_path}: left out dem.tif, x-BROWSE.tif, without RPC tags and metadata files"]
    assert images_with_cameras([str(images[0]), str(maps[0])], None) == [images[0], maps[0]]  # as the user named them


def test_what_has_a_metadata_file_or_cannot_be_opened_stays(tmp_path: Path) -> None:
    images = [image(tmp_path, "a.tif", TAGS), image(tmp_path, "b.tif"), image(tmp_path, "c.tif"), tmp_path / "d.tif"]
    images[3].write_bytes(b"no image")
    (tmp_path / "b_RPC.TXT").write_text("damaged")
    folder = tmp_path / "metadata"
    folder.mkdir()
    (folder / "c.json").write_text("{}")
    assert images_with_cameras([str(tmp_path)], str(folder)) == images
    assert images_with_cameras([str(tmp_path)], None) == [images[0], images[1], images[3]]


def test_a_folder_without_any_camera_is_not_empty(tmp_path: Path) -> None:
    images = [image(tmp_path, f"{name}.tif") for name in "ab"]
    assert images_with_cameras([str(tmp_path)], None) == images
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="found a folder without images"):
        images_with_cameras([str(tmp_path / "none")], None)


def test_a_delivery_whose_images_lie_deeper_is_told_where(tmp_path: Path) -> None:
    """Vendors put every product, panchromatic and multispectral, into a folder of its own."""
    for k in range(4):
        for kind in ("PAN", "MUL"):
            (tmp_path / f"01_P00{k}_{kind}").mkdir()
            image(tmp_path / f"01_P00{k}_{kind}", "a.TIF", TAGS)
    deeper = tmp_path / "order" / "product" / "IMG_1"
    deeper.mkdir(parents=True)
    image(deeper, "a.TIF", TAGS)
    folders = "01_P000_MUL, 01_P000_PAN, 01_P001_MUL, 01_P001_PAN, 01_P002_MUL, ..."
    with pytest.raises(InputError, match=f"; there are some in its folders {folders}: give those that are meant$"):
        images_with_cameras([str(tmp_path)], None)
    with pytest.raises(InputError, match=r"; there are some in its folders product/IMG_1: give those"):
        images_with_cameras([str(tmp_path / "order")], None)


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("order.ZIP", r"an archive, expected the images in it \(unpacked, with their metadata\)"),
        ("order.tar.gz", "an archive, expected"),
        ("DIM_PHR1A_P.XML", "a metadata file, expected the image that it is about"),
        ("14OCT17-P1BS.IMD", "a metadata file, expected"),
    ],
)
def test_what_comes_with_images_is_told_by_what_it_is(tmp_path: Path, name: str, what: str) -> None:
    """An archive was taken for the only image."""
    with pytest.raises(InputError, match=f"^{tmp_path / name}: found {what}"):
        (tmp_path / name).write_bytes(b"PK") and images_with_cameras([str(tmp_path / name)], None)


def test_jpeg_and_png_in_a_folder_are_quick_looks_and_images_where_they_are_named(tmp_path: Path) -> None:
    taken = image(tmp_path, "a.tif", TAGS)
    named = [tmp_path / "a.jpg", tmp_path / "b.png"]
    for path in named:
        path.with_name(f"{path.stem}_RPC.TXT").write_text("")
        path.write_bytes(b"picture")
    assert images_with_cameras([str(tmp_path)], None) == [taken]
    assert images_with_cameras(list(map(str, named)), None) == named
    said = " ".join(CliRunner().invoke(main, ["prep", "--help"]).output.split())
    assert f"a folder stands for the images in it ({', '.join(IMAGE_SUFFIXES)}; JPEG and PNG are quick looks" in said

"""Every image gets an id of plain letters, whatever script its name is in, and different ones where names differ."""

from pathlib import Path

import pytest

from sattools.errors import InputError
from sattools.prep.dfc2019 import find_images
from sattools.prep.names import check_ids, common_name, image_id


def test_letters_of_other_scripts_are_their_numbers() -> None:
    assert image_id(Path("影像一.tif")) == "u5f71u50cfu4e00"
    assert image_id(Path("影像三.01.tif")) == "u5f71u50cfu4e09.01"
    assert image_id(Path("Город 1.tif")) == "u0413u043eu0440u043eu0434_1"
    assert image_id(Path("Zürich (2).tif")) == "Z_rich_2_"


def test_names_that_differ_in_them_are_told_apart(tmp_path: Path) -> None:
    images = [
        tmp_path / name for name in ("影像一.01.tif", "影像三.01.tif", "影" * 60 + "一.tif", "影" * 60 + "三.tif")
    ]
    for image in images:
        image.touch()
    ids = check_ids(images)
    assert len(set(ids)) == len(images)
    assert all(name.isascii() and len(name) <= 128 for name in ids)


def test_a_name_without_letters_or_digits_is_refused() -> None:
    with pytest.raises(InputError, match="found a name without letters or digits"):
        image_id(Path("---.tif"))


@pytest.mark.parametrize("names", [("Aä", "Aö"), ("x" * 130 + "1", "x" * 130 + "2")])
def test_names_that_differ_only_in_what_an_id_leaves_out_are_told_so(tmp_path: Path, names: tuple[str, str]) -> None:
    images = [tmp_path / f"{name}.tif" for name in names]
    for image in images:
        image.touch()
    with pytest.raises(InputError, match="expected names that differ in their first 128 letters a to z, digits"):
        check_ids(images)


def test_an_image_that_is_given_twice_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As by a folder and a file in it; it was said to have the id of itself, and to need another name."""
    (tmp_path / "a.tif").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"a\.tif: found this image twice, expected every image once$"):
        check_ids([tmp_path / "a.tif", Path("a.tif")])


def test_ids_that_differ_by_case_only_are_refused(tmp_path: Path) -> None:
    """On disks without case they would be one file."""
    images = [tmp_path / "one/Harbour_1.tif", tmp_path / "two/harbour_1.TIF", tmp_path / "two/harbour_2.tif"]
    for image in images:
        image.parent.mkdir(exist_ok=True)
        image.touch()
    words = (
        r"two/harbour_1\.TIF: found id 'harbour_1', which differs from 'Harbour_1' of .*one/Harbour_1\.tif by its case"
    )
    with pytest.raises(InputError, match=words):
        check_ids(images)
    assert check_ids(images[1:]) == ["harbour_1", "harbour_2"]


def test_names_of_scenes() -> None:
    assert common_name(["JAX_068_001_RGB", "JAX_068_016_RGB"]) == "JAX_068"
    assert common_name(["a", "b"]) == "scene"


def test_contest_images_are_found_by_area(tmp_path: Path) -> None:
    for name in ("Track3-RGB-1/JAX_068_002_RGB.tif", "Track3-RGB-1/JAX_004_001_RGB.tif", "rpc_raw/JAX_068/x.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    images, folder = find_images(tmp_path, "JAX_068")
    assert [p.name for p in images] == ["JAX_068_002_RGB.tif"]
    assert folder == tmp_path / "rpc_raw/JAX_068"
    with pytest.raises(InputError, match="found no Track3-RGB"):
        find_images(tmp_path, "OMA_001")
    with pytest.raises(InputError, match="expected an area of the contest"):
        find_images(tmp_path, "../../etc")

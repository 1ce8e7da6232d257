"""A file of several images says which of them is taken."""

from pathlib import Path
from typing import Any

import pytest
from rasterio.shutil import copy

from sattools.prep.loading import load_source
from sattools.scene import Scene


@pytest.fixture
def several(town_source: Scene, tmp_path: Path) -> Path:
    """A TIFF whose second page is another view."""
    path = tmp_path / "several.tif"
    first, second = (town_source.path(item.assets["image"].href) for item in town_source.items[:2])
    copy(first, path, driver="GTiff")
    copy(second, path, driver="GTiff", APPEND_SUBDATASET="YES")
    return path


def test_images_beyond_the_first_of_a_file_are_told(several: Path, town_source: Scene, caplog: Any) -> None:
    source = load_source(several, "A", None)
    assert source.size == load_source(town_source.path(town_source.items[0].assets["image"].href), "B", None).size
    assert source.notes == [
        f"holds 2 images, of which the first is taken (gdal_translate GTIFF_DIR:2:{several} takes another)"
    ]
    assert "A: holds 2 images" in caplog.text
    assert "B: holds" not in caplog.text

"""Names that files give their bands: kept, and of one order."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rasterio
from spoilt import Town, prep, refused
from synthetic_views import parallel_rpc

from sattools.export.products.ortho import _colour_names
from sattools.prep.gate import check_sources
from sattools.prep.images import SourceImage
from sattools.prep.metadata import Metadata
from sattools.radiometry.bands import named_bands, red_green_blue
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import Scene


@pytest.fixture
def town(town_source: Any, tmp_path: Path) -> Any:
    return Town(tmp_path, town_source, 3)


def describe(path: Path, *names: str) -> None:
    with rasterio.open(path, "r+") as data:
        data.descriptions = names


def test_names_are_common_ones_or_the_vendors_all_of_them_and_once() -> None:
    assert named_bands(None, ["Blue", "green", "NIR"])["eo:bands"] == [
        {"name": "Blue", "common_name": "blue"},
        {"name": "green", "common_name": "green"},
        {"name": "NIR", "common_name": "nir"},
    ]
    assert named_bands("Pleiades-1A", ["B2", "blue"])["eo:bands"][1]["center_wavelength"] == 0.49
    for nothing in ([], [None, None], ["Band 1", "Band 2"], ["red", "red"], ["red", None]):
        assert named_bands(None, nothing) == {}


def test_bands_that_files_name_keep_their_names_and_are_shown_as_such(town: Any) -> None:
    for path in town.images():
        describe(path, "blue", "green", "red")
    done = prep(town)
    assert done.exit_code == 0
    scene = Scene.from_json(done.stdout)
    bands = scene.items[0].assets["image"].extra["eo:bands"]
    assert [band["common_name"] for band in bands] == ["blue", "green", "red"]
    assert red_green_blue(bands) == [3, 2, 1]
    normalise(scene, NormaliseOptions())
    assert [b["name"] for b in scene.items[0].assets["radiance"].extra["eo:bands"]] == ["blue", "green", "red"]


def test_images_whose_bands_have_different_orders_are_refused(town: Any) -> None:
    for path in town.images()[:2]:
        describe(path, "red", "green", "blue")
    describe(town.images()[2], "blue", "green", "red")
    refused(town, "TOWN_003.tif: found the bands blue, green, red", "expected red, green, blue as ")


def test_sensors_whose_infrared_has_another_name_may_be_mixed() -> None:
    def image(platform: str) -> Any:
        names = ("blue", "green", "red", "nir" if platform == "Pleiades-1A" else "N")
        source = SourceImage(platform, Path(f"{platform}.tif"), (9, 9), 4, "uint16", parallel_rpc(), Metadata())
        source.descriptions, source.metadata.platform = names, platform
        return source

    check_sources([image("Pleiades-1A"), image("WorldView-3")])


def test_an_orthophoto_has_the_names_of_the_multispectral_bands() -> None:
    def job(count: int, *names: str) -> Any:
        asset = SimpleNamespace(extra=named_bands(None, names))
        return SimpleNamespace(
            cameras=[SimpleNamespace(item=SimpleNamespace(assets={"colours": asset}))], colours=count
        )

    assert _colour_names(job(3, "blue", "green", "red")) == ["blue", "green", "red"]
    assert _colour_names(job(4, "blue", "green", "red", "nir")) == ["blue", "green", "red", "nir"]
    assert _colour_names(job(3)) == ["red", "green", "blue"]
    assert _colour_names(job(4)) == ["1", "2", "3", "4"]

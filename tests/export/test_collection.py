"""The products as a STAC collection: valid, with what is true of every file, and movable."""

import json
import shutil
from pathlib import Path
from typing import Any

import pystac
import pytest
import rasterio
import torch
from pystac.validation import RegisteredValidator, set_validator
from pystac.validation.stac_validator import JsonSchemaSTACValidator
from stac_schemas import SCHEMAS

from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.checkpoint import save
from sattools.scene import Asset, Grid, Item, Scene

GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 0.5, 60, 40)


@pytest.fixture(autouse=True)
def offline() -> Any:
    """Only schemas that are in pystac or here."""
    before = RegisteredValidator.get_validator()
    validator = JsonSchemaSTACValidator()
    validator.schema_cache.update(SCHEMAS)
    set_validator(validator)
    yield
    set_validator(before)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    bands = [{"name": name, "common_name": name, "center_wavelength": w} for name, w in (("red", 0.66), ("nir", 0.83))]
    times = ("2015-03-01T16:00:00Z", "2014-10-05T16:00:00Z")
    radiance = Asset("radiance.tif", extra={"eo:bands": bands})
    items = [Item(name, None, None, {"datetime": time}, {"radiance": radiance}) for name, time in zip("ab", times)]
    scene = Scene("BLOCK", tmp_path / "BLOCK", items, GRID)
    tensors = {
        "height": torch.zeros(GRID.shape),
        "height_std": torch.full(GRID.shape, 0.3),
        "albedo": torch.full((*GRID.shape, 2), 0.25),
    }
    meta = {"grid": GRID.to_dict(), "items": ["a", "b"], "suns": [None, None], "shadow": "none"}
    save(scene.output("model"), tensors, meta)
    scene.products["model"] = "model"
    return scene


def read(scene: Scene, name: str) -> Any:
    return json.loads(scene.path(scene.products[name]).read_text())


def test_collection_and_item_are_valid_stac(scene: Any) -> None:
    export(scene, ExportOptions(products=["laz", "contours"]))
    collection = pystac.Collection.from_file(str(scene.path("export/collection.json")))
    assert len(collection.validate()) == 4  # the core and three extensions
    (item,) = collection.get_items()
    assert len(item.validate()) == 4
    assert item.get_collection() is collection
    assert set(collection.assets) == {"dsm", "dsm_std", "albedo", "dsm_picture", "points", "contours"}
    assert collection.assets["points"].media_type == "application/vnd.laszip"


def test_a_wrong_field_would_be_noticed(scene: Any) -> None:
    export(scene, ExportOptions())
    collection = pystac.Collection.from_file(str(scene.path("export/collection.json")))
    collection.assets["dsm"].extra_fields["proj:code"] = 32617
    with pytest.raises(pystac.STACValidationError, match="proj:code"):
        collection.validate()


def test_assets_say_what_is_true_of_their_files(scene: Any) -> None:
    export(scene, ExportOptions())
    assets = read(scene, "collection")["assets"]
    with rasterio.open(scene.path("export/dsm.tif")) as data:
        assert assets["dsm"]["proj:shape"] == [data.height, data.width] == [40, 60]
        assert assets["dsm"]["proj:transform"] == list(data.transform)[:6]
        assert assets["dsm"]["proj:bbox"] == list(data.bounds)
    dsm = assets["dsm"]
    assert (dsm["proj:code"], dsm["raster:spatial_resolution"], dsm["unit"]) == ("EPSG:32617", 0.5, "m")
    assert (dsm["data_type"], dsm["nodata"]) == ("float32", "nan")
    assert assets["albedo"]["bands"] == [
        {"name": "albedo red", "eo:common_name": "red", "eo:center_wavelength": 0.66},
        {"name": "albedo nir", "eo:common_name": "nir", "eo:center_wavelength": 0.83},
    ]
    assert not any(name.startswith("proj:") for name in assets["dsm_picture"])


def test_place_and_time_are_those_of_the_scene(scene: Any) -> None:
    export(scene, ExportOptions())
    extent = read(scene, "collection")["extent"]
    assert extent["temporal"]["interval"] == [["2014-10-05T16:00:00Z", "2015-03-01T16:00:00Z"]]
    west, south, east, north = extent["spatial"]["bbox"][0]
    # 30 x 20 m at 30 degrees north: a degree of longitude has 96 km, one of latitude 111 km
    assert (east - west) * 96_000 == pytest.approx(30, rel=0.02)
    assert (north - south) * 111_000 == pytest.approx(20, rel=0.02)
    properties = read(scene, "collection_item")["properties"]
    assert properties["datetime"] is None
    assert properties["start_datetime"] == "2014-10-05T16:00:00Z"


@pytest.mark.parametrize(
    ("first", "last"),
    [("2015-03-01T16:00:22Z", "2015-03-01T16:00:22.5Z"), ("2015-03-01T18:00:00+02:00", "2015-03-01T16:00:01Z")],
)
def test_the_first_and_last_time_are_those_on_the_clock_not_in_the_alphabet(scene: Any, first: str, last: str) -> None:
    for item, time in zip(scene.items, (last, first), strict=True):
        item.properties["datetime"] = time
    export(scene, ExportOptions())
    properties = read(scene, "collection_item")["properties"]
    assert (properties["start_datetime"], properties["end_datetime"]) == (first, last)


def test_the_folder_can_be_moved(scene: Any, tmp_path: Path) -> None:
    export(scene, ExportOptions())
    shutil.move(scene.root, tmp_path / "elsewhere")
    collection = pystac.Collection.from_file(str(tmp_path / "elsewhere/export/collection.json"))
    (item,) = collection.get_items()
    for asset in item.assets.values():
        assert Path(asset.get_absolute_href()).is_file()
    links = json.loads((tmp_path / "elsewhere/export/collection.json").read_text())["links"]
    assert {(link["rel"], link["href"]) for link in links} == {
        ("self", "./collection.json"), ("root", "./collection.json"), ("item", "./item.json"),
    }  # fmt: skip


def test_without_dates_there_is_a_collection_and_no_item(scene: Any) -> None:
    for item in scene.items:
        item.properties["datetime"] = None
    export(scene, ExportOptions())
    assert "collection_item" not in scene.products
    assert not scene.path("export/item.json").exists()
    pystac.Collection.from_file(str(scene.path("export/collection.json"))).validate()


def test_a_compound_crs_is_given_as_text(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sattools.export.surface_files.to_datum", lambda height, *_: (height, "EGM96 geoid"))
    monkeypatch.setattr("sattools.export.stage.check_datum", lambda *_: None)
    export(scene, ExportOptions(vertical="egm96"))
    assets = read(scene, "collection")["assets"]
    assert assets["dsm"]["proj:code"] is None
    assert "EGM96 height" in assets["dsm"]["proj:wkt2"]
    assert assets["albedo"]["proj:code"] == "EPSG:32617"
    assert len(pystac.Collection.from_file(str(scene.path("export/collection.json"))).validate()) == 4


def test_what_lies_where_the_maps_were_is_dropped_when_they_move() -> None:
    from sattools.align.stage import MADE_OF_MAPS

    assert {"points", "contours", "mesh", "tileset", "collection"} <= set(MADE_OF_MAPS)
    assert not {"ortho", "ortho_source", "dsm"} & set(MADE_OF_MAPS)

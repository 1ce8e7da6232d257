"""The scene document: what is on the pipe, and a root that may not be left."""

import json
import math
from pathlib import Path
from typing import Any

import geopandas
import pytest

from sattools.errors import SceneError
from sattools.scene import Asset, Grid, Item, Scene
from sattools.scene.document import FIT_ROLE
from sattools.scene.summary import summary

RING = [[-81.7, 30.3], [-81.6, 30.3], [-81.6, 30.4], [-81.7, 30.4], [-81.7, 30.3]]


def make_scene(root: Path) -> Scene:
    properties = {
        "datetime": "2015-03-01T16:00:00Z",
        "view:sun_azimuth": 155.0,
        "view:sun_elevation": 47.0,
        "gsd": 0.5,
        "sattools:role": "train",
    }
    items = [
        Item(
            name,
            {"type": "Polygon", "coordinates": [RING]},
            [-81.7, 30.3, -81.6, 30.4],
            dict(properties),
            {"image": Asset(f"images/{name}.tif", extra={"title": "Zürich"})},
        )
        for name in ("a_001", "a_002")
    ]
    grid = Grid("EPSG:32617", 1000.0, 5000.0, 0.5, 8, 4)
    return Scene("a", root, items, grid, (-26.0, 29.0), {"dsm": "export/dsm.tif"}, [{"command": "prep", "seconds": 1}])


def test_a_scene_survives_its_json(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    again = Scene.from_json(scene.to_json())
    assert again == scene
    assert again.items[0].assets["image"].extra == {"title": "Zürich"}


def test_a_document_of_version_1_is_read_under_the_present_names(tmp_path: Path) -> None:
    data = json.loads(make_scene(tmp_path).to_json())
    data["sattools"]["version"] = 1
    data["sattools"]["history"] = [{"command": "prep", "seconds": 1, "remarks": ["one image left out"]}]
    match = {"gain": [1.0], "offset": [0.0], "contrast": 0.8}
    data["features"][0]["properties"]["sattools:tone_match"] = match
    scene = Scene.from_json(json.dumps(data))
    assert scene.history == [{"command": "prep", "seconds": 1, "notes": ["one image left out"]}]
    assert scene.items[0].properties["sattools:radiometric_balance"] == match
    assert "sattools:tone_match" not in scene.items[0].properties
    assert json.loads(scene.to_json())["sattools"]["version"] == 2


@pytest.mark.parametrize("version", [0, 3, "1", True, None, [1], {}])
def test_a_document_of_an_unknown_version_is_refused(tmp_path: Path, version: Any) -> None:
    data = json.loads(make_scene(tmp_path).to_json())
    data["sattools"]["version"] = version
    with pytest.raises(SceneError, match="expected 2 or an older one"):
        Scene.from_json(json.dumps(data))


@pytest.mark.parametrize("damage", [{"history": 3}, {"history": ["x"]}])
def test_a_damaged_document_of_version_1_is_refused_in_one_line(tmp_path: Path, damage: Any) -> None:
    data = json.loads(make_scene(tmp_path).to_json())
    data["sattools"] |= {"version": 1, **damage}
    with pytest.raises(SceneError, match="found") as caught:
        Scene.from_json(json.dumps(data))
    assert "\n" not in str(caught.value)


def test_json_is_one_line(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    scene.history.append({"notes": ["two\nlines"]})
    assert "\n" not in scene.to_json()


def test_numbers_that_json_does_not_know_become_null(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    scene.items[0].properties["gsd"] = math.nan
    scene.history.append({"psnr": [math.inf, 1.0]})
    data = json.loads(scene.to_json(), parse_constant=lambda name: pytest.fail(f"found {name}"))
    assert data["features"][0]["properties"]["gsd"] is None
    assert data["sattools"]["history"][-1]["psnr"] == [None, 1.0]


def test_a_scene_that_a_notebook_shows_is_one_line(tmp_path: Path) -> None:
    assert repr(make_scene(tmp_path)) == f"Scene('a', '{tmp_path}', 2 images, products ['dsm'])"


def test_items_are_stac_items(tmp_path: Path) -> None:
    data = json.loads(make_scene(tmp_path).to_json())
    assert data["type"] == "FeatureCollection"
    assert data["bbox"] == [-81.7, 30.3, -81.6, 30.4]
    feature = data["features"][0]
    # required by STAC Item 1.1.0
    assert {"type", "stac_version", "id", "geometry", "bbox", "properties", "links", "assets"} <= set(feature)
    assert feature["type"] == "Feature"
    assert feature["stac_version"] == "1.1.0"
    assert "datetime" in feature["properties"]
    assert any("/view/" in extension for extension in feature["stac_extensions"])
    assert any("/projection/" in extension for extension in feature["stac_extensions"])
    assert feature["assets"]["image"]["href"] == "images/a_001.tif"


def test_geopandas_opens_the_file(tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    path.write_text(make_scene(tmp_path).to_json() + "\n")
    table = geopandas.read_file(path)
    assert len(table) == 2
    assert table["view:sun_elevation"].tolist() == [47.0, 47.0]
    assert table.total_bounds.tolist() == [-81.7, 30.3, -81.6, 30.4]


def test_a_relative_root_is_the_folder_of_the_file(tmp_path: Path) -> None:
    data = json.loads(make_scene(tmp_path).to_json())
    data["sattools"]["root"] = "."
    (tmp_path / "moved").mkdir()
    path = tmp_path / "moved" / "scene.json"
    path.write_text(json.dumps(data, indent=2))
    assert Scene.from_file(path).root == tmp_path / "moved"


@pytest.mark.parametrize("href", ["../secret.tif", "a/../../secret.tif", "./..", "link/x.tif"])
def test_relative_paths_may_not_leave_the_root(tmp_path: Path, href: Any) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (root / "link").symlink_to(tmp_path)
    scene = make_scene(root)
    with pytest.raises(SceneError, match="leads outside the scene's root"):
        scene.path(href)
    with pytest.raises(SceneError, match="leads outside the scene's root"):
        scene.output(href)
    assert list(tmp_path.iterdir()) == [root]


def test_a_tile_reads_what_the_folder_of_its_whole_has_and_writes_into_its_own(tmp_path: Path) -> None:
    root = tmp_path / "whole/fit/tiles/r0c0"
    root.mkdir(parents=True)
    scene = make_scene(root)
    assert scene.path("../../../images/x.tif") == tmp_path / "whole/images/x.tif"
    for href in ("../../../../secret.tif", "../../../a/../../secret.tif"):
        with pytest.raises(SceneError, match="leads outside the scene's root"):
            scene.path(href)
    with pytest.raises(SceneError, match="leads outside the scene's root"):
        scene.output("../../../images/x.tif")


def test_a_link_in_place_of_an_output_is_not_followed_out_of_the_root(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (root / "dsm.tif").symlink_to(tmp_path / "precious.tif")
    with pytest.raises(SceneError, match="leads outside"):
        make_scene(root).output("dsm.tif")


def test_a_root_that_is_itself_a_link_is_fine(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "root").symlink_to(tmp_path / "real")
    assert make_scene(tmp_path / "root").output("export/dsm.tif") == tmp_path / "root/export/dsm.tif"


def test_absolute_paths_are_read_but_never_written(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "root")
    elsewhere = str(tmp_path / "elsewhere.tif")
    assert scene.path(elsewhere) == Path(elsewhere)
    with pytest.raises(SceneError, match="found an absolute output path"):
        scene.output(elsewhere)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("sattools"), "without a 'sattools' member"),
        (lambda d: d["sattools"].update(version=3), "found scene version 3, expected 2 or an older one"),
        (lambda d: d.update(features=None), "found no list of features"),
        (lambda d: d.update(id="../a"), "found id '../a'"),
        (lambda d: d.update(id=None), "found id None"),
        (lambda d: d["features"][0].update(id="a/b"), "found id 'a/b'"),
        (lambda d: d["features"][0].pop("properties"), "found no 'properties', expected id, properties, assets"),
        (lambda d: d["features"][0].update(id="a_002"), "item id 'a_002' more than once"),
        (
            lambda d: d["sattools"].update(height_range_m=["low", 3]),
            r"sattools.height_range_m\[0\]: found 'low', expected",
        ),
        (lambda d: d["sattools"].update(grid={"crs": 1}), "expected crs, left, top"),
    ],
)
def test_what_is_not_a_scene_is_refused_with_a_reason(tmp_path: Path, change: Any, words: Any) -> None:
    data = json.loads(make_scene(tmp_path).to_json())
    change(data)
    with pytest.raises(SceneError, match=words) as caught:
        Scene.from_json(json.dumps(data), "stdin line 3")
    assert str(caught.value).startswith("stdin line 3: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "nonsense", "[1, 2]", "null", '{"type": "FeatureCollection"}'])
def test_text_that_is_no_document_is_refused(text: Any) -> None:
    with pytest.raises(SceneError, match=r"expected a scene document"):
        Scene.from_json(text)


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneError, match="found text that is not UTF-16"):
        Scene.from_file(path)


def test_what_a_command_needs_and_the_scene_lacks_is_named(tmp_path: Path) -> None:
    scene = Scene("a", tmp_path)
    with pytest.raises(SceneError, match="found no grid, expected one made by `sattools prep`"):
        scene.require_grid()
    with pytest.raises(SceneError, match="found no height range"):
        scene.require_height_range()


def test_a_summary_marks_what_the_last_fit_held_out(tmp_path: Path) -> None:
    roles: list[dict[str, Any]] = [{}, {FIT_ROLE: "test"}, {"sattools:role": "test"}]
    scene = Scene("A", tmp_path, [Item(f"i{k}", None, None, role) for k, role in enumerate(roles)])
    lines = summary(scene).splitlines()
    assert lines[1] == "  3 images, 2 for training, 1 of them held out by the last fit"
    assert [line.split("no date")[1].strip() for line in lines[2:5]] == ["train", "train, held out by the fit", "test"]

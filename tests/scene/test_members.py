"""What a scene document may hold: wrong types, ranges and names are told before any work is done."""

import copy
import json
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sattools.errors import InputError, SceneError
from sattools.scene import Scene
from sattools.scene.schema import Items, Maybe, Number, Table, Text, meant, shown


@pytest.fixture
def document(town_source: Any) -> Any:
    return json.loads(town_source.to_json())


def properties(document: Any) -> Any:
    return document["features"][0]["properties"]


def ours(document: Any) -> Any:
    return document["sattools"]


NONSENSE = {
    "sun 400": (lambda d: properties(d).update({"view:sun_elevation": 400}), "view:sun_elevation: found 400"),
    "sun NaN": (lambda d: properties(d).update({"view:sun_elevation": float("nan")}), "view:sun_elevation: found nan"),
    "sun text": (lambda d: properties(d).update({"view:sun_azimuth": "abc"}), "view:sun_azimuth: found 'abc'"),
    "role": (lambda d: properties(d).update({"sattools:role": "tset"}), "did you mean 'test'"),
    "bits 0": (lambda d: properties(d).update({"sattools:bits": 0}), "sattools:bits: found 0"),
    "bits -5": (lambda d: properties(d).update({"sattools:bits": -5}), "sattools:bits: found -5"),
    "bits text": (lambda d: properties(d).update({"sattools:bits": "x"}), "sattools:bits: found 'x'"),
    "gsd text": (lambda d: properties(d).update({"gsd": "0.5"}), "gsd: found '0.5'"),
    "gsd 0": (lambda d: properties(d).update({"gsd": 0}), "gsd: found 0"),
    "time": (lambda d: properties(d).update({"datetime": "noon"}), "datetime: found 'noon'"),
    "balance": (
        lambda d: properties(d).update({"sattools:radiometric_balance": {"gain": [1], "x": 1}}),
        "radiometric_balance",
    ),
    "bbox": (lambda d: d["features"][0].update(bbox=[1, 2]), "bbox: found .1, 2., expected a list of 4"),
    "bbox text": (lambda d: d["features"][0].update(bbox="abcd"), "bbox: found 'abcd'"),
    "geometry": (lambda d: d["features"][0]["geometry"].update(coordinates=[[1, 2]]), "geometry.coordinates"),
    "geometry type": (lambda d: d["features"][0]["geometry"].update(type="Polygn"), "did you mean 'Polygon'"),
    "item list": (lambda d: d["features"].append([1]), "found .1., expected an object"),
    "asset": (lambda d: d["features"][0]["assets"].update(image="x.tif"), "assets.image: found 'x.tif'"),
    "href": (lambda d: d["features"][0]["assets"]["image"].update(href=3), "href: found 3"),
    "band": (lambda d: d["features"][0]["assets"]["image"].update({"eo:bands": ["red"]}), r"eo:bands.0.: found 'red'"),
    "wavelength": (
        lambda d: d["features"][0]["assets"]["image"].update({"eo:bands": [{"center_wavelength": "short"}]}),
        "center_wavelength: found 'short'",
    ),
    "href NUL": (lambda d: d["features"][0]["assets"]["image"].update(href="a\0b"), "without NUL"),
    "rpc of another": (
        lambda d: d["features"][0]["assets"].update(rpc=d["features"][1]["assets"]["rpc"]),
        "found the rpc of item TOWN_001",
    ),
    "misspelt property": (
        lambda d: properties(d).update({"view:sun_elevatoin": properties(d).pop("view:sun_elevation")}),
        "did you mean 'view:sun_elevation'",
    ),
    "heights equal": (lambda d: ours(d).update(height_range_m=[5, 5]), "height_range_m: found"),
    "heights reversed": (lambda d: ours(d).update(height_range_m=[50, 5]), "height_range_m: found"),
    "heights NaN": (lambda d: ours(d).update(height_range_m=[float("nan"), 5]), "height_range_m"),
    "heights huge": (lambda d: ours(d).update(height_range_m=[-1e308, 5]), "height_range_m"),
    "one height": (lambda d: ours(d).update(height_range_m=[5]), "height_range_m"),
    "grid infinite": (lambda d: ours(d)["grid"].update(left=1e400), "grid.left: found inf"),
    "grid half": (lambda d: ours(d)["grid"].update(width=10.5), "grid.width: found 10.5"),
    "grid text": (lambda d: ours(d).update(grid="EPSG:4326"), "grid: found 'EPSG:4326'"),
    "grid huge": (lambda d: ours(d)["grid"].update(width=10**6, height=10**6), "cells, expected at most"),
    "grid name": (lambda d: ours(d)["grid"].update(widthh=3), "did you mean 'width'"),
    "member name": (lambda d: ours(d).update(hieght_range_m=[1, 2]), "did you mean 'height_range_m'"),
    "product": (lambda d: ours(d)["products"].update(dsm=["x"]), "products.dsm"),
    "products": (lambda d: ours(d).update(products=["x"]), "products: found"),
    "history": (lambda d: ours(d).update(history=[{}]), "found no 'command'"),
    "history seconds": (lambda d: ours(d).update(history=[{"command": "fit", "seconds": "1"}]), "seconds: found '1'"),
    "history record": (
        lambda d: ours(d).update(history=[{"command": "fit", "made": {"fit": {"items": [], "outputs": {}}}}]),
        "made.fit: found no 'inputs'",
    ),
    "history text": (lambda d: ours(d).update(history="none"), "history: found 'none'"),
    "root": (lambda d: ours(d).update(root=5), "root: found 5"),
}


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_is_told_in_one_line_with_its_place(document: Any, name: Any) -> None:
    change, words = NONSENSE[name]
    change(document)
    with pytest.raises(SceneError, match=words) as caught:
        Scene.from_json(json.dumps(document), "s.json")
    assert str(caught.value).startswith("s.json: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_what_others_add_is_kept(document: Any) -> None:
    properties(document)["eo:cloud_cover"] = {"any": ["thing", 1e3]}
    document["features"][0]["assets"]["thumbnail"] = {"href": "https://example.org/a.png"}
    scene = Scene.from_json(json.dumps(document))
    assert scene.items[0].properties["eo:cloud_cover"] == {"any": ["thing", 1e3]}
    assert scene.items[0].assets["thumbnail"].href == "https://example.org/a.png"


def test_unknown_times_angles_and_numbers_may_be_null(document: Any) -> None:
    for name in ("datetime", "gsd", "view:sun_azimuth", "view:sun_elevation", "sattools:bits", "sattools:value_range"):
        properties(document)[name] = None
    assert Scene.from_json(json.dumps(document)).items[0].sun is None


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


def places(node: Any, found: Any = ()) -> Iterator[Any]:
    yield found
    if isinstance(node, dict):
        for key in node:
            yield from places(node[key], (*found, key))
    elif isinstance(node, list):
        for k in range(min(len(node), 2)):
            yield from places(node[k], (*found, k))


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_any_value_at_any_place_is_read_or_refused(town_source: Any, data: Any) -> None:
    document = json.loads(town_source.to_json())
    document["features"] = document["features"][:2]
    place = data.draw(st.sampled_from(list(places(document))[1:]))
    node = document
    for key in place[:-1]:
        node = node[key]
    node[place[-1]] = data.draw(values)
    text = json.dumps(document)
    try:
        scene = Scene.from_json(text)
    except SceneError as error:
        assert "\n" not in str(error).replace("\\n", "")  # noqa: PT017
        return
    from sattools.scene.summary import summary

    summary(scene)
    again = json.loads(scene.to_json())
    assert copy.deepcopy(again["features"]) == again["features"]


def test_a_schema_names_the_place_and_what_was_meant() -> None:
    kind = Table(
        {"name": Text(("red", "green")), "size": Maybe(Items(Number(0, 5, whole=True), 2, 2))}, ("name",), None
    )
    kind.check({"name": "red", "size": [1, 2.0]}, "x")
    kind.check({"name": "red", "size": None}, "x")
    for value, words in (
        ({}, "x: found no 'name'"),
        ({"name": "gren"}, "did you mean 'green'"),
        ({"name": "red", "size": [1, 9]}, r"x.size\[1\]: found 9, expected a whole number from 0 to 5"),
        ({"name": "red", "size": [1]}, "x.size: found .1., expected a list of 2 values"),
        ({"name": "red", "sizze": None}, "did you mean 'size'"),
        ([], "x: found .., expected an object"),
        ({"name": True}, "x.name: found true"),
    ):
        with pytest.raises(InputError, match=words):
            kind.check(value, "x")


def test_values_are_shown_briefly() -> None:
    assert shown({"a": 1}) == "an object"
    assert shown([1] * 100) == "a list of 100 values"
    assert len(shown("x" * 1000)) <= 40
    assert meant("fitt", ["fit", "export"]) == " (did you mean 'fit'?)"
    assert meant("qqqq", ["fit", "export"]) == ""

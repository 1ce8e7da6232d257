"""Outlines and boxes at the antimeridian are as RFC 7946 wants them, elsewhere as they always were."""

from typing import Any

import pytest
from shapely.geometry import shape

from sattools.scene import Scene
from sattools.scene.document import Item
from sattools.scene.globe import box_of_all, outline_on_globe

PLAIN = [[10.0, 1.0], [12.0, 1.0], [12.0, 3.0], [10.0, 3.0], [10.0, 1.0]]


def square(west: float, east: float) -> list[list[float]]:
    return [[west, 1.0], [east, 1.0], [east, 3.0], [west, 3.0], [west, 1.0]]


def test_an_outline_away_from_the_antimeridian_stays_as_it_is() -> None:
    assert outline_on_globe(PLAIN) == ({"type": "Polygon", "coordinates": [PLAIN]}, [10.0, 1.0, 12.0, 3.0])


@pytest.mark.parametrize("ring", [square(179.0, -178.0), square(179.0, 182.0), square(-181.0, -178.0)])
def test_an_outline_across_the_antimeridian_is_cut_there(ring: list[list[float]]) -> None:
    geometry, box = outline_on_globe(ring)
    assert box == [179.0, 1.0, -178.0, 3.0]
    assert geometry["type"] == "MultiPolygon"
    found = shape(geometry)
    assert found.is_valid
    assert sorted(part.bounds for part in found.geoms) == [(-180.0, 1.0, -178.0, 3.0), (179.0, 1.0, 180.0, 3.0)]
    assert all(part.exterior.is_ccw for part in found.geoms)


def test_an_outline_wholly_beyond_comes_back() -> None:
    geometry, box = outline_on_globe(square(181.0, 183.0))
    assert (geometry["type"], box) == ("Polygon", [-179.0, 1.0, -177.0, 3.0])
    assert shape(geometry).bounds == (-179.0, 1.0, -177.0, 3.0)


@pytest.mark.parametrize(
    ("boxes", "whole"),
    [
        ([[10.0, 1.0, 12.0, 3.0], [11.0, 0.0, 13.0, 2.0]], [10.0, 0.0, 13.0, 3.0]),
        ([[179.0, 1.0, -179.0, 3.0], [178.0, 2.0, 179.5, 4.0]], [178.0, 1.0, -179.0, 4.0]),
        ([[-179.0, 1.0, -178.0, 3.0], [178.0, 2.0, 179.0, 4.0]], [178.0, 1.0, -178.0, 4.0]),
    ],
)
def test_the_box_of_all(boxes: list[list[float]], whole: list[float]) -> None:
    assert box_of_all(boxes) == whole


def test_a_scene_at_the_antimeridian_is_written_and_read(tmp_path: Any) -> None:
    geometry, box = outline_on_globe(square(179.0, -178.0))
    scene = Scene("A", tmp_path, items=[Item("one", geometry, box, {}), Item("two", geometry, box, {})])
    again = Scene.from_json(scene.to_json())
    assert again.to_dict()["bbox"] == [179.0, 1.0, -178.0, 3.0]
    assert again.items[0].geometry == geometry

"""Times and suns that vendors give under other names, and times in the names of images."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from sattools.prep.metadata import Metadata, from_tags, read_sidecar

TIME = datetime(2014, 10, 17, 15, 48, 58, tzinfo=UTC)
SUN = {"sun_azimuth": 158.5, "sun_elevation": 41.0}


def read(folder: Path, document: Any) -> Metadata:
    (folder / "a.json").write_text(json.dumps(document))
    return read_sidecar(folder / "a.json")


@pytest.mark.parametrize("name", ["city_20141017T154858_01", "20141017-154858", "20141017T154858-01"])
def test_the_name_of_an_image_tells_its_time(name: str) -> None:
    assert from_tags({}, name).time == TIME


def test_planets_time_and_sun(tmp_path: Path) -> None:
    properties = {"acquired": "2014-10-17T15:48:58Z"} | SUN
    for document in ({"type": "Feature", "properties": properties}, properties):
        found = read(tmp_path, document)
        assert (found.time, found.sun) == (TIME, (158.5, 41.0))


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ("2014-10-17T15:48:56Z", "2014-10-17T15:49:00Z"),
        ("2014-10-17T15:48:58Z", None),
        (None, "2014-10-17T15:48:58Z"),
    ],
)
def test_a_stac_item_without_a_moment_has_the_middle_of_its_interval(tmp_path: Path, start: Any, end: Any) -> None:
    properties = {"datetime": None, "start_datetime": start, "end_datetime": end}
    assert read(tmp_path, {"type": "Feature", "properties": properties}).time == TIME

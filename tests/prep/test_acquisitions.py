"""When images were taken, and whether two of them are one acquisition."""

import shutil
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from spoilt import Town, made, prep, warned

from sattools.errors import InputError
from sattools.prep.colours import partners
from sattools.prep.metadata import Metadata, from_tags
from sattools.prep.pairs import repeated
from sattools.prep.times import same_moment
from sattools.scene import Scene

NOON = datetime(2014, 10, 17, 15, 48, 58, tzinfo=UTC)
MIDNIGHT = datetime(2014, 10, 17, tzinfo=UTC)


@pytest.fixture
def town(town_source: Any, tmp_path: Path) -> Any:
    return Town(tmp_path, town_source, 4)


@pytest.mark.parametrize(
    "name",
    [
        "14OCT17154858-P1BS-500648062080_01_P001",
        "14oct17154858-m1bs_r1c2-500648062080_01_p001",
        "01NOV15WV031000014OCT17154858-P1BS-500648062080_01_P001_________AAE_0AAAAABPABM0",
    ],
)
def test_names_of_maxar_tell_the_time(name: str) -> None:
    assert from_tags({}, name).time == NOON


@pytest.mark.parametrize("name", ["14OCT17154858-01", "14OKT17154858-P1BS", "050011221344011", "21091122_134401"])
def test_numbers_of_orders_in_names_are_no_times(name: str) -> None:
    assert from_tags({}, name).time is None


def test_a_date_without_a_time_of_day_tells_no_sun(town: Any) -> None:
    town.metadata(2, acquisition_date="2014-10-17T00:00:00Z", sun_azimuth=None, sun_elevation=None)
    scene = made(town, "TOWN_002: sun unknown: 2014-10-17 00:00:00 is taken for a date without a time of day")
    assert scene.items[1].properties["sattools:sun"] == "unknown"
    assert scene.items[1].properties["datetime"] == "2014-10-17T00:00:00Z"
    assert scene.items[0].properties["sattools:sun"] == "metadata"


def test_a_date_without_a_time_of_day_contradicts_no_sun(town: Any) -> None:
    town.metadata(2, acquisition_date="2014-10-17T00:00:00Z")
    result = prep(town)
    assert (result.exit_code, result.stderr) == (0, "")
    assert Scene.from_json(result.stdout).items[1].properties["sattools:sun"] == "metadata"


def test_an_acquisition_that_is_given_twice_is_told(town: Any) -> None:
    shutil.copy(town.image(1), town.image(9))
    shutil.copy(town.folder / "metadata/TOWN_001.json", town.folder / "metadata/TOWN_009.json")
    town.pixels(9, lambda pixels: pixels + 1)
    words = "TOWN_001 and TOWN_009 look from one direction at one time: one acquisition, which counts twice?"
    made(town, words)
    for number in (1, 9):  # what is not known is no contradiction
        town.metadata(number, acquisition_date=None)
    warned(town, "TOWN_001 and TOWN_009 look from one direction: one acq", options=("--overwrite",))
    town.metadata(1, acquisition_date="20141018154858")
    result = prep(town, "--overwrite")
    assert "one direction" not in result.stderr


def test_neighbouring_parts_of_an_acquisition_are_not_one_that_is_given_twice() -> None:
    sources = [image("A", NOON), image("B", NOON)]
    result: Any = SimpleNamespace(views=[SimpleNamespace(name=s.id, tie_points=1000) for s in sources])

    def told(angle: float, points: int) -> list[str]:
        return repeated([{"images": ["A", "B"], "angle_deg": angle, "tie_points": points}], result, sources)

    assert len(told(0.0, 800)) == 1
    assert told(0.0, 300) == []
    assert told(0.2, 800) == []


def test_moments_are_the_same_within_seconds_where_they_are_known() -> None:
    assert same_moment(NOON, NOON.replace(second=59))
    assert not same_moment(NOON, NOON.replace(minute=49))
    assert not same_moment(NOON, None)
    assert not same_moment(MIDNIGHT, MIDNIGHT)


def image(name: str, time: datetime | None) -> Any:
    return SimpleNamespace(id=name, path=Path(f"{name}.tif"), metadata=Metadata(time=time))


def test_colours_of_one_acquisition_go_to_one_image() -> None:
    pans = [image("A", NOON), image("B", NOON.replace(minute=50))]
    assert partners(pans, [image("X", NOON)])[1] is None
    with pytest.raises(InputError, match=r"^--colours: found X\.tif for A and B, expected one for each$"):
        partners([image("A", NOON), image("B", NOON.replace(second=57))], [image("X", NOON)])
    with pytest.raises(InputError, match="found no image with the name or the time of A"):
        partners([image("A", MIDNIGHT), image("B", MIDNIGHT)], [image("X", MIDNIGHT)])

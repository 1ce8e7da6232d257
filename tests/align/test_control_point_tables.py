"""Tables of control points as spreadsheets write them, and options that say nothing about points."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sattools.align.options import AlignOptions
from sattools.align.reference import read_control_points
from sattools.align.shift import Shift
from sattools.align.stage import _check, check_start
from sattools.errors import InputError, SattoolsError
from sattools.scene import Scene

ROWS = (("Name", "X", "Y", "Z", "Item", "Column", "Row"), ("corner", "436001.5", "3355002", "3", "TOWN_001", "4", "5"))


@pytest.mark.parametrize("between", [",", ";", "\t", " , "])
def test_columns_may_be_parted_by_commas_semicolons_or_tabs(tmp_path: Path, between: str) -> None:
    path = tmp_path / "points.csv"
    path.write_text("\ufeff" + "\r\n".join(between.join(row) for row in ROWS))
    (point,) = read_control_points(path, "EPSG:32617")
    assert (point.name, point.x, point.y, point.z) == ("corner", 436001.5, 3355002.0, 3.0)
    assert (point.item, point.column, point.row) == ("TOWN_001", 4.0, 5.0)


def test_decimals_may_begin_with_a_comma_where_semicolons_part_columns(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("\n" + "\n".join("; ".join(row).replace(".", ",") for row in ROWS))
    (point,) = read_control_points(path, "EPSG:32617")
    assert (point.x, point.y, point.z) == (436001.5, 3355002.0, 3.0)


@pytest.mark.parametrize(("column", "row"), [("Column", "ROW"), ("column", "row")])
def test_points_of_a_vector_file_have_their_own_height_where_the_table_has_none(
    tmp_path: Path, column: str, row: str
) -> None:
    about = {"NAME": "corner", "Item": "TOWN_001", column: 4.0, row: 5.0, "z": None}
    place = {"type": "Point", "coordinates": [-81.66, 30.32, 3.0]}
    feature = {"type": "Feature", "properties": about, "geometry": place}
    path = tmp_path / "points.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    (point,) = read_control_points(path, "EPSG:4326")
    assert (point.name, point.x, point.y, point.z) == ("corner", -81.66, 30.32, 3.0)
    assert (point.item, point.column, point.row) == ("TOWN_001", 4.0, 5.0)


@pytest.mark.parametrize(
    ("options", "what"), [({"method": "z"}, "--method z"), ({"tilt": True}, "--tilt"), ({"method": "icp"}, "")]
)
def test_what_points_cannot_do_is_refused_or_told(
    town_source: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture, options: dict[str, object], what: str
) -> None:
    path = tmp_path / "points.csv"
    path.write_text("\n".join(",".join(row) for row in ROWS))
    with pytest.raises(SattoolsError) as refused:  # this scene has no DSM, which is asked for later
        check_start(town_source, AlignOptions(to=str(path), **options))
    if what:
        assert f"points.csv: found control points, expected a raster of heights for {what}" in str(refused.value)
    else:
        assert "points.csv: control points, for which --method icp does nothing" in caplog.text


@pytest.mark.parametrize(
    ("east", "up", "said"),
    [(3.0, 150.0, "are the vertical datums the same?"), (1000.0, 5.0, "are the places in the CRS that they are said")],
)
def test_a_large_shift_is_asked_about_where_it_is_large(east: float, up: float, said: str) -> None:
    with pytest.raises(InputError, match=r"expected at most 100 m \(--max-shift\)") as refused:
        _check(Shift(east, 0.0, up, 1.0, 1.0, 100), Path("dem.tif"), AlignOptions())
    assert said in str(refused.value)

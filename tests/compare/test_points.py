"""Samples at named points beside the maps' values."""

from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
from shapely.geometry import Point as Place
from shapely.geometry import box

from sattools.camera.ground import to_geographic
from sattools.compare.picture import scatter_picture
from sattools.compare.points import Point, compare_points, read_points, sampled, with_values_of
from sattools.errors import InputError
from sattools.scene import Grid

GRID = Grid("EPSG:32633", 500000.0, 5000040.0, 2.0, 20, 20)
THETA = np.arange(400, dtype=np.float32).reshape(1, 20, 20)
REFLECTANCE = np.stack([THETA[0], 2 * THETA[0]])
MAPS = {"theta": (THETA, GRID), "reflectance": (REFLECTANCE, GRID)}


def test_a_csv_of_points_is_compared_cell_by_cell_and_band_by_band(tmp_path: Path) -> None:
    file = tmp_path / "samples.csv"
    # the centre of cell (row 1, column 2) and a place outside
    file.write_text("name,x,y,theta,reflectance_2,remark\nbasalt,500005,5000037,20,40.5,dark\nfar,1,1,3,,\n")
    basalt, far = compare_points(read_points(file), MAPS)
    assert basalt["name"] == "basalt"
    assert basalt["values"]["theta"] == {"map": 22.0, "sample": 20.0, "difference": 2.0}
    assert basalt["values"]["reflectance_2"] == {"map": 44.0, "sample": 40.5, "difference": 3.5}
    assert far["values"]["theta"] == {"map": None, "sample": 3.0, "difference": None}


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffName;X;Y;Theta;Reflectance_2\r\nbasalt 1,5;500005,0;5000037,0;20,5;40,5\r\n",
        "\nName\tX\tY\tTHETA\treflectance_2\nbasalt 1,5\t500005\t5000037\t20,5\t4,05e1\n",
        'name , x , y , theta , reflectance_2\n"basalt 1,5", 500005, 5000037, 20.5, 40.5\n',
    ],
    ids=["semicolons", "tabs", "blanks"],
)
def test_tables_of_samples_are_read_as_spreadsheets_write_them(tmp_path: Path, text: str) -> None:
    file = tmp_path / "samples.csv"
    file.write_text(text, newline="")
    values = {"theta": 20.5, "reflectance_2": 40.5}
    assert read_points(file) == [Point("basalt 1,5", 500005.0, 5000037.0, None, values)]


def test_columns_of_a_vector_file_may_have_capital_letters(tmp_path: Path) -> None:
    file = tmp_path / "samples.shp"
    frame = {"NAME": ["basalt", None], "THETA": [20.5, 3.0]}
    places = [Place(500005.0, 5000037.0), Place(500001.0, 5000039.0)]
    geopandas.GeoDataFrame(frame, geometry=places, crs="EPSG:32633").to_file(file)
    found = [(point.name, point.values) for point in read_points(file)]
    assert found == [("basalt", {"theta": 20.5}), ("2", {"theta": 3.0})]


def test_a_registered_map_is_read_where_it_really_lies(tmp_path: Path) -> None:
    file = tmp_path / "samples.csv"
    file.write_text("name,x,y,theta\na,500005,5000037,20\n")
    # the map was moved 2 m east to fit, so the sample lies one column further west in it
    (row,) = compare_points(read_points(file), MAPS, shift=(2.0, 0.0))
    assert row["values"]["theta"]["map"] == 21.0
    # and one that was moved 2 m north: the row further south
    (row,) = compare_points(read_points(file), MAPS, shift=(0.0, 2.0))
    assert row["values"]["theta"]["map"] == 42.0


def test_a_point_belongs_to_the_cell_around_it_up_to_the_borders_of_the_map() -> None:
    def at(x: float, y: float) -> Any:
        found = sampled(REFLECTANCE, GRID, Point("p", x, y, None, {}))
        return None if found is None else found.tolist()

    west, south, east, north = GRID.bounds
    assert at(west, north) == [0.0, 0.0]
    assert at(east - 0.01, south + 0.01) == [399.0, 798.0]
    assert at(west + 0.01, south + 0.01) == [380.0, 760.0]
    assert [at(west - 0.01, north - 1), at(east, north - 1), at(west, north + 0.01), at(west, south)] == [None] * 4


def test_values_of_reference_maps_fill_what_a_point_does_not_say_itself() -> None:
    inside = Point("a", 500005.0, 5000037.0, None, {"theta": 20.0, "reflectance_3": 1.0, "remark": 7.0})
    outside = Point("b", 1.0, 1.0, None, {})
    first, second = with_values_of([inside, outside], MAPS)
    own = {"theta": 20.0, "reflectance_3": 1.0, "remark": 7.0}
    assert first.values == own | {"reflectance_1": 22.0, "reflectance_2": 44.0}
    assert second.values == {}
    # a third band and a name of no map have nothing to be compared with
    (row,) = compare_points([first], MAPS)
    assert list(row["values"]) == ["theta", "reflectance_1", "reflectance_2"]


def test_polygons_are_no_sample_points(tmp_path: Path) -> None:
    shape = box(500000, 5000000, 500010, 5000010)
    geopandas.GeoDataFrame({"theta": [20.0]}, geometry=[shape], crs=GRID.crs).to_file(tmp_path / "a.gpkg")
    with pytest.raises(InputError, match=r"found \['Polygon'\], expected points"):
        read_points(tmp_path / "a.gpkg")


@pytest.mark.parametrize("name", ["samples.gpkg", "samples.csv"])
def test_places_in_degrees(tmp_path: Path, name: Any) -> None:
    lon, lat = (float(v) for v in to_geographic(GRID.crs, 500005.0, 5000037.0))
    file = tmp_path / name
    if name.endswith("csv"):
        file.write_text(f"name,lon,lat,theta\nsalt,{lon!r},{lat!r},20\n")
    else:
        frame = geopandas.GeoDataFrame({"name": ["salt"], "theta": [20.0]}, geometry=[Place(lon, lat)], crs="EPSG:4326")
        frame.to_file(file)
    (row,) = compare_points(read_points(file), MAPS)
    assert row["name"] == "salt"
    assert row["values"]["theta"]["map"] == 22.0


@pytest.mark.parametrize(
    ("text", "message"),
    [("name,theta\na,1\n", "x, y or lon, lat"), ("name,x,y\na,1,2\n", "no value"), ("", "no sample point")],
)
def test_files_that_hold_no_samples_are_refused(tmp_path: Path, text: Any, message: Any) -> None:
    file = tmp_path / "samples.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_points(file)


@pytest.mark.drawn
def test_a_scatter_plot_is_drawn_also_of_a_constant_map(tmp_path: Path) -> None:
    scatter_picture(np.zeros_like(THETA), THETA, "theta", tmp_path / "scatter.png")
    assert (tmp_path / "scatter.png").stat().st_size > 5000

"""Samples at named points beside the maps' values."""

from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
from shapely.geometry import Point as Place

from sattools.camera.ground import to_geographic
from sattools.compare.picture import scatter_picture
from sattools.compare.points import compare_points, read_points
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


def test_a_registered_map_is_read_where_it_really_lies(tmp_path: Path) -> None:
    file = tmp_path / "samples.csv"
    file.write_text("name,x,y,theta\na,500005,5000037,20\n")
    # the map was moved 2 m east to fit, so the sample lies one column further west in it
    (row,) = compare_points(read_points(file), MAPS, shift=(2.0, 0.0))
    assert row["values"]["theta"]["map"] == 21.0


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


def test_a_scatter_plot_is_drawn_also_of_a_constant_map(tmp_path: Path) -> None:
    scatter_picture(np.zeros_like(THETA), THETA, "theta", tmp_path / "scatter.png")
    assert (tmp_path / "scatter.png").stat().st_size > 5000

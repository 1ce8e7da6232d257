"""Footprints, groups of images, the default area and windows."""

import json
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
from shapely.geometry import Polygon, box
from synthetic_views import ALT0, EAST_M, LAT0, LON0, NORTH_M, parallel_rpc

from sattools.camera.ground import from_geographic
from sattools.errors import InputError
from sattools.prep.area import bounds_from_file, bounds_from_geojson, bounds_from_numbers
from sattools.prep.items import off_nadir_deg
from sattools.prep.layout import common_bounds, footprint, groups, left_out
from sattools.scene.grid import default_cell_size

UTM33 = "EPSG:32633"
X, Y = from_geographic(UTM33, LON0, LAT0)


def test_footprint_is_the_image_outline_at_that_height() -> None:
    polygon = footprint(parallel_rpc(run=(0.3, 0.0), gsd=0.5, size=(200, 100)), (0, 0, 100, 200), ALT0 + 10.0)
    west, south, east, north = polygon.bounds
    # 100 pixels of 0.5 m are 50 m, moved 3 m east at 10 m
    assert ((west - LON0) * EAST_M, (east - LON0) * EAST_M) == pytest.approx((-22.0, 28.0), abs=1e-3)
    assert ((south - LAT0) * NORTH_M, (north - LAT0) * NORTH_M) == pytest.approx((-50.0, 50.0), abs=1e-3)
    assert polygon.exterior.is_ccw


def test_groups_join_through_others_and_the_largest_comes_first() -> None:
    boxes = [box(100, 0, 101, 1), box(0, 0, 2, 1), box(1, 0, 4, 1), box(3, 0, 5, 1)]
    assert groups(boxes) == [[1, 2, 3], [0]]


def test_default_area_is_what_half_of_the_images_show() -> None:
    boxes = [box(0, 0, 100, 100), box(10, 0, 110, 100), box(20, 0, 120, 100), box(90, 0, 200, 100)]
    assert common_bounds(boxes) == pytest.approx((10, 0, 120, 100), abs=1.0)
    assert common_bounds([box(0, 0, 1, 1), box(5, 5, 6, 6)]) is None
    assert common_bounds([Polygon()]) is None


def test_a_mosaic_of_which_the_default_area_is_a_small_part_is_told_with_the_bounds_of_the_rest() -> None:
    def at(west: float, south: float, size: float) -> Polygon:
        return box(X + west, Y + south, X + west + size, Y + south + size)

    mosaic = [at(0, 0, 800), at(0, 0, 410), at(390, 0, 410), at(0, 420, 380), at(420, 420, 380)]
    assert left_out(common_bounds(mosaic), mosaic, UTM33) == [
        "the area is where half of the images have data, 1 % of where two of them do: for all of that "
        "--bounds 15.00000 46.00000 15.01033 46.00720 (degrees; with --crs its metres)"
    ]
    alike = [at(0, 0, 800), at(100, 0, 800), at(-100, 50, 800)]
    assert left_out(common_bounds(alike), alike, UTM33) == []


@pytest.mark.parametrize(
    ("gsd", "cell"),
    [
        (0.05, 0.05),
        (0.15, 0.2),
        (0.27, 0.5),
        (0.31, 0.5),
        (0.5, 0.5),
        (0.7, 0.5),
        (0.88, 0.5),
        (0.9, 1.0),
        (1.5, 1.0),
        (1.9, 2.0),
        (4.0, 2.0),
        (9, 10),
    ],
)
def test_the_default_cell_is_the_round_one_below_the_pixels_but_not_for_accuracy_below_half_a_metre(
    gsd: Any, cell: Any
) -> None:
    assert default_cell_size(gsd) == cell


def test_bounds_are_degrees_without_crs_and_metres_with_it() -> None:
    assert bounds_from_numbers([X, Y, X + 10, Y + 20], UTM33, UTM33) == (X, Y, X + 10, Y + 20)
    in_degrees = bounds_from_numbers([LON0, LAT0, LON0 + 10 / EAST_M, LAT0 + 20 / NORTH_M], UTM33, None)
    assert in_degrees == pytest.approx((X, Y, X + 10, Y + 20), abs=0.02)
    with pytest.raises(InputError, match="expected --crs"):
        bounds_from_numbers([X, Y, X + 10, Y + 20], UTM33, None)
    with pytest.raises(InputError, match="west < east"):
        bounds_from_numbers([2, 0, 1, 1], UTM33, None)


@pytest.mark.parametrize("east", [180.002, -179.998])
def test_bounds_may_reach_across_180_degrees(east: float) -> None:
    """With a west larger than the east as in the bbox of GeoJSON and STAC, too."""
    west, south, right, north = bounds_from_numbers([179.998, 20.0, east, 20.002], "EPSG:32601", None)
    assert (right - west, north - south) == pytest.approx((422.8, 229.1), abs=0.1)  # turned by a degree there


def test_geojson_area_in_degrees_or_in_its_own_crs(tmp_path: Path) -> None:
    ring = [[LON0, LAT0], [LON0 + 10 / EAST_M, LAT0], [LON0, LAT0 + 20 / NORTH_M], [LON0, LAT0]]
    feature = {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [ring]}}
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    assert bounds_from_geojson(path, UTM33) == pytest.approx((X, Y, X + 10, Y + 20), abs=0.02)
    metres = [[X, Y], [X + 10, Y], [X, Y + 20], [X, Y]]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [metres], "crs": crs}))
    assert bounds_from_geojson(path, UTM33) == pytest.approx((X, Y, X + 10, Y + 20), abs=1e-6)
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [metres]}))
    with pytest.raises(InputError, match="no degrees"):
        bounds_from_geojson(path, UTM33)
    path.write_text(json.dumps({"type": "FeatureCollection", "features": []}))
    with pytest.raises(InputError, match="found no polygon"):
        bounds_from_geojson(path, UTM33)


@pytest.mark.parametrize("suffix", ["gpkg", "shp", "fgb"])
def test_area_of_other_vector_formats_in_their_own_crs(suffix: str, tmp_path: Path) -> None:
    frame = geopandas.GeoDataFrame(geometry=[box(X, Y, X + 10, Y + 5), box(X + 2, Y, X + 4, Y + 20)], crs=UTM33)
    path = tmp_path / f"area.{suffix}"
    frame.to_crs("EPSG:4326").to_file(path)
    # polygons turned into degrees and back: their corners return to a hair
    assert bounds_from_file(path, UTM33) == pytest.approx((X, Y, X + 10, Y + 20), abs=1e-3)


def test_off_nadir_is_smaller_than_incidence_by_the_earths_curvature() -> None:
    # vendor's figures of a WorldView-2 scene: satellite elevation 52.6, off-nadir 32.7 degrees
    assert off_nadir_deg(90 - 52.6, "WorldView-2") == pytest.approx(32.7, abs=0.2)
    # Pléiades at 694 km
    assert off_nadir_deg(30.0, "Pleiades-1A") == pytest.approx(26.80, abs=0.01)
    assert off_nadir_deg(0.0, None) == 0.0
    assert np.isfinite(off_nadir_deg(89.0, None))

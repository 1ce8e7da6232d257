"""Rays in a projected grid, directions, grid north, and the sun."""

import json
import math
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np
import pytest
from synthetic_views import ALT0, LAT0, LON0, parallel_rpc

from sattools.camera import RPC
from sattools.camera.ground import (
    azimuth_elevation,
    check_projected,
    check_scale,
    convergence_deg,
    crop_window,
    direction,
    foreshortening,
    from_geographic,
    grid_direction,
    grid_sun,
    ground_area,
    ground_rays,
    ground_sample_distance,
    middle_lon_lat,
    project,
    to_geographic,
    to_grid_north,
    utm_crs,
    view_direction,
)
from sattools.camera.sun import sun_position
from sattools.errors import InputError
from sattools.scene.grid import Grid

UTM33 = "EPSG:32633"
X, Y = from_geographic(UTM33, LON0, LAT0)


def test_utm_zone_of_a_place() -> None:
    assert utm_crs(-81.66, 30.35) == "EPSG:32617"
    assert utm_crs(15.0, -46.0) == "EPSG:32733"
    assert utm_crs(180.0, 10.0) == "EPSG:32601"


def test_view_direction_of_a_parallel_camera() -> None:
    # Line of sight: 0.3 m east and 0.2 m south per metre of height, upwards to the sensor.
    got = view_direction(parallel_rpc(run=(0.3, -0.2)), LON0, LAT0, 0.0)
    want = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    assert got == pytest.approx(want, abs=1e-9)


def test_ground_sample_distance_of_a_parallel_camera() -> None:
    assert ground_sample_distance(parallel_rpc(gsd=0.7), LON0, LAT0, 0.0) == pytest.approx(0.7, abs=1e-9)


def test_ground_rays_lean_as_the_camera_does() -> None:
    rpc = parallel_rpc(run=(0.3, -0.2))
    low, high = ground_rays(rpc, UTM33, [100.0, 50.0], [80.0, 200.0], ALT0, ALT0 + 100.0)
    # UTM's scale on its central meridian is 0.9996; height scales the run by 100 m / 6378 km more or less.
    assert (high - low)[0] == pytest.approx([30.0 * 0.9996, -20.0 * 0.9996], abs=2e-3)
    col, row = project(rpc, UTM33, low[:, 0], low[:, 1], ALT0)
    assert col == pytest.approx([100.0, 50.0], abs=1e-4)
    assert row == pytest.approx([80.0, 200.0], abs=1e-4)


def test_rays_are_straight_between_two_heights(data_dir: Any) -> None:
    rpc = RPC.from_file(data_dir / "dfc2019/rpc_raw/JAX_068/JAX_068_010_RGB.json")  # the most oblique view, 32 degrees
    low, high = ground_rays(rpc, "EPSG:32617", [350.0], [350.0], -40.0, 40.0)
    middle, _ = ground_rays(rpc, "EPSG:32617", [350.0], [350.0], 0.0, 40.0)
    assert np.abs(middle - (low + high) / 2).max() < 1e-3


def test_grid_and_geographic_coordinates_go_back_and_forth() -> None:
    x, y = from_geographic(UTM33, 15.0, 46.0)
    assert x == pytest.approx(500_000.0, abs=1e-6)
    assert to_geographic(UTM33, x, y) == pytest.approx((15.0, 46.0), abs=1e-10)


def test_the_middle_of_a_grid_is_a_place_on_the_earth() -> None:
    x, y = from_geographic(UTM33, 15.0, 46.0)
    grid = Grid(UTM33, x - 40.0, y + 20.0, 0.5, 160, 80)
    assert grid.middle == pytest.approx((x, y), abs=1e-8)
    assert middle_lon_lat(grid) == pytest.approx((15.0, 46.0), abs=1e-10)
    # on the central meridian, where grid north is true north
    assert grid_sun(grid, 90.0, 30.0) == pytest.approx((math.sqrt(0.75), 0.0, 0.5), abs=1e-9)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:2263", "nonsense"])
def test_a_crs_that_is_not_projected_in_metres_is_refused(crs: Any) -> None:
    with pytest.raises(InputError, match=r"expected e\.g\. EPSG:32617"):
        check_projected(crs)


def test_a_crs_of_another_region_is_refused_where_its_metres_are_none() -> None:
    for lon, lat in ((15.0, 46.0), (9.5, 46.0), (15.0, -33.0)):  # half a zone beyond the next one: scale 1.0019
        check_scale(UTM33, lon, lat)
    with pytest.raises(InputError, match=r"at 46\.000 N 15\.000 E 1\.44 m in it are 1 m .* such as EPSG:32633$"):
        check_scale("EPSG:3857", 15.0, 46.0)  # 1 / cos(46 degrees)
    with pytest.raises(InputError, match=r"at 0\.000 N 33\.000 E 1\.05 m in it are 1 m on the ground"):
        check_scale(UTM33, 33.0, 0.0)  # UTM: 0.9996 cosh(18 degrees) eastwards
    with pytest.raises(InputError, match=r"at 46\.000 N 15\.000 E .* expected a CRS of this region"):
        check_scale("EPSG:3577", 15.0, 46.0)  # Australia's


@pytest.mark.parametrize(
    ("crs", "lon", "lat", "area"),
    [
        (UTM33, 15.0, 46.0, 1 / 0.9996**2),  # on the central meridian
        ("EPSG:3857", 10.0, 0.0, 0.993306),  # a sphere of the equator's radius, so 1 - e^2 northwards
        ("EPSG:3857", 10.0, 60.0, 0.250839),  # and not the sphere's 1/4
        ("EPSG:3035", 30.0, 60.0, 1.0),  # of equal areas
    ],
)
def test_a_square_metre_of_a_map_is_so_large_on_the_ground(crs: str, lon: float, lat: float, area: float) -> None:
    x, y = from_geographic(crs, lon, lat)
    assert ground_area(crs, (x - 50, y - 50, x + 50, y + 50)) == pytest.approx(area, abs=1e-6)
    with pytest.raises(InputError, match="does not reach"):
        ground_area(crs, (9e8, 9e8, 9.1e8, 9.1e8))


@pytest.mark.parametrize(("run", "tangent"), [((0.0, 0.0), 0.0), ((0.6, 0.0), 0.6), ((0.3, -0.4), 0.5)])
def test_foreshortening_is_that_of_the_camera(run: tuple[float, float], tangent: float) -> None:
    """The formula's pixels are squares on the ground, whatever the line of sight is."""
    rpc = parallel_rpc(run=run)
    assert foreshortening(rpc, LON0, LAT0, 0.0) == pytest.approx((tangent, 1.0), abs=1e-9)


def test_pixels_that_are_longer_along_the_line_of_sight_are_told() -> None:
    rpc = parallel_rpc(run=(0.75, 0.0))
    # a camera that looks down at 36.87 degrees: 1 / cos = 1.25 times as long eastwards as northwards
    slanted = replace(rpc, col_num=rpc.col_num / 1.25)
    assert foreshortening(slanted, LON0, LAT0, 0.0) == pytest.approx((0.75, 1.25), abs=1e-9)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "vector"),
    [
        (0, 0, (0, 1, 0)),
        (90, 0, (1, 0, 0)),
        (180, 0, (0, -1, 0)),
        (123, 90, (0, 0, 1)),
        (270, 60, (-0.5, 0, 0.8660254038)),
    ],
)
def test_azimuth_counts_clockwise_from_north(azimuth: Any, elevation: Any, vector: Any) -> None:
    assert direction(azimuth, elevation) == pytest.approx(vector, abs=1e-9)
    if elevation < 90:
        assert azimuth_elevation(vector) == pytest.approx((azimuth, elevation), abs=1e-7)


def test_grid_north_at_jacksonville_lies_west_of_true_north() -> None:
    # (lon - central meridian) sin(lat) = -0.6637 sin(30.349) = -0.335 degrees
    assert convergence_deg("EPSG:32617", -81.6637, 30.349) == pytest.approx(-0.335, abs=1e-3)
    assert convergence_deg(UTM33, 15.0, 46.0) == pytest.approx(0.0, abs=1e-6)


def test_a_true_azimuth_becomes_a_larger_grid_azimuth_west_of_the_central_meridian() -> None:
    vector = grid_direction(150.0, 40.0, "EPSG:32617", -81.6637, 30.349)
    assert azimuth_elevation(vector) == pytest.approx((150.335, 40.0), abs=1e-3)


def test_grid_direction_points_where_a_step_along_the_true_azimuth_lands() -> None:
    lon, lat, azimuth = -81.6637, 30.349, 70.0
    east, north = np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))
    step = 1e-4
    x, y = from_geographic("EPSG:32617", [lon, lon + step * east / np.cos(np.radians(lat))], [lat, lat + step * north])
    moved = np.array([x[1] - x[0], y[1] - y[0]])
    want = to_grid_north(direction(azimuth, 0.0), convergence_deg("EPSG:32617", lon, lat))[:2]
    # degrees of latitude and longitude are not equally long on the ellipsoid: 0.2 degrees of azimuth here
    assert moved / np.linalg.norm(moved) == pytest.approx(want, abs=5e-3)


def test_sun_of_the_published_example() -> None:
    # Reda and Andreas 2004, example A.5: 2003-10-17 12:30:30 at UTC-7, 39.742476 N, 105.1786 W, 1830.14 m:
    # azimuth 194.34024, zenith 50.11162 degrees with refraction at 820 hPa and 11 C
    time = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    azimuth, elevation = sun_position(time, -105.1786, 39.742476, 1830.14)
    assert azimuth == pytest.approx(194.34024, abs=2e-3)
    assert elevation == pytest.approx(90 - 50.11162, abs=5e-3)


@pytest.mark.parametrize(
    ("time", "lon", "lat", "height", "azimuth", "elevation"),
    [
        ("1972-03-20T12:00:00", 0, 0, 0, 90.1697, 88.1287),
        ("1985-12-21T23:59:59", 180, -45.5, 0, 359.0159, 67.9465),
        ("1999-12-31T23:59:59", -70.4, -24.6, 2635, 241.1373, -6.1403),
        ("2000-02-29T06:30:00", 77.1, 28.6, 216, 165.9870, 52.6654),
        ("2003-06-21T00:00:00", 10, 90, 0, 9.6102, 23.4739),
        ("2003-12-21T00:00:00", 10, 90, 0, 10.5902, -23.4360),
        ("2008-12-21T13:17:00", -110, -90, 2835, 90.3235, 23.4647),
        ("2011-08-28T18:45:12.5", -157.8, 21.3, 5000, 92.7875, 34.3194),
        ("2014-10-18T15:55:30", -81.66, 30.35, -20, 152.4328, 45.9283),
        ("2016-07-01T23:10:00", 18.95, 69.65, 10, 5.0155, 2.9869),
        ("2017-01-05T06:00:00", 25.6, -33.96, 60, 97.2197, 31.9665),
        ("2019-09-23T07:50:00", 15, 46, 300, 125.1381, 29.0923),
        ("2020-06-20T21:30:00", 100, -0.02, 0, 63.8709, -25.4753),
        ("2024-02-29T10:05:00", 359.5, 51.48, 45, 144.3173, 24.6475),
        ("2026-04-08T17:00:00", -360, -78, 100, 286.6010, -4.0693),
        ("2035-05-17T03:21:09", 139.7, 35.7, 40, 213.1380, 70.9829),
        ("2049-11-02T20:00:00", -122.4, 37.8, -400, 182.0740, 37.1241),
    ],
)
def test_sun_agrees_with_another_library_at_all_places_and_times(
    time: str, lon: float, lat: float, height: float, azimuth: float, elevation: float
) -> None:
    """Values of pvlib 0.16 (nrel_numpy), which follows Reda and Andreas 2004 to the letter."""
    found = sun_position(datetime.fromisoformat(time), lon, lat, height)
    apart = np.degrees(np.linalg.norm(direction(*found) - direction(azimuth, elevation)))
    assert apart < 3e-4
    assert 0.0 <= found[0] < 360.0
    assert found[1] == pytest.approx(elevation, abs=3e-4)


def test_a_time_without_zone_is_utc() -> None:
    aware = sun_position(datetime(2015, 5, 2, 16, 19, 43, tzinfo=timezone.utc), -81.66, 30.35)  # noqa: UP017
    assert sun_position(datetime(2015, 5, 2, 16, 19, 43), -81.66, 30.35) == aware


def test_a_place_off_the_earth_is_refused() -> None:
    with pytest.raises(InputError, match="latitude 95"):
        sun_position(datetime(2020, 1, 1), 0.0, 95.0)


def test_sun_agrees_with_the_metadata_of_all_views(data_dir: Any) -> None:
    files = sorted((data_dir / "dfc2019/rpc_raw/JAX_068").glob("*.json"))
    assert len(files) == 17
    for path in files:
        meta = json.loads(path.read_text())
        time = datetime.strptime(meta["acquisition_date"], "%Y%m%d%H%M%S")
        azimuth, elevation = sun_position(time, *meta["geojson"]["center"])
        told = direction(float(meta["sun_azimuth"]), float(meta["sun_elevation"]))
        apart = np.degrees(np.arccos(np.clip(told @ direction(azimuth, elevation), -1, 1)))
        # The vendor's angles are those of the centre of its whole strip, some 10 km away, and rounded to 0.1 degrees.
        assert apart < 0.25
        assert abs(elevation - float(meta["sun_elevation"])) < 0.25


def test_crop_window_holds_the_area_at_all_heights() -> None:
    rpc = parallel_rpc(run=(0.5, 0.0), gsd=0.5, size=(1001, 1001))
    window = crop_window(rpc, UTM33, (X - 10, Y - 20, X + 10, Y + 20), (ALT0 - 10, ALT0 + 30), (1001, 1001), 4)
    # east -10 at +30 m: col 500 + (-10 - 15) / 0.5 = 450; east +10 at -10 m: 500 + (10 + 5) / 0.5 = 530; UTM: 0.04 %
    assert window == (445, 455, 91, 91)


def test_crop_window_of_an_area_elsewhere_is_empty() -> None:
    window = crop_window(parallel_rpc(), UTM33, (X + 5000, Y, X + 5100, Y + 100), (0.0, 100.0), (240, 260), 4)
    assert window[2] == 0

"""The simulated camera and the RPC that stands for it."""

from typing import Any

import numpy as np
import pytest

from sattools.camera.ground import azimuth_elevation, direction, project, to_geographic, view_direction
from sattools.simulate.camera import Pushbroom, fit_rpc

TARGET = np.array([436_600.0, 3_357_750.0, -5.0])
CRS = "EPSG:32617"


@pytest.fixture(params=[(0.0, 90.0), (40.0, 65.0), (250.0, 60.0)])
def camera(request: pytest.FixtureRequest) -> Any:
    return Pushbroom.towards(TARGET, direction(*request.param), 0.5, (301, 281), yaw_deg=6.0)


def test_the_middle_pixel_sees_the_target(camera: Any) -> None:
    assert camera.project(TARGET) == pytest.approx((140.0, 150.0), abs=1e-6)


def test_columns_run_east_and_rows_south() -> None:
    camera = Pushbroom.towards(TARGET, direction(0.0, 90.0), 0.5, (101, 101))
    assert camera.project(TARGET + np.array([10, 0, 0])) == pytest.approx((70.0, 50.0), abs=1e-4)
    assert camera.project(TARGET + np.array([0, 10, 0])) == pytest.approx((50.0, 30.0), abs=1e-4)


def test_a_point_along_the_line_of_sight_stays_in_its_pixel(camera: Any) -> None:
    assert camera.project(TARGET - 40 * camera.look) == pytest.approx((140.0, 150.0), abs=1e-6)


def test_rays_of_the_tracer_project_into_the_pixels_they_came_from(camera: Any) -> None:
    for col, row, distance in ((0.0, 0.0, 700e3), (280.0, 300.0, 690e3), (33.3, 250.5, 710e3)):
        start = camera.origin + (row - camera.row0) * camera.velocity
        point = start + distance * (camera.look + (col - camera.col0) / camera.focal * camera.across)
        assert camera.project(point) == pytest.approx((col, row), abs=1e-6)


def test_rpc_reprojects_points_of_the_scene_to_a_thousandth_of_a_pixel(camera: Any) -> None:
    rpc, error = fit_rpc(camera, CRS, tuple(TARGET))
    assert error < 1e-3
    points = TARGET + np.random.default_rng(0).uniform((-100, -100, -30), (100, 100, 60), (500, 3))
    col, row = project(rpc, CRS, *points.T)
    expected = camera.project(points)
    assert np.hypot(col - expected[0], row - expected[1]).max() < 1e-3


def test_rpc_looks_where_the_camera_was_asked_to() -> None:
    camera = Pushbroom.towards(TARGET, direction(40.0, 65.0), 0.5, (301, 281))
    rpc, _ = fit_rpc(camera, CRS, tuple(TARGET))
    lon, lat = to_geographic(CRS, *TARGET[:2])
    azimuth, elevation = azimuth_elevation(view_direction(rpc, float(lon), float(lat), -5.0))
    # grid north differs from true north by 0.33° here, the grid's scale from 1 by 0.04 %
    assert azimuth == pytest.approx(40.0, abs=0.4)
    assert elevation == pytest.approx(65.0, abs=0.05)


def test_limits_of_the_rpc_tell_nothing_about_the_heights_of_the_scene(camera: Any) -> None:
    rpc, _ = fit_rpc(camera, CRS, tuple(TARGET))
    assert rpc.altitude_range == (-505.0, 495.0)

"""Pixels of a view on the ground: as the camera says, though it is asked at a few of them only."""

import numpy as np
import pytest
from synthetic_views import ALT0, LAT0, LON0, parallel_rpc

from sattools.camera.ground import from_geographic, utm_crs
from sattools.export import pictures
from sattools.scene import Grid


@pytest.mark.parametrize("shape", [(3, 203, 150), (3, 17, 2), (1, 1, 1), (1, 5, 40)])
def test_pixels_between_those_asked_lie_where_the_camera_sees_them(shape: tuple[int, int, int]) -> None:
    rpc = parallel_rpc((0.3, -0.2))
    crs = utm_crs(LON0, LAT0)
    east, north = (float(v) for v in from_geographic(crs, LON0, LAT0))
    grid = Grid(crs, east - 100, north + 100, 0.5, 400, 400)
    at_col, at_row = pictures.pixels_on(rpc, shape, grid, ALT0)
    assert at_col.shape == at_row.shape == shape[1:]
    row, col = np.mgrid[: shape[1], : shape[2]]
    lon, lat = rpc.localization(col.ravel().astype(float), row.ravel().astype(float), np.full(col.size, ALT0))
    x, y = (np.asarray(v).reshape(col.shape) for v in from_geographic(crs, lon, lat))
    assert np.abs(at_col - ((x - grid.left) / 0.5 - 0.5)).max() < 0.01
    assert np.abs(at_row - ((grid.top - y) / 0.5 - 0.5)).max() < 0.01

"""Pixels of a grid's cells agree with the RPC itself."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sattools.camera.cells import project_cells, project_plane
from sattools.camera.ground import from_geographic, project, to_geographic, utm_crs
from sattools.camera.rpc import RPC
from sattools.scene import Grid


@pytest.mark.parametrize("relief", [3.0, 120.0, 2500.0])
@pytest.mark.parametrize("shape", [(7, 5), (64, 32), (333, 517)])
def test_between_the_nodes_pixels_are_those_of_a_real_camera(
    data_dir: Path, relief: float, shape: tuple[int, int]
) -> None:
    path = data_dir / "rpc_formats/rpc_PLEIADES.xml"
    rpc: Any = RPC.from_file(path)
    crs = utm_crs(rpc.lon_offset, rpc.lat_offset)
    x, y = from_geographic(crs, rpc.lon_offset + 0.01, rpc.lat_offset - 0.02)
    grid = Grid(crs, float(x), float(y), 0.5, shape[1], shape[0])
    rng = np.random.default_rng(1)
    height = (rpc.alt_offset + relief * rng.uniform(-0.5, 0.5, shape)).astype(np.float32)
    lon, lat = to_geographic(crs, *np.meshgrid(grid.x(), grid.y()))
    expected = rpc.projection(lon, lat, height.astype(np.float64))
    for found, exact in zip(project_cells(rpc, grid, height), expected, strict=True):
        # a pixel is looked up by rounding: a hundredth moves one lookup in fifty across a border, none by more
        np.testing.assert_allclose(found, exact, rtol=0, atol=0.01)


def test_level_ground_needs_no_range_of_heights(data_dir: Path) -> None:
    path = data_dir / "rpc_formats/rpc_PLEIADES.xml"
    rpc: Any = RPC.from_file(path)
    crs = utm_crs(rpc.lon_offset, rpc.lat_offset)
    x, y = from_geographic(crs, rpc.lon_offset, rpc.lat_offset)
    grid = Grid(crs, float(x), float(y), 2.0, 40, 40)
    col, row = project_cells(rpc, grid, np.full((40, 40), rpc.alt_offset, np.float32))
    assert np.isfinite(col).all()
    assert np.isfinite(row).all()


@pytest.mark.parametrize(("cell", "off"), [(0.5, 2e-4), (2.0, 3e-3)])
@pytest.mark.parametrize("shape", [(1, 1), (33, 640)])
def test_a_level_plane_is_seen_where_the_camera_sees_each_of_its_cells(
    data_dir: Path, shape: tuple[int, int], cell: float, off: float
) -> None:
    rpc: Any = RPC.from_file(data_dir / "rpc_formats/rpc_PLEIADES.xml")
    crs = utm_crs(rpc.lon_offset, rpc.lat_offset)
    x, y = from_geographic(crs, rpc.lon_offset + 0.01, rpc.lat_offset - 0.02)
    grid = Grid(crs, float(x), float(y), cell, shape[1], shape[0])
    expected = project(rpc, crs, *np.meshgrid(grid.x(), grid.y()), rpc.alt_offset + 70.0)
    for found, exact in zip(project_plane(rpc, grid, rpc.alt_offset + 70.0), expected, strict=True):
        np.testing.assert_allclose(found, exact, rtol=0, atol=off)

"""What `align` is given to move a scene onto: rasters of heights as others deliver them, and nothing else."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from align_ground import CRS, GRID
from rasterio.warp import transform

from sattools.align.options import AlignOptions
from sattools.align.reference import check_reference, heights_around
from sattools.align.stage import align
from sattools.errors import InputError
from sattools.scene import Scene
from sattools.scene.grid import Grid
from sattools.scene.raster import write_cog
from sattools.scene.regrid import reproject_map


def test_a_class_map_is_no_reference(tmp_path: Path) -> None:
    """As `compare --dsm` says it: a surface was moved onto the codes of ground, trees and buildings."""
    codes = np.full(GRID.shape, 2, np.uint8)
    codes[:100, :100], codes[200:, :100] = 5, 6
    write_cog(tmp_path / "classes.tif", codes, GRID, nodata=None)
    with pytest.raises(InputError, match=r"classes.tif: found class codes \(2, 5, 6\), expected heights \[m\]"):
        check_reference(tmp_path / "classes.tif", CRS)


@pytest.mark.parametrize(
    ("left", "width"), [(-82.0, 80), (278.0, 80), (0.0, 36000), (-180.0, 36000)], ids=["part", "part-360", "360", "180"]
)
def test_longitudes_may_run_from_0_to_360(tmp_path: Path, left: float, width: int) -> None:
    """Heights that rise by 1 m every 0.01 degrees to the east from 82 degrees west, where the ground is at 81.664."""
    lon = left + 0.01 * (np.arange(width) + 0.5)
    heights = np.tile(100 * ((lon + 82.0) % 360.0), (80, 1)).astype(np.float32)
    write_cog(tmp_path / "degrees.tif", heights, Grid("EPSG:4326", left, 30.8, 0.01, width, 80))
    found, around = heights_around(tmp_path / "degrees.tif", GRID, 20.0)
    assert around.crs == CRS
    assert np.isfinite(found).all()
    assert float(found.mean()) == pytest.approx(33.6, abs=0.6)  # of cells of a kilometre


@pytest.mark.parametrize(
    ("turn", "to"),
    [
        (lambda a: np.rot90(a), lambda n, m: Affine(0, -1, n, 1, 0, 0)),
        (lambda a: a[::-1, ::-1], lambda n, m: Affine(-1, 0, n, 0, -1, m)),
        (lambda a: a[:, ::-1], lambda n, m: Affine(-1, 0, n, 0, 1, 0)),
    ],
    ids=["quarter", "half", "mirrored"],
)
def test_turned_rasters_are_taken_as_they_lie(tmp_path: Path, turn: Any, to: Any) -> None:
    """One turned by a quarter had cells without a size."""
    heights = np.random.default_rng(0).uniform(0.0, 40.0, GRID.shape).astype(np.float32)
    stored = np.ascontiguousarray(turn(heights))
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "crs": CRS}
    place = GRID.transform @ to(GRID.width, GRID.height)
    rows, columns = stored.shape
    with rasterio.open(tmp_path / "t.tif", "w", width=columns, height=rows, transform=place, **profile) as file:
        file.write(stored, 1)
    found, around = heights_around(tmp_path / "t.tif", GRID, 0.0)
    assert around.cell_size == pytest.approx(GRID.cell_size)
    there = reproject_map(found, around, GRID)
    known = np.isfinite(there)
    assert known.mean() > 0.9
    np.testing.assert_allclose(there[known], heights[known], atol=0.05)


def save(path: Path, heights: np.ndarray, crs: str, place: Affine) -> Path:
    about = {"driver": "GTiff", "count": 1, "dtype": "float32", "crs": crs, "transform": place}
    with rasterio.open(path, "w", height=heights.shape[0], width=heights.shape[1], **about) as file:
        file.write(heights.astype(np.float32), 1)
    return path


def test_rasters_that_are_stored_from_south_to_north_keep_their_cells(tmp_path: Path) -> None:
    """They were interpolated onto other cells, which blurs walls."""
    heights = np.random.default_rng(0).uniform(0.0, 40.0, GRID.shape)
    west, south, _, _ = GRID.moved(0.3, 0.2).bounds
    cell = GRID.cell_size
    path = save(tmp_path / "up.tif", heights[::-1], CRS, Affine(cell, 0, west, 0, cell, south))
    found, around = heights_around(path, GRID, 0.0)
    np.testing.assert_allclose(reproject_map(found, around, GRID.moved(0.3, 0.2)), heights, rtol=1e-6)
    assert around.left == pytest.approx(west - 4 * cell)


def test_numbers_for_no_data_that_a_file_does_not_declare_touch_no_cell_beside_them(tmp_path: Path) -> None:
    """They were interpolated as heights: cells beside a hole of -9999 lay 0 to 1000 m deep."""
    heights = np.full((400, 400), 20.0)
    heights[150:250, 150:250] = -9999.0
    (lon,), (lat,) = transform(CRS, "EPSG:4326", [GRID.middle[0]], [GRID.middle[1]])
    place = Affine(1e-5, 0, lon - 2e-3, 0, -1e-5, lat + 2e-3)
    found, _ = heights_around(save(tmp_path / "degrees.tif", heights, "EPSG:4326", place), GRID, 0.0)
    assert np.isnan(found).any()
    assert np.nanmin(found) == pytest.approx(20.0)


def test_a_wall_of_a_raster_that_is_turned_is_not_wider_for_that(tmp_path: Path) -> None:
    """GDAL takes the box of turned cells for their size: it was nearly twice as wide."""
    heights = np.where(np.arange(800) < 400, 0.0, 10.0) * np.ones((800, 1))
    place = Affine.translation(*GRID.middle) @ Affine.rotation(30) @ Affine.scale(GRID.cell_size, -GRID.cell_size)
    path = save(tmp_path / "turned.tif", heights, CRS, place @ Affine.translation(-400, -400))
    found, _ = heights_around(path, GRID, 0.0)
    known = np.isfinite(found).all(axis=1)
    between = ((found > 0.5) & (found < 9.5)).sum(axis=1)[known]
    assert between.mean() < 1.2


def test_what_is_wrong_with_a_reference_names_its_file_once(tmp_path: Path) -> None:
    """It was `FILE: reference: found ...`, and of control points no file at all."""
    scene = Scene("PLACE", tmp_path, grid=GRID, products={"dsm": "dsm.tif"})
    heights = np.random.default_rng(0).uniform(0.0, 40.0, GRID.shape).astype(np.float32)
    write_cog(scene.output("dsm.tif"), heights, GRID)
    write_cog(tmp_path / "dem.tif", heights, GRID)
    with pytest.raises(InputError) as refused:
        align(scene, AlignOptions(to=str(tmp_path / "dem.tif"), method="means"))
    cells = f"found cells of {GRID.cell_size:g} m, expected {2 * GRID.cell_size:g} m or more for --method means"
    assert str(refused.value) == f"{tmp_path / 'dem.tif'}: {cells}; icp is for smaller ones"
    (tmp_path / "points.csv").write_text("name,x,y,z,item,column,row\ncorner,436001,3355002,3,NOBODY,4,5\n")
    with pytest.raises(InputError) as refused:
        align(scene, AlignOptions(to=str(tmp_path / "points.csv")))
    said = f"{tmp_path / 'points.csv'}: control point: found image 'NOBODY', expected one of "
    assert str(refused.value) == said

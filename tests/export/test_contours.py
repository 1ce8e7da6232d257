"""Contours: lines of equal height where the surface has that height, and none where it has none."""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
from shapely.geometry import box

from sattools.errors import InputError
from sattools.export.options import ExportOptions
from sattools.export.products.contours import contour_lines, write_contours
from sattools.export.products.maps import Maps
from sattools.progress import silent
from sattools.scene import Grid
from sattools.scene.raster import write_cog

GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 0.5, 120, 100)
MIDDLE = (436030.0, 3357975.0)


def cone(hole: bool = False, noise: float = 0.0) -> np.ndarray:
    """A hill: 20 m high, falling 0.5 m a metre all around."""
    x, y = np.meshgrid(GRID.x() - MIDDLE[0], GRID.y() - MIDDLE[1])
    height = 20.0 - 0.5 * np.hypot(x, y) + noise * np.random.default_rng(0).standard_normal(GRID.shape)
    if hole:
        height[30:40, 20:50] = np.nan
    return height.astype(np.float32)


def lines_of(maps: Maps, interval: float) -> geopandas.GeoDataFrame:
    lines = contour_lines(maps, interval, silent)
    return geopandas.GeoDataFrame(dict(lines.columns), geometry=list(lines.geometries), crs=lines.crs)


def maps_of(folder: Path, height: np.ndarray) -> Maps:
    write_cog(folder / "dsm.tif", height, GRID)
    return Maps.of({"dsm": folder / "dsm.tif"})


def test_every_line_lies_where_the_hill_has_its_height(tmp_path: Path) -> None:
    frame = lines_of(maps_of(tmp_path, cone()), 1.0)
    assert frame.crs.to_epsg() == 32617
    # the hill's foot in the corners is 0.5 m high; the smoothed summit (19.5 m) has no line of 20 m
    assert sorted(set(frame.height)) == [float(h) for h in range(1, 20)]
    for height, line in zip(frame.height, frame.geometry):
        if height < 18:  # the tip is rounded off
            radius = np.hypot(*(np.asarray(line.coords) - MIDDLE).T)
            assert np.abs(radius - (20.0 - height) / 0.5).max() < 0.25, height  # half a cell
    assert frame[frame.major].height.unique().tolist() == [5.0, 10.0, 15.0]
    rings = frame[(frame.height > 8) & (frame.height < 19)]
    assert len(rings) == 10
    assert rings.geometry.is_ring.all()


def test_no_line_crosses_cells_without_a_height(tmp_path: Path) -> None:
    frame = lines_of(maps_of(tmp_path, cone(hole=True)), 0.5)
    # the cells' centres are the last that have a height
    hole = box(436010.0, 3357980.0, 436025.0, 3357985.0)
    assert len(frame) > 20
    assert not frame.geometry.intersects(hole.buffer(0.2)).any()
    assert frame.geometry.intersects(hole.buffer(0.6)).any()


def test_lines_of_noisy_heights_are_smooth(tmp_path: Path) -> None:
    """Noise of 0.05 m is 0.1 m on the ground here; without smoothing lines would be a third longer than circles."""
    frame = lines_of(maps_of(tmp_path, cone(noise=0.05)), 2.0)
    ring = frame[frame.height == 10.0].geometry
    assert len(ring) == 1
    assert ring.iloc[0].length == pytest.approx(2 * np.pi * 20.0, rel=0.03)


def test_blocks_leave_no_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = maps_of(tmp_path, cone(noise=0.05))
    whole = lines_of(maps, 1.0)
    blocks = Maps.blocks
    monkeypatch.setattr(Maps, "blocks", lambda self, size=32: blocks(self, 32))
    pieces = lines_of(maps, 1.0)
    assert len(pieces) == len(whole)
    assert sorted(pieces.height) == sorted(whole.height)
    assert pieces.geometry.length.sum() == pytest.approx(whole.geometry.length.sum(), rel=1e-3)


def test_the_file_is_a_geopackage_with_heights(tmp_path: Path) -> None:
    count = write_contours(tmp_path / "contours.gpkg", maps_of(tmp_path, cone()), 5.0, silent)
    frame = geopandas.read_file(tmp_path / "contours.gpkg", layer="contours")
    assert len(frame) == count
    assert set(frame.height) == {5.0, 10.0, 15.0}


def test_the_layer_says_what_its_heights_are_above(tmp_path: Path) -> None:
    """Its CRS does not, and metres above the ellipsoid and above a geoid are tens of metres apart."""
    write_contours(tmp_path / "contours.gpkg", maps_of(tmp_path, cone()), 5.0, silent, "EGM96 geoid")
    with closing(sqlite3.connect(tmp_path / "contours.gpkg")) as layers:
        said = layers.execute("select table_name, description from gpkg_contents").fetchall()
    assert said == [("contours", "heights [m] above the EGM96 geoid")]


def test_a_flat_surface_between_two_levels_has_an_empty_layer(tmp_path: Path) -> None:
    maps = maps_of(tmp_path, np.full(GRID.shape, 0.5, np.float32))
    assert write_contours(tmp_path / "contours.gpkg", maps, 1.0, silent) == 0
    assert len(geopandas.read_file(tmp_path / "contours.gpkg")) == 0


def test_levels_without_number_are_refused(tmp_path: Path) -> None:
    height = cone()
    height[0, :40] = 5000.0
    with pytest.raises(InputError, match=r"--contours: found \d+ levels of 0\.05 m"):
        contour_lines(maps_of(tmp_path, height), 0.05, silent)


def test_an_interval_asks_for_contours() -> None:
    options: Any = ExportOptions(contours=2.0)
    assert options.wanted == ["contours"]
    assert ExportOptions(products=["contours"]).wanted == ["contours"]


def test_heights_are_written_as_people_write_them(tmp_path: Path) -> None:
    """82 times 0.3 is 24.599999999999998 in binary numbers: a label, and a filter, would have it so."""
    found = set(lines_of(maps_of(tmp_path, cone() + np.float32(20.0)), 0.3).height)
    assert {24.6, 24.9, 25.2} <= found
    assert 24.599999999999998 not in found

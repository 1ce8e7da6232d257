"""The bare ground under trees and buildings."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from sattools.export import blocks as cutting
from sattools.export.ground import bare_ground, interpolated, typical_slope
from sattools.export.products.maps import Maps
from sattools.export.products.terrain import write_terrain
from sattools.progress import silent
from sattools.scene import Grid
from sattools.scene.raster import write_cog

CELL = 0.5


def plane(shape: tuple[int, int] = (200, 240), east: float = 0.03, south: float = -0.01) -> np.ndarray:
    """Ground [m] that climbs to the east and to the north."""
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return (10.0 + CELL * (east * cols + south * rows)).astype(np.float32)


def town() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A surface, its ground and what stands on it: a house, a hall, a tree; a car is narrower than a house."""
    ground = plane()
    surface, objects = ground.copy(), np.zeros(ground.shape, bool)
    boxes = ((20, 45, 30, 60, 6.0), (70, 150, 90, 190, 9.0), (160, 166, 40, 46, 4.0), (100, 104, 30, 38, 1.5))
    for top, bottom, left, right, height in boxes:
        rows, cols = slice(top, bottom), slice(left, right)
        surface[rows, cols] = ground[rows, cols].max() + height
        objects[rows, cols] = True
    return surface, ground, objects


def test_what_stands_on_the_ground_is_taken_away() -> None:
    surface, ground, objects = town()
    found = bare_ground(surface, np.ones_like(objects), CELL, 50.0)
    assert not found.seen[objects].any()
    assert found.seen[~objects].mean() > 0.9  # all but a metre beside them
    assert np.abs(found.height - ground).max() < 0.05
    assert np.array_equal(found.height[found.seen], surface[found.seen])


def test_what_is_wider_than_asked_for_is_ground() -> None:
    surface, ground, _ = town()
    found = bare_ground(surface, np.ones(surface.shape, bool), CELL, 30.0)
    hall = found.height[110, 140] - ground[110, 140]
    assert hall > 8.0  # 40 m x 50 m
    assert np.abs(found.height - ground)[:60].max() < 0.2  # the house is 12 m wide


def test_what_leans_on_a_wide_building_is_not_left_over() -> None:
    surface, ground, _ = town()
    surface[150:156, 120:150] = ground[150:156, 120:150] + 3.0  # in the first round the hall's shadow
    found = bare_ground(surface, np.ones(surface.shape, bool), CELL, 50.0)
    assert np.abs(found.height - ground).max() < 0.2


def test_errors_of_matching_are_no_ground() -> None:
    surface, ground, _ = town()
    trusted = np.ones(surface.shape, bool)
    surface[60:64, 20:26] -= 8.0  # a pit
    surface[180:190, 100:120] -= 5.0  # a larger one, not trusted
    trusted[180:190, 100:120] = False
    found = bare_ground(surface, trusted, CELL, 50.0)
    assert np.abs(found.height - ground).max() < 0.2
    assert not found.seen[60:64, 20:26].any()
    assert not found.seen[180:190, 100:120].any()


def test_hills_stay() -> None:
    """A range of hills of 25 degrees, 60 m from crest to crest: far narrower than the widest building."""
    cols = np.mgrid[:200, :240][1]
    hills = (60.0 / 2 / np.pi * 0.466 * np.sin(cols * 2 * np.pi / 60.0)).astype(np.float32)
    slope = typical_slope(hills, 1.0)
    assert 0.15 < slope.min() < slope.max() < 0.47
    found = bare_ground(hills, np.ones(hills.shape, bool), 1.0, 100.0)
    assert found.seen.mean() > 0.97
    assert np.abs(found.height - hills).max() < 1.0


def test_nothing_known_and_nothing_trusted() -> None:
    surface = np.full((20, 30), np.nan, np.float32)
    nothing = bare_ground(surface, np.ones(surface.shape, bool), CELL, 50.0)
    assert np.isnan(nothing.height).all()
    assert not nothing.seen.any()
    known = bare_ground(plane((20, 30)), np.zeros((20, 30), bool), CELL, 50.0)
    assert known.seen.all()  # better than none


def test_holes_are_closed_by_a_membrane() -> None:
    ground = plane((65, 90))
    known = np.ones(ground.shape, bool)
    known[10:50, 20:70] = False
    found = interpolated(np.where(known, ground, np.nan).astype(np.float32), known)
    assert np.abs(found - ground).max() < 0.02  # a plane is its own membrane
    assert np.array_equal(found[known], ground[known])


def maps_of(folder: Path, surface: np.ndarray, validity: np.ndarray) -> Maps:
    grid = Grid("EPSG:32617", 436000.0, 3358000.0, CELL, surface.shape[1], surface.shape[0])
    write_cog(folder / "dsm.tif", surface, grid)
    write_cog(folder / "validity.tif", validity.astype(np.uint8), grid, nodata=None)
    return Maps.of({"dsm": folder / "dsm.tif", "validity": folder / "validity.tif"})


def test_files_say_where_the_ground_was_seen(tmp_path: Path) -> None:
    surface, ground, objects = town()
    surface[:10] = np.nan
    validity = np.ones(surface.shape, np.uint8)
    validity[:10], validity[:, -12:], validity[190:, :20] = 0, 3, 2
    surface[:, -12:] = np.nan
    files = {name: tmp_path / f"{name}_made.tif" for name in ("dtm", "dtm_validity", "ndsm")}
    notes = write_terrain(files, maps_of(tmp_path, surface, validity), 50.0, (None, "WGS84 ellipsoid"), silent)
    read: dict[str, Any] = {}
    for name, path in files.items():
        with rasterio.open(path) as data:
            read[name] = data.read(1)
            assert data.crs.to_epsg() == 32617
            if name == "dtm":
                assert data.tags()["VERTICAL_DATUM"] == "WGS84 ellipsoid"
                assert data.units == ("m",)
    known = np.isfinite(surface)
    assert np.array_equal(np.isfinite(read["dtm"]), known)
    assert np.abs(read["dtm"] - ground)[known].max() < 0.2
    assert read["ndsm"][30, 40] == pytest.approx(6.0, abs=0.5)  # a level roof over a slope
    assert set(np.unique(read["dtm_validity"][:, -12:])) == {3}
    assert set(np.unique(read["dtm_validity"][:10, :-12])) == {0}
    assert set(np.unique(read["dtm_validity"][190:, :20])) == {2}
    assert set(np.unique(read["dtm_validity"][objects])) == {2}
    assert read["dtm_validity"][60, 20] == 1
    assert notes["seen"] + notes["interpolated"] == pytest.approx(1.0)
    assert 0.6 < notes["seen"] < 0.8


def test_blocks_of_the_ground_leave_no_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    surface = plane((150, 260), 0.02, 0.03)
    for row in range(10, 140, 40):
        surface[row : row + 16, 20:250:30] += 5.0
        for col in range(10, 250, 40):
            surface[row : row + 16, col : col + 20] += 4.0
    maps = maps_of(tmp_path, surface, np.ones(surface.shape))
    made = []
    for edge in (1000, 128):
        monkeypatch.setattr(cutting, "EDGE", edge)
        monkeypatch.setattr(cutting, "AT_ONCE", 100)
        files = {name: tmp_path / f"{name}_{edge}.tif" for name in ("dtm", "dtm_validity", "ndsm")}
        write_terrain(files, maps, 15.0, (None, "WGS84 ellipsoid"), silent)
        with rasterio.open(files["dtm"]) as data, rasterio.open(files["dtm_validity"]) as seen:
            made.append((data.read(1), seen.read(1)))
    (whole, valid), (cut, same) = made
    assert (valid != same).mean() < 0.002
    assert np.abs(whole - cut).max() < 0.2

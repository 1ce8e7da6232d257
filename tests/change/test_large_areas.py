"""Changes of areas that do not fit into memory are those that are found at once."""

import json
import math
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.ndimage import binary_opening, gaussian_filter
from shapely.geometry import box

from sattools.change.detect import HeightChange, cell_sigma, find_regions, opening
from sattools.change.options import ChangeOptions
from sattools.cli import main
from sattools.scene import Grid, stored
from sattools.scene.raster import read_raster, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3355220.0, 1.0, 200, 220)


@pytest.fixture
def tiny_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps of 20 kB go to files, in pieces of seven rows and blocks of 64 cells."""
    for name, value in {"HELD": 20_000, "PIECE_CELLS": 1_400, "AT_ONCE": 3_000, "EDGE": 64}.items():
        monkeypatch.setattr(stored, name, value)


def changed(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Two dates: boxes that rise and sink, one of them a ring that meets itself again, on noise."""
    rng = np.random.default_rng(seed)
    base = np.cumsum(rng.normal(0, 0.05, GRID.shape), axis=1).astype(np.float32)
    for _ in range(30):
        row, col = rng.integers(0, 190, 2)
        base[row : row + 15, col : col + 12] += rng.uniform(4, 9)
    late = base + gaussian_filter(rng.normal(0, 1.0, GRID.shape), 1.5).astype(np.float32)
    for _ in range(25):
        row, col = rng.integers(0, 180, 2)
        late[row : row + rng.integers(6, 25), col : col + rng.integers(6, 25)] += rng.choice([-6.0, 7.0])
    ring = np.zeros(GRID.shape, bool)
    ring[100:150, 20:90], ring[110:140, 30:80] = True, False
    late[ring] += 9.0
    base[60:90, 150:190] = np.nan
    return base, late.astype(np.float32)


def test_regions_in_strips_are_those_of_the_whole(request: pytest.FixtureRequest) -> None:
    before, after = changed()
    confidence = np.random.default_rng(3).uniform(0.1, 0.9, GRID.shape).astype(np.float32)

    def found() -> Any:
        difference = after - before
        heights = HeightChange(difference, cell_sigma(difference, None), 1.0, 5.0, confidence)
        return find_regions(heights, ChangeOptions())

    labels, regions = found()
    request.getfixturevalue("tiny_pieces")
    labels_in_strips, regions_in_strips = found()
    assert len(regions) > 10
    np.testing.assert_array_equal(labels_in_strips, labels)
    assert [r.box for r in regions_in_strips] == [r.box for r in regions]
    for one, other in zip(regions, regions_in_strips, strict=True):
        assert (other.label, other.area_m2) == (one.label, one.area_m2)
        assert other.volume_m3 == pytest.approx(one.volume_m3)
        assert other.p_value == pytest.approx(one.p_value, rel=1e-6)
        rows, cols = np.nonzero(labels == one.label)
        assert one.box == (rows.min(), rows.max() + 1, cols.min(), cols.max() + 1)
        assert one.mean_m == pytest.approx(float((after - before)[rows, cols].mean()), rel=1e-5)


def test_the_command_gives_the_same_table_and_maps_in_pieces(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    before, after = changed()
    write_cog(tmp_path / "before.tif", before, GRID, units="m")
    write_cog(tmp_path / "after.tif", np.roll(after, (2, -3), (0, 1)) + 1.5, GRID, units="m")
    west, north = GRID.left, GRID.top
    places = [box(west + 20, north - 150, west + 90, north - 100), box(west - 900, north, west - 800, north + 50)]
    geopandas.GeoDataFrame(geometry=places, crs=GRID.crs).to_file(tmp_path / "places.gpkg")

    def run(name: str) -> dict[str, Any]:
        arguments = ["change", tmp_path / "before.tif", tmp_path / "after.tif", "--out", tmp_path / name]
        result = CliRunner().invoke(main, [*map(str, arguments), "--polygons", str(tmp_path / "places.gpkg")])
        assert result.exit_code == 0, result.output
        found: dict[str, Any] = json.loads((tmp_path / name / "change.json").read_text())
        return found

    whole = run("whole")
    request.getfixturevalue("tiny_pieces")
    in_pieces = run("pieces")
    assert in_pieces == whole
    assert whole["shift_m"][:2] == [3.0, 2.0]
    assert len(whole["regions"]) > 10
    assert whole["polygons"][0]["volume_m3"] > 9 * 1000
    assert whole["polygons"][1]["mean_m"] is None  # elsewhere
    for name in ("height_change.tif", "significance.tif"):
        one, other = (read_raster(tmp_path / folder / name)[0] for folder in ("whole", "pieces"))
        np.testing.assert_allclose(one, other, atol=1e-5)
    shapes = [geopandas.read_file(tmp_path / folder / "changes.gpkg") for folder in ("whole", "pieces")]
    assert shapes[0].geometry.geom_equals(shapes[1].geometry).all()
    assert shapes[0].area.sum() == pytest.approx(sum(region["area_m2"] for region in whole["regions"]), rel=0.01)


@pytest.mark.parametrize("radius", [0.3, 1.0, 1.5, 2.0, 3.7])
def test_an_opening_by_distances_is_that_by_a_disk(radius: float) -> None:
    rng = np.random.default_rng(7)
    cells = gaussian_filter(rng.normal(size=(80, 90)), 2.0) > -0.05
    reach = math.floor(radius)
    rows, cols = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disk = np.hypot(rows, cols) <= max(radius, 0.5)
    np.testing.assert_array_equal(opening(cells, radius), binary_opening(cells, disk))


def test_wide_rims_take_no_more_memory_than_narrow_ones() -> None:
    cells = np.zeros((700, 700), bool)
    cells[100:600, 100:600] = True
    opened = opening(cells, 200.0)  # a disk of 400 cells
    assert opened[350, 350]
    assert not opened[100, 100]  # the square's corner
    assert opened[350, 100]

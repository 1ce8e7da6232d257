"""Maps larger than memory: written block by block, looked at reduced, compared where the reference lies."""

import re
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from sattools.compare.options import CompareOptions
from sattools.compare.stage import compare_file
from sattools.errors import InputError, SattoolsError
from sattools.scene import Grid, cog, stored
from sattools.scene.cog import CogWriter
from sattools.scene.gdal import why_not_written
from sattools.scene.raster import read_overview, read_some_pixels, write_cog
from sattools.scene.sensor_files import write_sensor_blocks, write_sensor_image

GRID = Grid("EPSG:32633", 500000.0, 5000000.0, 0.5, 700, 600)


def noise(seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    coarse = rng.normal(0, 3, (30, 35)).astype(np.float32)
    return np.kron(coarse, np.ones((20, 20), np.float32)) + rng.normal(0, 0.1, GRID.shape).astype(np.float32)


def test_a_map_written_in_blocks_is_that_written_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heights = noise()
    heights[:40, :50] = np.nan
    about: dict[str, Any] = {"units": "m", "tags": {"A": "b"}, "descriptions": ["height"]}
    write_cog(tmp_path / "once.tif", heights, GRID, **about)
    monkeypatch.setattr(cog, "IN_MEMORY", 0)
    with CogWriter(tmp_path / "blocks.tif", GRID, **about) as out:
        for row in (512, 0):
            for col in (0, 512):
                rows, cols = slice(row, min(row + 512, 600)), slice(col, min(col + 512, 700))
                out.write(heights[rows, cols], rows, cols)
    read = []
    for name in ("once", "blocks"):
        with rasterio.open(tmp_path / f"{name}.tif") as data:
            assert data.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            read.append((data.read(), str(data.profile), data.tags(), data.units, data.descriptions, data.overviews(1)))
    np.testing.assert_array_equal(read[0][0], read[1][0])
    assert read[0][1:] == read[1][1:]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["blocks.tif", "once.tif"]


@pytest.mark.parametrize("kind", [np.float32, np.uint8])
def test_overviews_of_a_map_in_blocks_are_those_that_the_driver_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: Any
) -> None:
    grid = Grid("EPSG:32633", 500000.0, 5000000.0, 0.5, 1500, 1100)  # even at every level, where GDAL's two ways agree
    values = np.random.default_rng(0).integers(0, 200, grid.shape).astype(kind)
    if kind is np.float32:
        values[:300, 200:333] = np.nan
    nodata = np.nan if kind is np.float32 else None
    with CogWriter(tmp_path / "driver.tif", grid, dtype=kind, nodata=nodata) as out:
        out.write(values)
    monkeypatch.setattr(cog, "IN_MEMORY", 0)
    with CogWriter(tmp_path / "blocks.tif", grid, dtype=kind, nodata=nodata) as out:
        out.write(values)
    for level in (0, 1):
        read = []
        for name in ("driver", "blocks"):
            with rasterio.open(tmp_path / f"{name}.tif", overview_level=level) as data:
                read.append(data.read(1))
        np.testing.assert_array_equal(*read)
        assert read[0].shape == (1100 >> level + 1, 1500 >> level + 1)
    with rasterio.open(tmp_path / "blocks.tif") as data:
        assert data.overviews(1) == [2, 4]


def test_a_map_that_is_not_finished_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cog, "IN_MEMORY", 0)
    wrong = pytest.raises(SattoolsError, match=r"map\.tif: found an array of \(3, 3\), expected the grid's \(2, 2\)")
    with wrong, CogWriter(tmp_path / "map.tif", GRID) as out:
        out.write(np.zeros((3, 3)), slice(0, 2), slice(0, 2))
    assert list(tmp_path.iterdir()) == []


def test_an_overview_has_the_means_and_the_place_of_the_map(tmp_path: Path) -> None:
    write_cog(tmp_path / "map.tif", noise(), GRID)
    array, grid = read_overview(tmp_path / "map.tif", 700 * 600 // 100)
    assert grid == Grid("EPSG:32633", 500000.0, 5000000.0, 5.0, 70, 60)
    means = noise().reshape(60, 10, 70, 10).mean(axis=(1, 3))
    np.testing.assert_allclose(array[0], means, atol=1e-3)
    whole, same = read_overview(tmp_path / "map.tif", 700 * 600)
    assert same == GRID
    np.testing.assert_array_equal(whole[0], noise())


def test_classes_are_not_averaged_in_an_overview(tmp_path: Path) -> None:
    classes = np.random.default_rng(1).choice(np.array([2, 6, 9], np.uint8), GRID.shape)
    write_cog(tmp_path / "classes.tif", classes, GRID, nodata=None)
    array, _ = read_overview(tmp_path / "classes.tif", 1000)
    assert set(np.unique(array)) <= {2, 6, 9}


def test_some_pixels_are_pixels_of_the_image(tmp_path: Path) -> None:
    write_sensor_image(tmp_path / "image.tif", noise()[None])
    some = read_some_pixels(tmp_path / "image.tif", 5000)
    assert 2500 <= some.size <= 5500
    assert np.isin(some[0], noise()).all()


def test_of_a_large_surface_only_the_part_at_the_reference_is_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heights = noise()
    write_cog(tmp_path / "dsm.tif", heights, GRID, units="m")
    part = GRID.part(slice(200, 340), slice(300, 460))
    moved = heights[202:342, 301:461] + 2.0  # the surface lies 2 rows and a column further on, and 2 m lower
    write_cog(tmp_path / "truth.tif", moved, part, units="m")
    options = CompareOptions(predicted=str(tmp_path / "dsm.tif"), dsm=str(tmp_path / "truth.tif"))
    whole = compare_file(options)
    monkeypatch.setattr(stored, "AT_ONCE", 100)
    monkeypatch.setattr(stored, "HELD", 100)
    assert compare_file(options) == whole
    assert whole["shift_m"] == pytest.approx([-0.5, 1.0, 2.0], abs=0.01)
    assert whole["mae"] == pytest.approx(0.0, abs=1e-4)
    far = GRID.moved(1e5, 0.0).part(slice(0, 100), slice(0, 100))
    write_cog(tmp_path / "far.tif", heights[:100, :100], far, units="m")
    with pytest.raises(InputError, match=r"dsm\.tif: found no height where the reference far lies, expected overlap"):
        compare_file(CompareOptions(predicted=str(tmp_path / "dsm.tif"), dsm=str(tmp_path / "far.tif")))


def in_blocks(path: Path) -> None:
    with CogWriter(path, GRID) as out:
        for row in (0, 512):
            rows = slice(row, min(row + 512, 600))
            out.write(noise()[rows], rows)


def of_a_sensor(path: Path) -> None:
    image = np.random.default_rng(0).normal(size=(1, 1200, 900)).astype(np.float32)
    write_sensor_blocks(path, (1200, 900), 1, lambda rows, cols: image[:, rows, cols], rpc={})


@pytest.mark.parametrize("write", [in_blocks, of_a_sensor])
def test_a_disk_that_is_full_in_the_middle_of_a_large_file_is_told_in_its_own_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], write: Any
) -> None:
    monkeypatch.setattr(cog, "IN_MEMORY", 0)
    write(tmp_path / "map.tif")
    whole = (tmp_path / "map.tif").stat().st_size
    (tmp_path / "map.tif").unlink()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (0, 2000, whole // 2, whole - 1):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            with pytest.raises(SattoolsError, match=r"map\.tif: cannot be written \(File too large\)"):
                write(tmp_path / "map.tif")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


def test_where_gdal_gave_the_room_back_what_it_said_stands_beside_what_is_free(tmp_path: Path) -> None:
    found = why_not_written(tmp_path / "gone.tif", RuntimeError("Write error\nat scanline 0"))
    assert re.fullmatch(r"Write error at scanline 0; \d+ MiB are free now", str(found.strerror))

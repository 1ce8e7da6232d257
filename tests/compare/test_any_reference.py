"""References as others deliver them: in degrees, with oblong cells, stored from south to north."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from rasterio.enums import Resampling
from rasterio.warp import reproject, transform_bounds

from sattools.change.surfaces import read_surface
from sattools.cli import main
from sattools.compare.maps import compare_map
from sattools.compare.truth import open_reference, read_reference
from sattools.errors import InputError
from sattools.scene import Grid
from sattools.scene.raster import read_on, read_overview, read_raster, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3357800.0, 1.0, 80, 60)
SLOPE = np.add.outer(0.25 * np.arange(60), 0.5 * np.arange(80)).astype(np.float32)
CLASSES = np.repeat(np.array([[2, 6]], np.uint8), 40, axis=1).repeat(60, axis=0)


def stored(path: Path, array: np.ndarray, transform: rasterio.Affine, crs: str, **more: Any) -> Path:
    height, width = array.shape
    about: dict[str, Any] = {"width": width, "height": height, "count": 1, "dtype": array.dtype, "crs": crs, **more}
    with rasterio.open(path, "w", driver="GTiff", transform=transform, **about) as data:
        data.write(array, 1)
    return path


def south_up(path: Path, array: np.ndarray) -> Path:
    _, south, _, _ = GRID.bounds
    return stored(path, array[::-1], rasterio.Affine(1, 0, GRID.left, 0, 1, south), GRID.crs)


def in_degrees(path: Path, array: np.ndarray, oblong: float = 1.0) -> Path:
    """As `gdalwarp -t_srs EPSG:4326` makes it; with cells so many times as wide as high where asked for."""
    west, south, east, north = transform_bounds(GRID.crs, "EPSG:4326", *GRID.bounds)
    cell = 1e-5
    width, height = round((east - west) / cell / oblong), round((north - south) / cell)
    transform = rasterio.Affine(oblong * cell, 0, west, 0, -cell, north)
    nodata: float = -9999.0 if array.dtype == np.float32 else 255
    there = np.full((height, width), nodata, array.dtype)
    reproject(
        array, there, src_transform=GRID.transform, src_crs=GRID.crs, src_nodata=np.nan if nodata < 0 else 255,
        dst_transform=transform, dst_crs="EPSG:4326", dst_nodata=nodata,
        resampling=Resampling.bilinear if nodata < 0 else Resampling.nearest,
    )  # fmt: skip
    return stored(path, there, transform, "EPSG:4326", nodata=nodata)


def compared(*arguments: Any) -> Any:
    result = CliRunner().invoke(main, ["compare", *map(str, arguments)])
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def test_a_reference_stored_from_south_to_north_is_turned_over(tmp_path: Path) -> None:
    path = south_up(tmp_path / "up.tif", SLOPE)
    truth = read_reference(path, south_up(tmp_path / "classes.tif", CLASSES))
    assert truth.grid == GRID
    np.testing.assert_array_equal(truth.heights, SLOPE)
    np.testing.assert_array_equal(truth.classes, CLASSES)
    np.testing.assert_array_equal(read_surface(str(path)).height, SLOPE)  # a date of `change`
    part = GRID.part(slice(5, 9), slice(3, 10))
    np.testing.assert_array_equal(read_raster(path, part)[0][0], SLOPE[5:9, 3:10])
    np.testing.assert_array_equal(read_on(path, part)[0], SLOPE[5:9, 3:10])
    small, grid = read_overview(path, cells=1200)
    assert (grid.top, grid.cell_size, small.shape) == (GRID.top, 2.0, (1, 30, 40))
    assert small[0, 0, 0] == pytest.approx(SLOPE[:2, :2].mean())


@pytest.mark.parametrize("oblong", [1.0, 2.0])
def test_a_reference_in_degrees_comes_onto_the_scenes_crs(tmp_path: Path, oblong: float) -> None:
    heights = SLOPE.copy()
    heights[20:30, 30:45] = np.nan
    write_cog(tmp_path / "dsm.tif", SLOPE, GRID)
    reference = in_degrees(tmp_path / "degrees.tif", heights, oblong)
    classes = in_degrees(tmp_path / "classes.tif", CLASSES, oblong)
    figures = compared(
        "--predicted", tmp_path / "dsm.tif", "--dsm", reference, "--classes", classes, "--register", "none"
    )
    # resampled twice; beside the hole and the edge a bilinear value leans on what is there
    assert figures["mae"] < 0.05 * oblong
    assert figures["completeness"] == pytest.approx(1.0, abs=0.03)
    assert set(figures["classes"]) == {"ground", "trees", "buildings"}
    truth = open_reference(reference, classes, crs=GRID.crs)
    assert truth.grid.crs == "EPSG:32617"
    inside = truth.heights[truth.grid.window(GRID.part(slice(5, 55), slice(5, 75)))]
    assert np.isnan(inside).sum() * truth.grid.cell_size**2 == pytest.approx(
        150, abs=40
    )  # m2: neither grown nor shrunk
    assert truth.classes is not None
    assert set(np.unique(truth.classes)) <= {2, 6, 65, 255}


def test_longitudes_of_a_reference_may_run_from_0_to_360(tmp_path: Path) -> None:
    write_cog(tmp_path / "dsm.tif", SLOPE, GRID)
    reference, classes = in_degrees(tmp_path / "degrees.tif", SLOPE), in_degrees(tmp_path / "classes.tif", CLASSES)
    for path in (reference, classes):
        with rasterio.open(path, "r+") as data:
            place = data.transform
            data.transform = rasterio.Affine(place.a, place.b, place.c + 360.0, place.d, place.e, place.f)
            assert data.bounds.left == pytest.approx(278.335, abs=1e-3)
    figures = compared(
        "--predicted", tmp_path / "dsm.tif", "--dsm", reference, "--classes", classes, "--register", "none"
    )
    assert figures["mae"] < 0.05  # resampled twice
    assert figures["completeness"] == pytest.approx(1.0, abs=0.03)
    assert figures["classes"]["buildings"]["n"] == pytest.approx(
        2400 / 1.064, abs=100
    )  # half of the cells, of 1.064 m2


@pytest.mark.parametrize("moved", [0.0, 3.0])
def test_a_reference_of_a_map_may_be_in_degrees(tmp_path: Path, moved: float) -> None:
    write_cog(tmp_path / "w.tif", SLOPE, GRID)
    further_east = SLOPE - np.float32(0.5 * moved)  # of a plane that rises by 0.5 a metre to the east
    figures, _ = compare_map(
        "w", tmp_path / "w.tif", in_degrees(tmp_path / "reference.tif", further_east), (moved, 0.0)
    )
    assert figures["n"] > 4000 - 60 * moved
    assert figures["rmse"] < 0.05  # a plane is kept by interpolation but at its rim, where the nearest cell counts


def in_another_crs(path: Path, crs: str, cell: float) -> Path:
    west, south, east, north = transform_bounds(GRID.crs, crs, *GRID.bounds)
    there = np.full((int((north - south) / cell), int((east - west) / cell)), -9999.0, np.float32)
    transform = rasterio.Affine(cell, 0, west, 0, -cell, north)
    reproject(
        SLOPE, there, src_transform=GRID.transform, src_crs=GRID.crs, src_nodata=np.nan, dst_transform=transform,
        dst_crs=crs, dst_nodata=-9999.0, resampling=Resampling.bilinear,
    )  # fmt: skip
    return stored(path, there, transform, crs, nodata=-9999.0)


def test_a_reference_of_a_map_may_be_in_feet_as_it_has_no_unit_of_length(tmp_path: Path) -> None:
    write_cog(tmp_path / "w.tif", SLOPE, GRID)
    reference = in_another_crs(tmp_path / "reference.tif", "EPSG:2236", 3.0)
    figures, _ = compare_map("w", tmp_path / "w.tif", reference, (0.0, 0.0))
    assert figures["n"] > 4000
    assert figures["rmse"] < 0.05


@pytest.mark.parametrize(("crs", "cell"), [("EPSG:2236", 3.28), ("EPSG:3857", 1.16)])  # feet of Florida, a web map
def test_a_reference_whose_cells_are_not_in_metres_on_the_ground_comes_onto_the_surfaces_crs(
    tmp_path: Path, crs: str, cell: float
) -> None:
    write_cog(tmp_path / "dsm.tif", SLOPE - np.float32(2.0), GRID)
    reference = in_another_crs(tmp_path / "reference.tif", crs, cell)
    figures = compared("--predicted", tmp_path / "dsm.tif", "--dsm", reference, "--register", "none")
    assert figures["median"] == pytest.approx(2.0, abs=0.02)
    truth = open_reference(reference, crs=GRID.crs)
    assert truth.grid.crs == "EPSG:32617"
    assert truth.grid.cell_size == pytest.approx(1.0, abs=0.02)  # m, of 3.28 feet and of 1.16 m of a web map at 30 N


@pytest.mark.parametrize(("crs", "cell"), [("EPSG:2236", 3.28), ("EPSG:3857", 1.16)])
def test_a_surface_whose_cells_are_not_in_metres_on_the_ground_is_scored_on_those_of_utm(
    tmp_path: Path, crs: str, cell: float
) -> None:
    surface = in_another_crs(tmp_path / "surface.tif", crs, cell)
    write_cog(tmp_path / "dsm.tif", SLOPE - np.float32(2.0), GRID)
    for reference, apart in ((tmp_path / "dsm.tif", 2.0), (surface, 0.0)):
        figures = compared("--predicted", surface, "--dsm", reference, "--register", "none")
        assert figures["median"] == pytest.approx(apart, abs=0.02)


def test_heights_above_something_else_are_scored_as_far_off_as_they_are(tmp_path: Path) -> None:
    """29 m, as in Florida between the ellipsoid and the geoid, of ground that spans 54 m; 10 m beyond that counted."""
    write_cog(tmp_path / "dsm.tif", SLOPE - np.float32(29.0), GRID)
    write_cog(tmp_path / "reference.tif", SLOPE, GRID)
    surfaces = ("--predicted", tmp_path / "dsm.tif", "--dsm", tmp_path / "reference.tif")
    figures = compared(*surfaces, "--register", "none")
    assert (figures["mae"], figures["median"], figures["nmad"]) == pytest.approx((29.0, 29.0, 0.0), abs=1e-5)
    assert compared(*surfaces, "--register", "z")["mae"] == pytest.approx(0.0, abs=1e-5)


def test_a_class_map_of_another_place_is_refused(tmp_path: Path) -> None:
    elsewhere = Grid(GRID.crs, GRID.left + 500, GRID.top, 1.0, 80, 60)
    write_cog(tmp_path / "classes.tif", CLASSES, elsewhere)
    write_cog(tmp_path / "dsm.tif", SLOPE, GRID)
    with pytest.raises(InputError, match=r"classes\.tif: found no class where .*dsm\.tif lies"):
        read_reference(tmp_path / "dsm.tif", tmp_path / "classes.tif")


@pytest.mark.parametrize(("code", "told"), [(80, True), (0, True), (9, False), (6, False)])
def test_a_class_map_with_other_numbers_says_that_it_says_nothing(
    tmp_path: Path, caplog: Any, code: int, told: bool
) -> None:
    """80 is water to other makers of maps, 0 what no lidar's classes were made of."""
    codes = np.full(GRID.shape, 65, np.uint8)
    codes[:10] = code
    write_cog(tmp_path / "classes.tif", codes, GRID)
    write_cog(tmp_path / "dsm.tif", SLOPE, GRID)
    read_reference(tmp_path / "dsm.tif", tmp_path / "classes.tif")
    words = "found none of the classes 2 ground, 5 trees, 6 buildings, 9 water: all cells are scored alike, water too"
    assert caplog.messages == ([f"{tmp_path / 'classes.tif'}: {words}"] if told else [])

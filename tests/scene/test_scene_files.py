"""Rasters as they are written: cloud-optimised, labelled, complete or not there."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from sattools.errors import InputError, SattoolsError
from sattools.scene import Grid
from sattools.scene.files import write_text
from sattools.scene.raster import read_image, read_raster, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 0.5, 1100, 700)


@pytest.fixture(scope="module")
def heights() -> Any:
    array = np.random.default_rng(0).normal(-20, 5, GRID.shape).astype(np.float32)
    array[:10, :10] = np.nan
    return array


def test_a_map_is_a_cloud_optimised_geotiff_with_its_labels(tmp_path: Path, heights: Any) -> None:
    path = tmp_path / "dsm.tif"
    tags = {"VERTICAL_DATUM": "WGS84 ellipsoid"}
    write_cog(path, heights, GRID, units="m", tags=tags, descriptions=["height"])
    with rasterio.open(path) as data:
        assert data.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert data.overviews(1) == [2, 4]  # 700 rows: 350, then 175, which fits a block of 512
        assert data.block_shapes == [(512, 512)]
        assert data.crs.to_epsg() == 32617
        assert data.transform == GRID.transform
        assert data.units == ("m",)
        assert data.descriptions == ("height",)
        assert data.tags()["VERTICAL_DATUM"] == "WGS84 ellipsoid"
        assert data.dtypes == ("float32",)
        assert np.isnan(data.nodata)


def test_a_map_survives_writing_and_reading(tmp_path: Path, heights: Any) -> None:
    write_cog(tmp_path / "dsm.tif", heights, GRID)
    array, grid = read_raster(tmp_path / "dsm.tif")
    assert grid == GRID
    np.testing.assert_array_equal(array[0], heights)


def test_masks_are_stored_as_bytes_and_doubles_as_floats(tmp_path: Path) -> None:
    small = Grid("EPSG:32617", 0.0, 0.0, 1.0, 3, 2)
    write_cog(tmp_path / "mask.tif", np.ones((2, 3), bool), small, nodata=255)
    write_cog(tmp_path / "map.tif", np.ones((2, 3), np.float64), small)
    with rasterio.open(tmp_path / "mask.tif") as mask, rasterio.open(tmp_path / "map.tif") as data:
        assert (mask.dtypes, mask.nodata) == (("uint8",), 255)
        assert data.dtypes == ("float32",)


def test_an_array_of_another_shape_than_its_grid_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SattoolsError, match=r"found an array of \(3, 2\), expected the grid's \(700, 1100\)"):
        write_cog(tmp_path / "dsm.tif", np.zeros((3, 2)), GRID)
    assert list(tmp_path.iterdir()) == []


def test_a_new_file_has_the_permissions_of_any_other(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "a")
    (tmp_path / "b.txt").write_text("b")
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "b.txt").stat().st_mode


def test_a_folder_that_is_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(SattoolsError, match=r"out/a\.txt: cannot be written .* expected a writable folder"):
        write_text(tmp_path / "out" / "a.txt", "a")


def test_no_data_of_an_image_becomes_nan(tmp_path: Path) -> None:
    path = tmp_path / "image.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=3, height=1, count=1, dtype="uint16", nodata=0, crs="EPSG:32617"
    ) as data:
        data.write(np.array([[[0, 7, 65535]]], np.uint16))
    np.testing.assert_array_equal(read_image(path), np.array([[[np.nan, 7, 65535]]], np.float32))


@pytest.mark.parametrize(("name", "words"), [("missing.tif", "no such file"), ("text.tif", "found no readable image")])
def test_what_is_no_image_is_refused(tmp_path: Path, name: Any, words: Any) -> None:
    (tmp_path / "text.tif").write_text("not an image")
    with pytest.raises(InputError, match=words):
        read_image(tmp_path / name)


def test_all_formats_that_are_read_are_named(tmp_path: Path) -> None:
    """Heights in .asc or .img are read, which who had them in another format was not told."""
    (tmp_path / "heights.xyz").write_text("0 0 1\n1 0 1\n")
    with pytest.raises(InputError, match=r"HFA \(\.img\), ENVI, EHdr, AAIGrid \(\.asc\) or SRTM\)"):
        read_image(tmp_path / "heights.xyz")


def test_a_truncated_image_is_refused(tmp_path: Path, heights: Any) -> None:
    path = tmp_path / "dsm.tif"
    write_cog(path, heights, GRID)
    path.write_bytes(path.read_bytes()[:60000])
    with pytest.raises(InputError, match=r"dsm\.tif: found a damaged or truncated image"):
        read_image(path)


def test_rasters_without_a_place_or_turned_ones_are_refused(tmp_path: Path) -> None:
    size = {"driver": "GTiff", "width": 4, "height": 4, "count": 1, "dtype": "uint8"}
    with rasterio.open(tmp_path / "nowhere.tif", "w", **size) as data:
        data.write(np.ones((1, 4, 4), np.uint8))
    turned = rasterio.Affine(0.5, 0.1, 0, 0.1, -0.5, 0)
    with rasterio.open(tmp_path / "turned.tif", "w", crs="EPSG:32617", transform=turned, **size) as data:
        data.write(np.ones((1, 4, 4), np.uint8))
    site = rasterio.crs.CRS.from_wkt('LOCAL_CS["site",UNIT["metre",1]]')
    with rasterio.open(
        tmp_path / "site.tif", "w", crs=site, transform=rasterio.Affine(1, 0, 0, 0, -1, 0), **size
    ) as data:
        data.write(np.ones((1, 4, 4), np.uint8))
    with pytest.raises(InputError, match="found no coordinate reference system"):
        read_raster(tmp_path / "nowhere.tif")
    with pytest.raises(InputError, match=r"site\.tif: found a coordinate reference system of no place on Earth"):
        read_raster(tmp_path / "site.tif")
    with pytest.raises(InputError, match="found a rotated or non-square grid"):
        read_raster(tmp_path / "turned.tif")


@pytest.mark.parametrize(
    "transform",
    [(0.5, 0, 0, 0, -0.6, 0), (0.5, 0, 0, 0, 0.6, 0), (0.5, 0.1, 0, 0, -0.5, 0), (0.5, 0, 0, 0.1, -0.5, 0)],
    ids=["oblong cells", "oblong cells, south is up", "slanting columns", "slanting rows"],
)
def test_a_grid_that_is_turned_or_not_square_is_refused(tmp_path: Path, transform: Any) -> None:
    path = tmp_path / "a.tif"
    about: dict[str, Any] = {"width": 4, "height": 4, "count": 1, "dtype": "uint8", "crs": "EPSG:32617"}
    with rasterio.open(path, "w", driver="GTiff", transform=rasterio.Affine(*transform), **about) as data:
        data.write(np.ones((1, 4, 4), np.uint8))
    with pytest.raises(InputError, match="rotated or non-square grid, expected square cells along the axes"):
        read_raster(path)

"""Rasters of other programs: scaled whole numbers, heights in feet, no-data numbers and masks of any kind."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from sattools.align.reference import heights_around
from sattools.change.stage import read_surface
from sattools.compare.truth import read_reference
from sattools.scene.grid import Grid
from sattools.scene.raster import read_raster

GRID = Grid("EPSG:32617", 436000.0, 3357000.0, 1.0, 40, 40)
HEIGHTS = np.add.outer(np.linspace(10.0, 20.0, 40), np.linspace(0.0, 5.0, 40))  # metres


def save(path: Path, numbers: Any, mask: Any = None, crs: str = GRID.crs, **about: Any) -> Path:
    profile: dict[str, Any] = {"driver": "GTiff", "count": 1, "height": 40, "width": 40, "dtype": numbers.dtype}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", **profile, crs=crs, transform=GRID.transform, nodata=about.pop("nodata", None)) as out,
    ):
        out.write(numbers, 1)
        if mask is not None:
            out.write_mask(mask)
        for name, value in about.items():
            setattr(out, name, [value])
    return path


CASES: dict[str, Any] = {
    "centimetres": ((HEIGHTS * 100).round().astype(np.int32), {"scales": 0.01}),
    "decimetres from 50 m down": (((HEIGHTS + 50) * 10).round().astype(np.int16), {"scales": 0.1, "offsets": -50.0}),
    "feet by unit": ((HEIGHTS / 0.3048).astype(np.float32), {"units": "ft"}),
    "survey feet by unit": ((HEIGHTS * 3937 / 1200).astype(np.float32), {"units": "US survey foot"}),
    "feet by CRS": ((HEIGHTS / 0.3048).astype(np.float32), {"crs": "EPSG:32617+8228"}),
    "tenths of feet": ((HEIGHTS / 0.3048 * 10).round().astype(np.int32), {"scales": 0.1, "units": "ft"}),
    "metres": (HEIGHTS.astype(np.float32), {"units": "m"}),
}


@pytest.mark.parametrize("name", CASES)
def test_heights_are_metres_however_a_file_counts_them(name: str, tmp_path: Path) -> None:
    numbers, about = CASES[name]
    path = save(tmp_path / "reference.tif", numbers, **about)
    for found in (read_reference(path).heights, read_surface(str(path)).height, heights_around(path, GRID, 0.0)[0]):
        middle = found[found.shape[0] // 2 - 20 :, found.shape[1] // 2 - 20 :][:40, :40]
        assert np.nanmax(np.abs(middle - HEIGHTS)) < 0.051  # half of a decimetre, the coarsest of the files


@pytest.mark.parametrize("kind", ["number", "mask"])
def test_whole_numbers_are_no_heights_where_the_file_says_so(kind: str, tmp_path: Path) -> None:
    numbers, known = HEIGHTS.round().astype(np.int16), np.ones((40, 40), bool)
    numbers[5:9, 5:9], known[5:9, 5:9] = 0, False
    about: Any = {"nodata": 0} if kind == "number" else {"mask": known}
    path = save(tmp_path / "reference.tif", numbers, **about)
    for found in (read_reference(path).heights, read_surface(str(path)).height):
        assert np.array_equal(np.isfinite(found), known)


@pytest.mark.parametrize(("dtype", "opaque"), [("float32", 255), ("int16", 32767), ("uint16", 65535)])
def test_transparent_cells_are_no_heights_whatever_their_type(dtype: str, opaque: int, tmp_path: Path) -> None:
    """As `gdalwarp -dstalpha` makes them of a DSM: 0 m high; GDAL has masks of bytes and uint16 alone."""
    known = np.ones((40, 40), bool)
    known[5:9, 5:9] = False
    profile: dict[str, Any] = {"driver": "GTiff", "count": 2, "height": 40, "width": 40, "dtype": dtype}
    path = tmp_path / "warped.tif"
    with rasterio.open(path, "w", **profile, crs=GRID.crs, transform=GRID.transform, alpha="YES") as out:
        out.write(np.stack([np.where(known, HEIGHTS.round(), 0), np.where(known, opaque, 0)]).astype(dtype))
    for found in (read_reference(path).heights, read_surface(str(path)).height):
        assert np.array_equal(np.isfinite(found), known)


def test_codes_stay_whole_numbers(tmp_path: Path) -> None:
    codes = np.full((40, 40), 2, np.uint8)
    codes[:3] = 0
    found, _ = read_raster(save(tmp_path / "classes.tif", codes, nodata=0))
    assert found.dtype == np.uint8
    assert np.array_equal(found[0], codes)

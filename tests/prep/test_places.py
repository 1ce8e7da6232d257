"""`prep` in high mountains: the ground may lie far from the middle of the heights that the cameras were made for."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from synthetic_views import ALT0, LAT0, LON0, parallel_rpc, render, texture

from sattools.camera import RPC
from sattools.camera.ground import from_geographic
from sattools.errors import InputError
from sattools.prep.loading import load_source
from sattools.prep.options import PrepOptions
from sattools.prep.places import check_places, ground_heights, middle_of, search_heights
from sattools.prep.stage import prepare

RUNS = [(0.3, 0.05), (-0.2, 0.2), (0.0, -0.3)]
CRS = "EPSG:32633"


def of_range(rpc: RPC, middle: float, half: float) -> RPC:
    """The same camera, made for other heights; the ground stays at ALT0."""
    col, row = rpc.col_num.copy(), rpc.row_num.copy()
    for terms in (col, row):
        terms[3] *= half / rpc.alt_scale
        terms[0] -= terms[3] * (ALT0 - middle) / half
    return replace(rpc, alt_offset=middle, alt_scale=half, col_num=col, row_num=row)


def write(folder: Path, pixels: list[Any], middle: float, margin: int = 0) -> list[Path]:
    paths = []
    for k, (image, run) in enumerate(zip(pixels, RUNS, strict=True)):
        rpc = of_range(parallel_rpc(run), middle, 1500.0).shifted(margin, margin)
        around = np.random.default_rng(k).integers(1, 255, [n + 2 * margin for n in image.shape]).astype(np.uint16)
        around[margin : margin + image.shape[0], margin : margin + image.shape[1]] = image
        image = around
        paths.append(folder / f"peak_{k}.tif")
        shape = {"height": image.shape[0], "width": image.shape[1]}
        with rasterio.open(paths[-1], "w", driver="GTiff", count=1, dtype="uint16", **shape) as out:
            out.write(image, 1)
            out.update_tags(ns="RPC", **rpc.to_tags())
    return paths


@pytest.fixture(scope="module")
def pixels() -> list[Any]:
    ground = texture()
    return [render(ground, run).clip(1, 2047).astype(np.uint16) for run in RUNS]


@pytest.fixture
def options(tmp_path: Path) -> PrepOptions:
    return PrepOptions(out=str(tmp_path / "out"), crs=CRS)


@pytest.mark.parametrize("given", [(None, None), (60.0, 140.0)], ids=["heights unknown", "heights given"])
def test_an_area_is_found_1200_m_above_the_middle_of_the_cameras_range(
    pixels: Any, options: Any, tmp_path: Path, given: Any
) -> None:
    x, y = from_geographic(CRS, LON0, LAT0)
    area = [x - 20, y - 15, x + 20, y + 15]
    images = write(tmp_path, pixels, ALT0 - 1200.0, margin=700)
    options = replace(options, bounds=area, min_height=given[0], max_height=given[1])
    scene, _ = prepare(images, options)
    low, high = scene.height_range_m
    assert ALT0 - 50 < low < ALT0 - 8 < ALT0 + 8 < high < ALT0 + 50
    for item in scene.items:
        _, _, width, height = item.properties["sattools:source_window"]
        col, row = RPC.from_file(scene.path(item.assets["rpc"].href)).projection(LON0, LAT0, ALT0)
        assert 20 < col < width - 20
        assert 20 < row < height - 20
        assert max(width, height) < 300


def test_small_images_that_meet_only_high_above_the_middle_are_of_one_place(
    pixels: Any, options: Any, tmp_path: Path
) -> None:
    images = write(tmp_path, pixels, ALT0 - 1200.0)
    low, high = prepare(images, options)[0].height_range_m
    assert ALT0 - 50 < low < ALT0 - 8 < ALT0 + 8 < high < ALT0 + 50


def test_images_that_meet_at_no_height_are_refused(pixels: Any, tmp_path: Path) -> None:
    sources = [load_source(path, path.stem, None) for path in write(tmp_path, pixels, ALT0 - 1200.0)]
    sources[1].rpc = replace(sources[1].rpc, lat_offset=LAT0 + 0.05)
    with pytest.raises(InputError, match=r"peak_1\.tif: found "):
        check_places(sources, CRS)
    sources[1].rpc = replace(sources[1].rpc, lat_offset=LAT0)
    check_places(sources, CRS, (ALT0 - 20, ALT0 + 20))
    with pytest.raises(InputError, match="expected images"):
        check_places(sources, CRS, (ALT0 - 1220, ALT0 - 1180))


def test_the_ground_is_looked_for_at_heights_given_and_else_over_the_cameras_range(tmp_path: Path) -> None:
    rpc = of_range(parallel_rpc(), 2900.0, 1500.0)
    assert ground_heights(rpc, (None, None)) == (1400.0, 4400.0)
    assert ground_heights(rpc, (4060.0, None)) == (4060.0, 4400.0)
    assert ground_heights(rpc, (4060.0, 4130.0)) == (4060.0, 4130.0)
    low, high = ground_heights(rpc, (4600.0, None))
    assert 4600.0 == low < high
    image = write(tmp_path, [np.ones((64, 64), np.uint16)] * 3, 2900.0)[0]
    source = load_source(image, "a", None)
    assert search_heights([source], (None, None)).half == 1500.0
    assert search_heights([source], (None, 4900.0)).half == 2000.0
    source.rpc = of_range(rpc, 2900.0, 300.0)
    assert search_heights([source], (None, None)).half == 600.0


@pytest.mark.parametrize("east", [179.9995, -81.66])
def test_images_whose_cameras_count_longitudes_from_other_meridians_lie_where_they_are(
    pixels: Any, tmp_path: Path, east: float
) -> None:
    """As across 180 degrees, or where one vendor counts up to 360; the mean of the numbers is half the Earth away."""
    sources = [load_source(path, path.stem, None) for path in write(tmp_path, pixels, ALT0)]
    sources = sources[:2]
    for source, turn in zip(sources, (0, -360), strict=True):
        source.rpc = replace(source.rpc, lon_offset=east + turn)
    assert middle_of(sources) == pytest.approx((east, LAT0), abs=1e-3)

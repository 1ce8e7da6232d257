"""Images of which some lie beside the others, as the tiles of a mosaic do."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_views import EAST_M, LAT0, LON0, NORTH_M, parallel_rpc, render, texture
from test_prep_stage import write

from sattools.errors import InputError
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.prep.options import PrepOptions
from sattools.prep.stage import prepare

RUNS = [(0.3, 0.05), (-0.2, 0.2), (0.0, -0.3), (0.25, -0.2), (-0.1, 0.3)]
COLUMNS = [(0, 260), (0, 120), (0, 120), (0, 120), (170, 260)]  # one image shows all, the last nothing of the others

AROUND = [LON0 - 30 / EAST_M, LAT0 - 30 / NORTH_M, LON0 + 30 / EAST_M, LAT0 + 30 / NORTH_M]


def test_an_image_beside_the_area_is_set_aside_and_the_fit_goes_on(tmp_path: Path) -> None:
    ground = texture()
    images = []
    for k, (run, (first, last)) in enumerate(zip(RUNS, COLUMNS, strict=True)):
        pixels = render(ground, run).clip(1, 2047).astype(np.uint16)[:, first:last]
        images.append(write(tmp_path / f"city_{k}.tif", pixels, parallel_rpc(run).cropped(first, 0)))
    scene, extra = prepare(images, PrepOptions(out=str(tmp_path / "out")))
    assert [item.role for item in scene.items] == ["train", "train", "train", "train", "unused"]
    assert "city_4: shows nothing of the area, set aside (role unused)" in extra["notes"]
    fit(scene, FitOptions(epochs=[1], resolution=2.0))
    assert scene.path("fit/model.safetensors").is_file()


def test_slanting_views_of_the_area_stay_whatever_the_range_of_heights(tmp_path: Path) -> None:
    """At 800 m every image looks 200 m beside its own ground, which is less wide."""
    ground = texture()
    images = [
        write(tmp_path / f"city_{k}.tif", render(ground, run).clip(1, 2047).astype(np.uint16), parallel_rpc(run))
        for k, run in enumerate(RUNS[:3])
    ]
    scene, _ = prepare(images, PrepOptions(out=str(tmp_path / "out"), min_height=-300.0, max_height=800.0))
    assert [item.role for item in scene.items] == ["train"] * 3


@pytest.mark.parametrize("column", [108, pytest.param(130, marks=pytest.mark.slow)])
def test_an_image_beside_the_bounds_is_set_aside_unless_too_few_are_left(tmp_path: Path, column: int) -> None:
    """One from column 108 on reaches them halfway up the range of heights, but not where the ground usually lies."""
    ground = texture()
    images = []
    for k, run in enumerate([*RUNS[:4], (-0.3, 0.1)]):
        first = column if k == 4 else 0
        pixels = render(ground, run).clip(1, 2047).astype(np.uint16)[:, first:]
        images.append(write(tmp_path / f"city_{k}.tif", pixels, parallel_rpc(run).cropped(first, 0)))
    west, east = -54.75 / EAST_M, -9.75 / EAST_M
    bounds = [LON0 + west, LAT0 - 30 / NORTH_M, LON0 + east, LAT0 + 30 / NORTH_M]
    options = PrepOptions(out=str(tmp_path / "out"), bounds=bounds)
    scene, _ = prepare(images, options)
    assert [item.role for item in scene.items] == ["train", "train", "train", "train", "unused"]
    few = replace(options, holdout=["city_0", "city_1", "city_2"], out=str(tmp_path / "few"))
    with pytest.raises(InputError, match="found 1 for training that show the area, expected at least 2"):
        prepare(images, few)
    assert not list(Path(few.out).rglob("*.tif"))


def test_images_of_other_places_are_left_out_where_an_area_is_asked_for(tmp_path: Path, caplog: Any) -> None:
    """As of an archive: most of them lie elsewhere, and in the next UTM zone; their middle is not the area's."""
    ground, images = texture(), []
    for k, run in enumerate(RUNS[:3]):
        pixels = render(ground, run).clip(1, 2047).astype(np.uint16)
        images.append(write(tmp_path / f"city_{k}.tif", pixels, parallel_rpc(run)))
        for shift in (0.2, 4.0, 4.1):
            there = replace(parallel_rpc(run), lon_offset=LON0 + shift)
            images.append(write(tmp_path / f"other_{k}_{shift:.0f}{shift % 1:.1f}.tif", pixels, there))
    with pytest.raises(InputError, match=r"`--bounds` or `--aoi` take those that show an area"):
        prepare(images, PrepOptions(out=str(tmp_path / "all")))
    alone, _ = prepare(images[::4], PrepOptions(out=str(tmp_path / "alone"), bounds=AROUND))
    caplog.clear()
    scene, extra = prepare(images, PrepOptions(out=str(tmp_path / "out"), bounds=AROUND))
    assert [item.id for item in scene.items] == ["city_0", "city_1", "city_2"]
    assert scene.grid == alone.grid
    told = "other_0_00.2, other_0_40.0, other_0_40.1 and 6 more: do not show the area, left out"
    assert told in extra["notes"]
    assert told in caplog.messages

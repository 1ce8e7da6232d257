"""Numbers of images that may be no brightness are told, and frames of zeros noted."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from spoilt import Town, made, prep

from sattools.prep.numbers import Numbers
from sattools.scene import Scene


@pytest.fixture
def town(town_source: Any, tmp_path: Path) -> Any:
    return Town(tmp_path, town_source, 4)


def dark_water(values: Any) -> Any:
    """Every tenth row a little below 0, each of its numbers another one, as an atmospheric correction leaves them."""
    signed = values.astype(np.int16)
    signed[:, ::10] = -1 - np.arange(signed[:, ::10].size).reshape(signed[:, ::10].shape) % 300
    return signed


def framed(value: int, dtype: Any) -> Any:
    """The left tenth of all bands is one number."""

    def change(values: Any) -> Any:
        values = values.astype(dtype)
        values[:, :, : values.shape[2] // 10 + 1] = value
        return values

    return change


def striped(value: int, dtype: Any) -> Any:
    """So many columns in the middle are."""

    def change(values: Any) -> Any:
        values = values.astype(dtype)
        values[:, :, 40 : 41 + values.shape[2] // 10] = value
        return values

    return change


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_a_number_that_may_mean_no_data_and_is_not_declared(town: Any, dtype: Any) -> None:
    for number in range(1, 5):
        town.pixels(number, striped(-999, dtype) if number == 2 else lambda values: values.astype(dtype))
    scene = made(town, "TOWN_002: 11 % of its pixels are -999, taken for brightness", "gdal_edit.py -a_nodata -999")
    assert not any("TOWN_001" in note for note in scene.history[-1]["notes"])


def test_numbers_below_zero(town: Any) -> None:
    for number in range(1, 5):
        town.pixels(number, dark_water if number == 2 else lambda values: values.astype(np.int16))
    made(town, "TOWN_002: 10 % of its pixels are negative, down to -300, taken for brightness", "without sign")


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_images_mostly_darker_than_black_are_refused(town: Any, unit: float) -> None:
    """Matching takes numbers below 0 for black: a town's surface was 13 m off, in small units without a word."""
    for number in range(1, 5):
        town.pixels(number, lambda values: ((values - 1000.0) * unit).astype(np.float32))
    result = prep(town)
    assert result.exit_code == 1
    told = result.stderr.splitlines()[-1]
    assert "TOWN_001.tif: found " in told
    assert " % of the pixels below 0, expected brightness, 0 where it is black (add an offset" in told
    assert not list(town.folder.glob("**/scene.json"))


def test_a_frame_of_zeros_is_noted_where_the_file_does_not_declare_it(town: Any) -> None:
    town.pixels(2, framed(0, np.uint16))
    town.pixels(3, framed(0, np.uint16))
    with rasterio.open(town.image(3), "r+") as data:
        data.nodata = 0
    result = prep(town)
    assert result.stderr == ""  # nothing has to be done about it
    notes = Scene.from_json(result.stdout).history[-1]["notes"]
    assert "TOWN_002: 11 % of the pixels, from a corner on, are 0 in all bands and taken for no data" in "\n".join(
        notes
    )
    assert not any("TOWN_003" in note for note in notes)


@pytest.mark.parametrize(("negative", "said"), [(998, "100 %"), (24, "2.4 %"), (500, "50 %")])
def test_shares_are_written_as_people_write_them(negative: int, said: str) -> None:
    numbers = Numbers(1)
    numbers.low[:], numbers.seen, numbers.negative = -300.0, 1000, negative
    assert numbers.doubts()[0].startswith(f"{said} of its pixels are negative")


def white(edge: int) -> Any:
    """All pixels but those within so many of the image's edge are saturated."""

    def change(values: Any) -> Any:
        inside = slice(edge, -edge or None)
        values[:, inside, inside] = 65535
        return values

    return change


def test_a_white_image_is_refused(town: Any) -> None:
    town.pixels(2, white(0))
    result = prep(town)
    assert result.exit_code == 1
    assert "TOWN_002.tif: found band 1 to be 65535 everywhere, expected an image" in result.stderr


def test_images_that_are_white_in_the_area_only_are_refused(town: Any, town_source: Scene) -> None:
    """What is around tied them, and a surface was made of nothing."""
    for number in range(1, 5):
        town.pixels(number, white(50))
    west, south, east, north = town_source.require_grid().bounds
    middle = (west + east) / 2, (south + north) / 2
    bounds = [middle[0] - 6, middle[1] - 6, middle[0] + 6, middle[1] + 6]
    result = prep(town, "--crs", town_source.require_grid().crs, "--bounds", *(str(edge) for edge in bounds))
    assert result.exit_code == 1
    told = "TOWN_001.tif: found 65535 everywhere in the area, expected an image of it (leave it out)"
    assert told in result.stderr.splitlines()[-1]
    assert not list(town.folder.glob("**/scene.json"))

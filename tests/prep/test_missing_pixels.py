"""Images with many single pixels missing, and with tiny numbers, are prepared as others are."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spoilt import Town, prep

from sattools.prep.grays import of_size_one
from sattools.radiometry.holes import without_holes
from sattools.scene import Scene


@pytest.fixture
def town(town_source: Any, tmp_path: Path) -> Any:
    return Town(tmp_path, town_source, 4)


def salted(number: float, share: float = 0.05) -> Any:
    """One pixel in twenty, or another share, is a number in all bands."""

    def change(values: Any) -> Any:
        values = values.astype(np.float32)
        values[:, np.random.default_rng(int(values[0, 0, 0])).random(values.shape[1:]) < share] = number
        return values

    return change


def times(factor: float) -> Any:
    return lambda values: values.astype(np.float64) * factor


def cameras_found(town: Any) -> Any:
    result = prep(town)
    assert result.exit_code == 0, result.output
    adjustment = Scene.from_json(result.stdout).history[-1]["adjustment"]
    return adjustment["median_after_px"], adjustment["outlier_views"]


@pytest.mark.parametrize("change", [salted(np.nan), salted(0.0), times(1e-15)], ids=["nan", "zero", "tiny"])
def test_cameras_are_corrected_in_spite_of_missing_pixels_and_tiny_numbers(town: Any, change: Any) -> None:
    for number in range(1, 5):
        town.pixels(number, change)
    residual, outliers = cameras_found(town)
    assert residual < 0.3  # whole images have 0.12 px, these 0.15
    assert outliers == []


def test_few_missing_pixels_cost_few_tie_points(town: Any) -> None:
    """Two in three features have one of 4 in 1000 near them; without these the towers of an image pair were cut off."""

    def found() -> int:
        return sum(
            pair["tie_points"]
            for pair in Scene.from_json(prep(town, "--overwrite").stdout).history[-1]["adjustment"]["pairs"]
        )

    whole = found()
    for number in range(1, 5):
        town.pixels(number, salted(np.nan, 0.004))
    assert found() > 0.8 * whole


def test_numbers_too_small_to_calculate_with_are_told(town: Any) -> None:
    for number in range(1, 5):
        town.pixels(number, times(1e-20))
    result = prep(town)
    assert result.exit_code == 1
    assert "TOWN_001.tif: found numbers of up to 1." in result.output
    assert "expected digital numbers, radiance or reflectance above 1e-15 (multiply them)" in result.output


def one_of(number: float) -> Any:
    """A single pixel is a number in all bands, somewhere within the image."""

    def change(values: Any) -> Any:
        values = values.astype(np.float64)
        values[:, 40, 50] = number
        return values

    return change


@pytest.mark.parametrize(
    ("change", "largest"), [(times(1e300), "1."), (one_of(-1e308), "1e+308"), (one_of(1e20), "1e")]
)
def test_numbers_too_large_to_calculate_with_are_told(town: Any, change: Any, largest: str, recwarn: Any) -> None:
    town.pixels(1, change)
    result = prep(town)
    assert result.exit_code == 1
    assert f"TOWN_001.tif: found numbers of up to {largest}" in result.output
    wanted = "expected digital numbers, radiance or reflectance below 1e+09; declare those that mean no data"
    assert f"{wanted} (gdal_edit.py -a_nodata)" in result.output
    assert [str(w.message) for w in recwarn if issubclass(w.category, RuntimeWarning)] == []


def test_single_missing_pixels_are_filled_from_their_neighbours_and_frames_are_not() -> None:
    row, column = np.mgrid[:100, :120].astype(np.float32)
    whole = 10 + row + 2 * column
    gray = whole.copy()
    gray[np.random.default_rng(0).random(gray.shape) < 0.05] = np.nan
    gray[:, :20] = np.nan
    filled = without_holes(gray)
    assert np.isnan(filled[:, :20]).all()
    inside = filled[2:-2, 23:-2]  # pixels beside the frame belong to it
    assert np.isfinite(inside).all()
    assert np.abs(inside - whole[2:-2, 23:-2]).max() < 3.0  # a pixel to the right is 2 more
    known = np.isfinite(gray)
    np.testing.assert_array_equal(filled[known], gray[known])


def test_few_missing_pixels_stay_missing_and_ordinary_numbers_as_they_are() -> None:
    gray = np.random.default_rng(0).uniform(0.1, 0.2, (50, 50)).astype(np.float32)
    gray[::20, ::20] = np.nan  # 9 of 2500
    assert without_holes(gray) is gray
    assert of_size_one(gray) is gray


def test_tiny_numbers_are_multiplied_by_a_power_of_two() -> None:
    gray = np.array([[1e-12, np.nan, -3e-13]], np.float32)
    larger = of_size_one(gray)
    assert 0.5 <= np.nanmax(larger) < 1.0
    np.testing.assert_array_equal(larger / np.float32(2.0**39), gray)

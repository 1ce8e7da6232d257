"""What is no surface in metres is refused; what a registration makes worse is told."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from sattools.cli import main
from sattools.scene import Grid
from sattools.scene.raster import write_cog

GRID = Grid("EPSG:32617", 436000.0, 3357800.0, 1.0, 160, 160)


def town(blocks: int = 25) -> np.ndarray:
    """Blocks of 3 to 20 m on a plain 5 m above the ellipsoid."""
    rng = np.random.default_rng(5)
    heights = np.full(GRID.shape, 5.0, np.float32)
    for _ in range(blocks):
        row, column = rng.integers(0, 145, 2)
        heights[row : row + rng.integers(6, 15), column : column + rng.integers(6, 15)] = 5 + rng.uniform(3, 20)
    return heights


def matched(noise: float = 0.3) -> np.ndarray:
    return (town() + np.random.default_rng(1).normal(0, noise, GRID.shape)).astype(np.float32)


def compared(folder: Path, found: np.ndarray, reference: np.ndarray, *more: str, **units: Any) -> Any:
    """`compare` of two files, whose bands say their `unit_found` and `unit_truth`."""
    write_cog(folder / "found.tif", found, GRID, units=units.get("unit_found"))
    write_cog(folder / "truth.tif", reference, GRID, units=units.get("unit_truth"))
    files = ("--predicted", str(folder / "found.tif"), "--dsm", str(folder / "truth.tif"))
    return CliRunner().invoke(main, ["compare", *files, *more])


def refused(result: Any, words: str) -> None:
    assert (result.exit_code, result.stdout) == (1, "")
    assert words in result.stderr.splitlines()[-1]
    assert result.stderr.splitlines()[-1].startswith("sattools compare: error: ")


@pytest.mark.parametrize("method", ["ncc", "z", "none"])
def test_feet_that_do_not_say_so_are_refused(tmp_path: Path, method: str) -> None:
    in_feet = (town() / np.float32(0.3048)).astype(np.float32)
    told = "truth.tif: found heights that are 3.28 times the other surface's, as feet are, expected metres"
    refused(compared(tmp_path, matched(), in_feet, "--register", method), told)
    declared = compared(tmp_path, matched(), in_feet, "--register", method, unit_truth="ft")
    assert json.loads(declared.stdout)["mae"] == pytest.approx(0.24, abs=0.01)  # of 0.3 m of noise


def test_a_surface_in_feet_is_refused(tmp_path: Path) -> None:
    in_feet = (matched() / np.float32(0.3048)).astype(np.float32)
    refused(compared(tmp_path, in_feet, town()), "found.tif: found heights that are 3.28 times the other surface's")


@pytest.mark.parametrize(("parts", "unit", "scale"), [(10, "decimetres", "0.1"), (100, "centimetres", "0.01")])
@pytest.mark.parametrize("wrong", ["found", "truth"])
def test_parts_of_metres_that_do_not_say_so_are_refused(
    tmp_path: Path, wrong: str, parts: int, unit: str, scale: str
) -> None:
    """Elevation models in whole centimetres had errors of kilometres, without a word."""
    heights = {"found": matched(), "truth": town()}
    heights[wrong] = (heights[wrong] * parts).round().astype(np.int16)
    told = f"{wrong}.tif: found heights that are {parts} times the other surface's, as {unit} are, expected metres"
    result = compared(tmp_path, heights["found"], heights["truth"])
    refused(result, f"{told} (or a file that says its scale: gdal_edit.py -scale {scale})")


@pytest.mark.parametrize("share", [0.0, 0.5, 2.0])
def test_bad_surfaces_are_scored(tmp_path: Path, share: float) -> None:
    """Flattened and exaggerated ones, with 4 m of noise."""
    result = compared(tmp_path, share * matched(4.0), town(), "--register", "none")
    assert result.exit_code == 0, result.stderr


def test_what_says_that_it_is_no_height_is_refused(tmp_path: Path) -> None:
    colours = np.stack([town()] * 3)
    refused(compared(tmp_path, colours, town()), "found.tif: found 3 bands, expected one of heights [m]")
    expected = "found numbers in the unit '1', expected heights in metres or feet"
    refused(compared(tmp_path, town(), town(), unit_found="1"), f"found.tif: {expected}")
    refused(compared(tmp_path, town(), town(), unit_truth="1"), f"truth.tif: {expected}")
    for unit in ("m", "metre", "Meters", "us-ft", "unknown", None):
        assert (
            compared(tmp_path, matched(), town(), "--register", "none", unit_found=unit, unit_truth=unit).exit_code == 0
        )


def classes() -> np.ndarray:
    """Ground, trees and buildings as in a class map of ASPRS codes."""
    codes = np.full(GRID.shape, 2, np.uint8)
    codes[20:60, 20:60], codes[20:60, 60:90], codes[100:, 100:] = 6, 5, 65
    return codes


@pytest.mark.parametrize("kind", [np.uint8, np.int16])
def test_a_class_map_is_no_surface(tmp_path: Path, kind: Any) -> None:
    told = "found class codes (2, 5, 6, 65), expected heights [m] (or a file that says its unit: gdal_edit.py -units m)"
    refused(compared(tmp_path, town(), classes().astype(kind)), f"truth.tif: {told}")
    refused(compared(tmp_path, classes().astype(kind), town()), f"found.tif: {told}")
    in_metres = compared(tmp_path, town(), classes().astype(kind), "--register", "none", unit_truth="m")
    assert in_metres.exit_code == 0, in_metres.stderr


def test_a_class_map_whose_margin_is_no_data_is_no_surface(tmp_path: Path) -> None:
    codes = classes()
    codes[:, :10] = 255
    write_cog(tmp_path / "found.tif", town(), GRID)
    write_cog(tmp_path / "truth.tif", codes, GRID, nodata=255)
    files = ("--predicted", str(tmp_path / "found.tif"), "--dsm", str(tmp_path / "truth.tif"))
    refused(CliRunner().invoke(main, ["compare", *files]), "truth.tif: found class codes (2, 5, 6, 65), expected")


@pytest.mark.parametrize("steep", [4.0, 1.0])
def test_whole_metres_are_no_classes(tmp_path: Path, steep: float) -> None:
    """A slope that rises by one cell after the other, or in terraces of 1 m, and a hut without a height between."""
    heights = (np.arange(160.0) / 160.0 * 4.0 * steep).astype(np.int16) * np.ones((160, 1), np.int16)
    heights[50:60, 20:30] = 18
    result = compared(tmp_path, heights.astype(np.float32), heights, "--register", "none")
    assert result.exit_code == 0, result.stderr


def test_a_palette_is_no_surface(tmp_path: Path) -> None:
    write_cog(tmp_path / "found.tif", town(), GRID)
    about: Any = {"width": 160, "height": 160, "count": 1, "dtype": "uint8", "crs": GRID.crs}
    with rasterio.open(tmp_path / "truth.tif", "w", driver="GTiff", transform=GRID.transform, **about) as data:
        data.write(classes(), 1)
        data.write_colormap(1, {2: (200, 150, 100), 5: (0, 120, 0)})
    files = ("--predicted", str(tmp_path / "found.tif"), "--dsm", str(tmp_path / "truth.tif"))
    refused(
        CliRunner().invoke(main, ["compare", *files]),
        "truth.tif: found a palette (numbers of colours or classes), expected heights [m]",
    )


def test_a_reference_without_a_height_is_named(tmp_path: Path) -> None:
    nothing = np.full(GRID.shape, np.nan, np.float32)
    refused(compared(tmp_path, town(), nothing), "truth.tif: found no height to score by, expected some (cells with a")


def far_off() -> np.ndarray:
    """A town in place, its fifteen highest blocks matched 16 m too far east and 60 m too high."""
    heights = matched()
    high = np.roll(town() > 14, 16, axis=1)
    return np.where(high, heights + np.float32(60), heights)


@pytest.mark.parametrize("method", ["ncc", "z"])
def test_a_registration_that_leads_away_is_told(tmp_path: Path, method: str) -> None:
    result = compared(tmp_path, far_off(), town(), "--register", method)
    figures = json.loads(result.stdout)
    if method == "ncc":
        assert figures["shift_m"][0] == -15.0
        assert (
            "ncc moves the surface -15.0 m east and +0.0 m north, which is doubtful: more than 10.0 m"
            in (figures["notes"][0])
        )
        assert "--register z or none scores it where it is" in figures["notes"][0]
        assert f"found.tif: {figures['notes'][0]}" in result.stderr
    else:
        assert "notes" not in figures


def test_a_registration_that_fits_is_not_doubted(tmp_path: Path) -> None:
    result = compared(tmp_path, np.roll(matched(), 3, axis=1), town())
    figures = json.loads(result.stdout)
    assert figures["shift_m"][0] == -3.0
    assert "notes" not in figures
    assert "doubtful" not in result.stderr

"""Surfaces that do not fit into memory get the figures that numpy gives of whole arrays."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sattools.compare import CompareOptions, compare_dsm, compare_file, map_errors, read_reference
from sattools.compare import maps as map_module
from sattools.compare.holes import fill_holes
from sattools.compare.maps import compare_map
from sattools.compare.metrics import WINDOW_PX, ImageErrors, image_errors
from sattools.compare.tally import Median
from sattools.scene import Grid, stored
from sattools.scene.raster import write_cog
from sattools.scene.stored import StoredMap

GRID = Grid("EPSG:32617", 436000.0, 3357800.0, 0.5, 210, 230)


@pytest.fixture
def tiny_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps of 20 kB go to files, in pieces of a dozen rows and blocks of 64 cells."""
    for name, value in {"HELD": 20_000, "PIECE_CELLS": 2_700, "AT_ONCE": 3_000, "EDGE": 64}.items():
        monkeypatch.setattr(stored, name, value)


def surface(seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    heights = np.add.outer(np.linspace(0, 9, 230), np.linspace(0, 3, 210)).astype(np.float32)
    for _ in range(40):
        row, column = rng.integers(0, 190, 2)
        heights[row : row + rng.integers(6, 25), column : column + rng.integers(6, 25)] += rng.uniform(3, 20)
    return heights


def found(heights: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(4)
    moved = np.roll(heights, (3, -2), (0, 1)) + rng.normal(0, 0.4, heights.shape).astype(np.float32) + 1.5
    moved[rng.random(moved.shape) < 0.05] = np.nan
    moved[60:130, 100:180] = np.nan
    return moved


def flat(figures: Any, name: str = "") -> dict[str, Any]:
    if not isinstance(figures, dict | list):
        return {name: figures}
    pairs = figures.items() if isinstance(figures, dict) else enumerate(figures)
    return {k: v for key, value in pairs for k, v in flat(value, f"{name}/{key}").items()}


@pytest.mark.parametrize("method", ["ncc", "nuth-kaab", "z", "none"])
@pytest.mark.parametrize("cell", [0.5, 1.25])
def test_figures_in_pieces_are_those_of_the_whole(
    tmp_path: Path, request: pytest.FixtureRequest, method: Any, cell: float
) -> None:
    heights = surface()
    reference = heights.copy()
    reference[:40, 150:] = np.nan
    classes = np.where(heights > 12, 6, 2).astype(np.uint8)
    classes[200:, :60], classes[150:170, 20:90] = 9, 5
    write_cog(tmp_path / "reference.tif", reference, GRID)
    write_cog(tmp_path / "classes.tif", classes, GRID, nodata=None)
    finer = Grid(GRID.crs, GRID.left, GRID.top, cell, int(105 / cell), int(115 / cell))
    other = found(heights)[: finer.height, : finer.width] if cell != 0.5 else found(heights)
    write_cog(tmp_path / "found.tif", other, finer)

    def figures() -> dict[str, Any]:
        options = CompareOptions(
            predicted=str(tmp_path / "found.tif"), dsm=str(tmp_path / "reference.tif"),
            classes=str(tmp_path / "classes.tif"), register=method, region="436000,3357690,436100,3357790",
        )  # fmt: skip
        return flat(json.loads(json.dumps(compare_file(options))))

    whole = figures()
    request.getfixturevalue("tiny_pieces")
    by_pieces = figures()
    assert list(by_pieces) == list(whole)
    assert len(whole) > 90
    for name, value in whole.items():
        # sums in another order differ in their last digits
        assert by_pieces[name] == (pytest.approx(value, rel=1e-6, abs=1e-6) if isinstance(value, float) else value), (
            name
        )


@pytest.mark.usefixtures("tiny_pieces")
def test_the_figures_are_those_of_plain_numpy(tmp_path: Path) -> None:
    reference, heights = surface(), surface() + np.random.default_rng(8).normal(0.3, 2.0, GRID.shape).astype(np.float32)
    write_cog(tmp_path / "reference.tif", reference, GRID)
    result = compare_dsm(heights, read_reference(tmp_path / "reference.tif"), GRID, "none")
    difference = heights.astype(np.float64) - reference
    absolute = np.abs(difference)
    median = np.median(difference)
    expected = {
        "mae": absolute.mean(), "rmse": math.sqrt((difference**2).mean()), "median": np.median(absolute),
        "bias": difference.mean(), "nmad": 1.4826 * np.median(np.abs(difference - median)),
        "within_1m": (absolute <= 1).mean(), "completeness": 1.0,
        "mae_centred": np.abs(difference - median).mean(),
        "mae_capped_5m": np.minimum(np.abs(difference - median), 5).mean(),
    }  # fmt: skip
    assert {name: result.figures[name] for name in expected} == pytest.approx(expected, rel=1e-5)  # float32 heights
    assert isinstance(result.difference, np.ndarray)
    np.testing.assert_allclose(result.difference, difference, atol=1e-5)


@given(
    arrays(np.float32, st.integers(1, 60), elements=st.floats(-1e4, 1e4, width=32)), st.integers(1, 5), st.booleans()
)
def test_a_median_in_pieces_is_numpys(values: np.ndarray, piece: int, few_values: bool) -> None:
    values = np.round(values / 5000).astype(np.float32) if few_values else values
    median = Median()
    for show in (median.first, median.again):
        for first in range(0, len(values), piece):
            show(values[first : first + piece])
    assert median.value() == np.median(values)


def test_the_median_of_nothing_is_nan() -> None:
    median = Median()
    median.first(np.empty(0, np.float32))
    median.again(np.empty(0, np.float32))
    assert math.isnan(median.value())


@pytest.mark.usefixtures("tiny_pieces")
@pytest.mark.parametrize("share", [0.01, 0.5, 0.999])
def test_holes_of_a_stored_map_are_filled_as_those_of_an_array(share: float) -> None:
    rng = np.random.default_rng(1)
    heights = rng.normal(size=(120, 170)).astype(np.float32)
    heights[rng.random(heights.shape) < share] = np.nan
    heights[30:110, 20:165] = np.nan
    map_ = StoredMap(heights.shape, np.float32)
    map_[:] = heights
    np.testing.assert_array_equal(np.asarray(fill_holes(map_)), fill_holes(heights))  # also of equally near ones


@pytest.mark.usefixtures("tiny_pieces")
def test_parameter_maps_in_pieces_have_the_figures_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_module, "SHOWN", 5_000)
    rng = np.random.default_rng(2)
    reference = rng.uniform(0.1, 0.9, (2, *GRID.shape)).astype(np.float32)
    own = (0.8 * reference + rng.normal(0, 0.05, reference.shape)).astype(np.float32)
    own[:, 50:90, 60:80] = np.nan
    write_cog(tmp_path / "own.tif", own, GRID)
    write_cog(tmp_path / "reference.tif", reference, GRID)
    figures, (p, r) = compare_map("w", tmp_path / "own.tif", tmp_path / "reference.tif", (0.0, 0.0))
    assert figures == pytest.approx(map_errors(own, reference), rel=1e-9)
    both = np.isfinite(own) & np.isfinite(reference)
    x, y = own[both].astype(np.float64), reference[both].astype(np.float64)
    assert figures["correlation"] == pytest.approx(np.corrcoef(x, y)[0, 1], rel=1e-9)
    assert figures["scale"] == pytest.approx((x * y).sum() / (x * x).sum(), rel=1e-9)
    assert len(p) == len(r)
    assert 3_000 < len(p) < 6_000  # at even distances, for a picture


def test_a_map_without_any_value_claims_nothing(tmp_path: Path) -> None:
    write_cog(tmp_path / "own.tif", np.full(GRID.shape, np.nan, np.float32), GRID)
    write_cog(tmp_path / "reference.tif", surface(), GRID)
    figures, _ = compare_map("c", tmp_path / "own.tif", tmp_path / "reference.tif", (0.0, 0.0))
    assert figures["n"] == 0
    assert figures["rmse"] is None


def test_images_in_strips_have_the_figures_of_the_whole() -> None:
    rng = np.random.default_rng(6)
    reference = rng.uniform(0, 1, (3, 97, 61)).astype(np.float32)
    image = (reference + rng.normal(0, 0.1, reference.shape)).astype(np.float32)
    image[:, 20:30, 5:15] = np.nan
    expected = image_errors(image, reference)
    for strip in (97, 40, 3):
        errors = ImageErrors()
        for first in range(0, 97, strip):
            last = min(first + strip, 97)
            around = slice(max(0, first - WINDOW_PX), min(97, last + WINDOW_PX))
            errors.add(image[:, around], reference[:, around], slice(first - around.start, last - around.start))
        assert errors.figures()["psnr"] == pytest.approx(expected["psnr"], rel=1e-9)
        assert errors.figures()["ssim"] == pytest.approx(expected["ssim"], rel=1e-9)

"""The probability that a height is right to a metre, and how far off it may be."""

import json
import math
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from sattools.prior.probability import NAMES, arrays, features, from_features, height_doubt, margin, the_network

FLAT = np.full((40, 40), 12.0, np.float32)


def a_town(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Heights [m] with blocks of 3 to 20 m, and confidence, both ``[60, 50]``."""
    rng = np.random.default_rng(seed)
    height = rng.normal(100, 0.1, (60, 50))
    for _ in range(6):
        row, col = rng.integers(0, 45, 2)
        height[row : row + 12, col : col + 9] += rng.uniform(3, 20)
    return height.astype(np.float32), rng.uniform(0, 1, height.shape).astype(np.float32)


def test_the_surer_the_match_of_a_town_the_more_probable_and_the_nearer() -> None:
    height, _ = a_town()
    found = [height_doubt(height, np.full_like(height, c), 0.5) for c in (0.02, 0.1, 0.3, 0.6, 0.9)]
    p, std, error95 = (np.array([one[k].mean() for one in found]) for k in range(3))
    assert (np.diff(p) > 0).all()
    assert p[-1] > 0.98
    assert (np.diff(std) < 0).all()
    assert (error95 > 1.2 * std).all()


def test_heights_about_which_nothing_around_agrees_are_guesses() -> None:
    confidence = np.full_like(FLAT, 0.6)
    confidence[:, 20:] = 0
    p, std, error95 = height_doubt(FLAT, confidence, 0.5)
    assert p[20, 10] > 0.98
    assert p[20, 21] > 0.5  # level beside what is sure
    assert (p[:, 30:] <= 0.3).all()  # 9 cells of 0.5 m are 4.5 m
    assert (std[:, 30:] >= 10).all()
    assert (error95[:, 30:] >= 40).all()


@pytest.mark.parametrize("flip", [np.asarray, np.fliplr, np.flipud, np.transpose])
def test_guesses_are_the_same_from_every_side(flip: Any) -> None:
    rng = np.random.default_rng(2)
    confidence = rng.uniform(0.1, 1, (60, 80)).astype(np.float32)
    confidence[:, 40:] = 0
    flat = np.full_like(confidence, 7.0)
    found = flip(height_doubt(flat, confidence, 0.5)[0])
    np.testing.assert_allclose(height_doubt(flip(flat), flip(confidence), 0.5)[0], found, atol=1e-5)


def test_a_place_without_a_height_is_no_step() -> None:
    height = FLAT.copy()
    height[10:20, 10:20] = np.nan
    confidence = np.full_like(FLAT, 0.3)
    there, without = (height_doubt(h, confidence, 0.5)[0] for h in (height, FLAT))
    known = np.isfinite(height)
    np.testing.assert_allclose(there[known], without[known], atol=1e-6)


def test_what_stands_beside_a_step_is_less_sure() -> None:
    confidence = np.full_like(FLAT, 0.1)
    step = FLAT.copy()
    step[:, 20:] += 12
    flat, beside = (height_doubt(height, confidence, 0.5) for height in (FLAT, step))
    assert beside[0][20, 19] < flat[0][20, 19] - 0.03
    assert beside[2][20, 19] > 4 * flat[2][20, 19]
    np.testing.assert_allclose(beside[0][20, 0], flat[0][20, 0], atol=1e-6)  # 10 m away it is as without


def test_what_is_not_known_has_no_probability() -> None:
    height, confidence = a_town()
    height[3, 4], confidence[30, 20] = np.nan, np.nan
    unknown = np.isnan(height) | np.isnan(confidence)
    for values in height_doubt(height, confidence, 0.5):
        np.testing.assert_array_equal(np.isnan(values), unknown)
        assert values.dtype == np.float32


@pytest.mark.parametrize("cell", [0.05, 0.5, 3.0, 200.0])
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (30, 2)])
def test_any_map_has_a_probability(shape: tuple[int, int], cell: float) -> None:
    rng = np.random.default_rng(1)
    height = (rng.uniform(-400, 9000, shape)).astype(np.float32)
    p, std, error95 = height_doubt(height, rng.uniform(0, 1, shape).astype(np.float32), cell)
    assert ((p >= 0) & (p <= 1)).all()
    assert np.isfinite(error95).all()
    assert (std > 0).all()
    assert (error95 >= std).all()


def test_no_height_is_further_off_than_heights_were_looked_at() -> None:
    height, confidence = a_town()
    height[20:40, 20:40] += 300 * (np.indices((20, 20)).sum(0) % 2)  # a guess, whose bounds are hundreds of metres
    confidence[20:40, 20:40] = 0
    free, capped = height_doubt(height, confidence, 0.5), height_doubt(height, confidence, 0.5, 25.0)
    assert free[2].max() > 100
    np.testing.assert_array_equal(capped[0], free[0])
    for bound, before in zip(capped[1:], free[1:], strict=True):
        np.testing.assert_array_equal(bound, np.minimum(before, 25))


def test_a_map_without_any_height_has_no_probability() -> None:
    assert all(np.isnan(v).all() for v in height_doubt(np.full_like(FLAT, np.nan), np.zeros_like(FLAT), 0.5))


@pytest.mark.parametrize("cell", [0.35, 1.0, 5.0])
def test_a_part_with_its_margin_has_what_the_whole_has(cell: float) -> None:
    height, confidence = a_town(3)
    rows, beyond = slice(25, 35), margin(cell)
    around = slice(max(0, rows.start - beyond), rows.stop + beyond)
    own = slice(rows.start - around.start, rows.stop - around.start)
    whole, part = height_doubt(height, confidence, cell), height_doubt(height[around], confidence[around], cell)
    for a, b in zip(whole, part, strict=True):
        np.testing.assert_allclose(a[rows], b[own], rtol=1e-5, atol=1e-5)  # sums of other rows round otherwise


def test_features_are_what_their_names_say() -> None:
    height, confidence = a_town(5)
    row, col, cell = 30, 24, 0.5
    every = features(height, confidence, cell)

    def around(values: np.ndarray, metres: float, at: tuple[int, int] = (row, col)) -> np.ndarray:
        half = round(metres / cell)
        return values[at[0] - half : at[0] + half + 1, at[1] - half : at[1] + half + 1].astype(np.float64)

    z = float(height[row, col])
    means = [around(height, 1, (r, c)).mean() for r in range(row - 12, row + 13) for c in range(col - 12, col + 13)]
    expected = [
        math.sqrt(confidence[row, col]),
        np.sqrt(around(confidence, 1)).mean(),
        np.sqrt(around(confidence, 4.5)).mean(),
        math.log1p(abs(z - around(height, 2.5).mean())),
        math.log1p(np.ptp(around(height, 3))),
        math.log1p(max(0.0, z - min(means))),
        math.log1p(around(height, 2).std()),
        0.0,
    ]
    np.testing.assert_allclose(every[row, col], expected, atol=2e-5)
    assert features(FLAT, FLAT * 0, 2.0)[0, 0].tolist() == [0, 0, 0, 0, 0, 0, 0, 2]


def test_the_network_is_of_these_features() -> None:
    stored = json.loads(files("sattools.prior").joinpath("probability.json").read_text())
    assert stored["features"] == list(NAMES)
    assert [weights.shape for weights, _ in the_network()["layers"]] == [(8, 24), (24, 24), (24, 3)]


def test_a_network_is_layers_of_rectified_sums() -> None:
    first = {"weights": [[2.0], [1.0], [0.0]], "bias": [-1.0]}
    network = arrays(
        {"mean": [1, 0, 0], "std": [1, 2, 1], "layers": [first, {"weights": [[1, 0.5, 1]], "bias": [0, 0, 1]}]}
    )
    p, std, error95 = from_features(np.array([[2.0, 2.0, 0.1], [-9.0, 0.0, 0.1]]), network)
    # 2 (2 - 1) + 2 / 2 - 1 = 2; and nothing is below 0
    np.testing.assert_allclose(p, [1 / (1 + math.exp(-2)), 0.5], rtol=1e-6)
    np.testing.assert_allclose(std, [math.e - 0.02, 0.98], rtol=1e-6)
    np.testing.assert_allclose(error95, [math.exp(3) - 0.02, math.e - 0.02], rtol=1e-6)

"""The probability that a height is right to a metre, and how far off it may be."""

import numpy as np
import pytest

from sattools.prior.probability import height_errors, height_probability


def test_probability_grows_with_the_confidence_and_falls_with_the_cell() -> None:
    confidence = np.linspace(0, 1, 101, dtype=np.float32)[None]
    p = height_probability(confidence, 0.5)[0]
    assert (np.diff(p) > 0).all()
    # 1 / (1 + exp(1.025)), and sums of the other weights
    assert p[0] == pytest.approx(0.264, abs=5e-4)
    assert p[25] == pytest.approx(1 / (1 + np.exp(1.025 - 3.642 * 0.25 - 5.506 * 0.5)), abs=1e-4)
    assert p[100] == pytest.approx(0.9997, abs=2e-4)
    coarse = height_probability(confidence, 2.0)[0]
    assert (coarse < p).all()
    odds = [v / (1 - v) for v in (float(p[25]), float(coarse[25]))]
    assert np.log(odds[0] / odds[1]) == pytest.approx(2 * 0.7286, abs=1e-3)


def test_what_has_no_confidence_has_no_probability() -> None:
    confidence = np.full((3, 4), 0.5, np.float32)
    confidence[1, 2] = np.nan
    p = height_probability(confidence, 0.5)
    np.testing.assert_array_equal(np.isnan(p), np.isnan(confidence))
    assert p.dtype == np.float32


def test_errors_fall_with_the_confidence_and_grow_with_the_cell() -> None:
    confidence = np.linspace(0, 1, 101, dtype=np.float32)[None]
    std, error95 = (e[0] for e in height_errors(confidence, 0.5))
    assert std.dtype == error95.dtype == np.float32
    assert (np.diff(std) < 0).all()
    assert (np.diff(error95) < 0).all()
    assert std[[0, 25, 100]] == pytest.approx([10.14, 0.2486, 0.0223], rel=5e-3)
    assert error95[[0, 25, 100]] == pytest.approx([77.9, 1.294, 0.0313], rel=5e-3)
    coarse = height_errors(confidence, 2.0)[0][0]
    assert coarse / std == pytest.approx(np.exp(2 * 0.7217), rel=1e-4)

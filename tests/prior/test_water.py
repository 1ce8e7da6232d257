"""Water with waves, about which images do not agree, is laid level with its shore; other doubtful places stay."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sattools.prior.water import level_water
from sattools.scene.stored import StoredMap

CELL, SHAPE = 0.5, (240, 200)
WATER = slice(0, 90)  # columns, 45 m of 100 m


@pytest.fixture
def harbour() -> tuple[np.ndarray, np.ndarray]:
    """Heights and confidence: lumps of 6 m on water beside a quay at 2 m, with houses of 12 m on it."""
    rng = np.random.default_rng(0)
    height = np.full(SHAPE, 2.0, np.float32)
    height[40:80, 120:160] = height[140:200, 120:170] = 12.0
    confidence = np.full(SHAPE, 0.6, np.float32)
    lumps = rng.normal(0.0, 6.0, (SHAPE[0] // 4, 23)).repeat(4, axis=0).repeat(4, axis=1)
    height[:, WATER] = lumps[:, :90]
    confidence[:, WATER] = rng.uniform(0.0, 0.06, (SHAPE[0], 90))
    return height, confidence


def test_water_lies_level_with_its_quay_and_is_not_sure(harbour: tuple[np.ndarray, np.ndarray]) -> None:
    height, confidence = harbour
    before = height.copy()
    share = level_water(height, confidence, CELL)
    open_water = height[:, :80]
    np.testing.assert_allclose(open_water, 2.0, atol=1e-5)
    assert not confidence[:, :80].any()
    assert share == pytest.approx(90 / 200, abs=0.06)  # less a strip of up to 6 m along the quay
    np.testing.assert_array_equal(height[:, 96:], before[:, 96:])


def test_a_pier_stays(harbour: tuple[np.ndarray, np.ndarray]) -> None:
    height, confidence = harbour
    height[100:116, 30:90], confidence[100:116, 30:90] = 3.5, 0.6
    level_water(height, confidence, CELL)
    np.testing.assert_array_equal(height[100:116, 30:90], 3.5)
    assert (height[:80, :80] == 2.0).all()


def test_houses_at_the_water_keep_their_walls(harbour: tuple[np.ndarray, np.ndarray]) -> None:
    """Beside a height step no height is sure."""
    height, confidence = harbour
    height[20:60, 91:130], confidence[20:60, 91:130] = 15.0, 0.6
    confidence[20:60, 91:93] = 0.05
    level_water(height, confidence, CELL)
    np.testing.assert_array_equal(height[20:60, 91:130], 15.0)


def unsure_but_smooth(height: np.ndarray, confidence: np.ndarray) -> None:
    height[:, WATER] = 30.0  # a roof without texture, whose height its rims tell


def hillside(height: np.ndarray, confidence: np.ndarray) -> None:
    height[:, 90:] = np.linspace(0.0, 32.0, SHAPE[0])[:, None]  # of 15 degrees: its rim is no shore


def small(height: np.ndarray, confidence: np.ndarray) -> None:
    confidence[:, WATER] = 0.6
    confidence[40:80, 20:60] = 0.02  # 20 m by 20 m: a courtyard


def doubtful(height: np.ndarray, confidence: np.ndarray) -> None:
    confidence[:, WATER] = 0.15  # trees


def sea(height: np.ndarray, confidence: np.ndarray) -> None:
    confidence[:] = 0.02  # no shore


@pytest.mark.parametrize("change", [unsure_but_smooth, hillside, small, doubtful, sea])
def test_what_does_not_look_like_water_with_a_shore_stays(
    harbour: tuple[np.ndarray, np.ndarray], change: Callable[[np.ndarray, np.ndarray], None]
) -> None:
    height, confidence = harbour
    change(height, confidence)
    before = height.copy()
    assert level_water(height, confidence, CELL) == 0.0
    np.testing.assert_array_equal(height, before)


@pytest.mark.parametrize("shape", [(3, 3), (10, 200), (241, 203)])
def test_areas_of_any_size(shape: tuple[int, int]) -> None:
    level_water(np.zeros(shape, np.float32), np.zeros(shape, np.float32), CELL)


def test_maps_in_files_come_out_the_same(
    harbour: tuple[np.ndarray, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Band by band, so that areas larger than memory can be laid level, too."""
    stored = []
    for values in harbour:
        stored.append(StoredMap(SHAPE, np.float32, tmp_path))
        stored[-1][:] = values
    level_water(*harbour, CELL)
    monkeypatch.setattr("sattools.scene.stored.PIECE_CELLS", SHAPE[1] * 24)
    level_water(stored[0], stored[1], CELL)
    for found, expected in zip(stored, harbour, strict=True):
        np.testing.assert_array_equal(found[:], expected)

"""Few images that agree about little may differ more in brightness: one lies in clouds' shadows, another in haze."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rendered import RANGE, views_of

from sattools.prior.frame import Frame
from sattools.prior.matching import match as module
from sattools.prior.matching.match import _known_ground, how_unlike, match
from sattools.prior.matching.sweep import MatchTask
from sattools.prior.options import PriorOptions

PAIRS = np.array([(0, 1), (0, 2), (1, 2)])
SLOPES = [(0.0, 0.0), (0.5, 0.1), (-0.1, 0.5)]


@pytest.fixture(scope="module")
def house() -> Any:
    height = np.zeros((84, 60))
    height[20:42, 24:44] = 9.0
    return height, views_of(height, SLOPES)


def shaded(frame: Frame) -> Frame:
    """Every view with shadows and haze of its own, brighter and darker by a quarter of the range, waves of 25 m."""
    rows, cols = np.indices(frame.images.shape[1:])
    veils = [0.25 * np.sin(2 * np.pi * (rows * np.cos(a) + cols * np.sin(a)) / 50.0) for a in (0.3, 1.4, 2.5)]
    return replace(frame, images=(frame.images + np.stack(veils)).astype(np.float32))


@pytest.mark.parametrize(("share", "unlike"), [(0.0, 1.0), (0.5, 1.0), (0.65, 0.5), (0.75, 0.0), (1.0, 0.0)])
def test_what_images_agree_about_says_how_unlike_they_are(house: Any, share: float, unlike: float) -> None:
    _, frame = house
    height = np.zeros(frame.shape, np.float32)
    sure = np.arange(height.size).reshape(height.shape) < share * height.size
    assert how_unlike(frame, height, sure, 1.0) == pytest.approx(unlike, abs=0.01)  # a cell is 0.001 of it
    half = frame.masks.copy()
    half[1:, :, frame.margin + 30 :] = 0  # what one image shows says nothing
    alone = replace(frame, masks=half)
    assert how_unlike(alone, height, sure & (np.arange(60) < 30), 1.0) == pytest.approx(unlike, abs=0.03)


def test_images_that_nowhere_overlap_are_not_called_unlike(house: Any) -> None:
    _, frame = house
    alone = replace(frame, masks=frame.masks * np.array([1, 0, 0], np.uint8)[:, None, None])
    assert how_unlike(alone, np.zeros(frame.shape, np.float32), np.zeros(frame.shape, bool), 1.0) == 0.0


@pytest.mark.parametrize(("times", "sure", "brightness"), [(1, False, 0.2), (1, True, 0.1), (10, False, 0.1)])
def test_many_pairs_and_images_that_agree_keep_the_brightness_that_was_asked_for(
    house: Any, times: int, sure: bool, brightness: float
) -> None:
    _, frame = house
    task = MatchTask(frame, np.concatenate([PAIRS] * times), RANGE, 1.0, PriorOptions(), robust=times == 10)
    height = np.zeros(frame.shape, np.float32)
    known = _known_ground(task, height, height, np.full(frame.shape, sure))
    assert known.options.brightness == pytest.approx(brightness)


def test_three_images_in_shadows_and_haze_of_their_own_show_their_house(
    house: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    height, frame = house

    def error() -> float:
        return float(np.abs(match(shaded(frame), PAIRS, RANGE, PriorOptions()).height - height).mean())

    found = error()
    monkeypatch.setattr(module, "UNLIKE", 1.0)
    assert found < 0.9 * error()

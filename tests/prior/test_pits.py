"""A pit in a roof is closed where the views agree about the roof across it; a courtyard and a street stay open."""

from typing import Any

import numpy as np
import pytest
from rendered import RANGE, views_of

from sattools.prior.frame import Frame
from sattools.prior.matching.sweep import MatchTask
from sattools.prior.options import PriorOptions
from sattools.prior.visibility.occlusion import UNKNOWN, all_visible, compute_visibility
from sattools.prior.visibility.pits import close_pits

LEANS = [(0.0, 0.0), (0.25, 0.1), (-0.2, 0.25), (0.1, -0.3), (-0.5, 0.4), (0.5, 0.4), (-0.4, -0.5), (0.5, -0.4)]
PAIRS = np.array([(a, b) for a in range(8) for b in range(a + 1, 8)])
ROOF, PIT = np.s_[15:65, 15:65], np.s_[36:44, 24:54]  # the pit is 4 m wide
ROOF_M = 12.0


def block(hole: Any = None) -> np.ndarray:
    """A block of 25 m with a hole."""
    height = np.zeros((80, 80), np.float32)
    height[ROOF] = ROOF_M
    if hole is not None:
        height[hole] = 0.0
    return height


@pytest.fixture(scope="module")
def whole() -> Frame:
    return views_of(block(), LEANS)


def closed(frame: Frame, height: np.ndarray, dark: float = UNKNOWN) -> np.ndarray:
    """The heights after it, with what these heights hide; ``dark`` is how bright shadows are."""
    task = MatchTask(frame, PAIRS, RANGE, 1.0, PriorOptions(), robust=True)
    darks = np.full(len(LEANS), dark, np.float32)
    return close_pits(task, compute_visibility(frame, height, RANGE, 2.0, darks), height)


def test_a_pit_that_the_images_do_not_show_is_closed(whole: Frame) -> None:
    assert closed(whole, block(PIT))[PIT] == pytest.approx(ROOF_M)


def test_nothing_else_changes(whole: Frame) -> None:
    found = closed(whole, block(PIT))
    found[PIT] = 0.0
    assert (found == block(PIT)).all()


@pytest.mark.parametrize("hole", [PIT, np.s_[36:44, 15:65]], ids=["courtyard", "street"])
def test_a_hole_that_they_show_stays_open(hole: Any) -> None:
    assert (closed(views_of(block(hole), LEANS), block(hole)) == block(hole)).all()


def test_what_looks_like_shadow_stays_open(whole: Frame) -> None:
    """All that there is is darker than these shadows."""
    assert (closed(whole, block(PIT), dark=5.0) == block(PIT)).all()


def test_wider_holes_are_not_looked_at(whole: Frame) -> None:
    """But for their corners, into which the disk that closes pits does not go."""
    wide = block(np.s_[28:52, 24:54])  # 12 m
    found = closed(whole, wide)
    assert (found[32:48, 24:54] == 0).all()
    assert (found[28:52, 28:50] == 0).all()


def test_nor_is_what_is_half_open(whole: Frame) -> None:
    """The gap of 4 m between two walls of 4 m: along its other two sides there is no roof."""
    height = np.zeros((80, 80), np.float32)
    height[36:44, 30:33] = height[36:44, 41:44] = ROOF_M
    assert (closed(whole, height) == height).all()


def test_level_ground_is_left_as_it_is(whole: Frame) -> None:
    ground = np.zeros((80, 80), np.float32)
    task = MatchTask(whole, PAIRS, RANGE, 1.0, PriorOptions(), robust=True)
    assert close_pits(task, all_visible(whole), ground) is ground

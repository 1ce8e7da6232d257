"""Walls move to where the images change."""

from typing import Any

import numpy as np
import pytest

from sattools.prior.edges import snap_edges
from sattools.prior.frame import Frame

NOISE = 0.04


def a_frame(image: Any, views: Any = 3) -> Any:
    """The same picture from all views, straight from above: what is where does not depend on height."""
    rng = np.random.default_rng(0)
    images = np.stack([image + rng.normal(0, 0.01, image.shape) for _ in range(views)]).astype(np.float32)
    return Frame(images, np.ones(images.shape, np.uint8), np.zeros((views, 2)), 0.0, 0.5, 0, (None,) * views)


@pytest.fixture
def roof() -> Any:
    """A bright roof of 20 x 20 cells, 10 m high, on dark ground; and its true height."""
    height = np.zeros((40, 40), np.float32)
    height[10:30, 10:30] = 10.0
    return np.where(height > 5, 0.8, 0.2), height


def unseen(frame: Any) -> Any:
    return np.full(frame.images.shape, -1e9, np.float32)


def test_a_rim_that_looks_like_the_ground_is_lowered(roof: Any) -> None:
    image, true = roof
    wide = true.copy()
    wide[8:32, 8:32] = 10.0  # two cells too wide on every side
    frame = a_frame(image)
    found = snap_edges(frame, unseen(frame), wide, 2.0, NOISE)
    # the median filter at the end may round the four corners
    assert (found != true).sum() <= 4


def test_a_roofs_edge_that_was_lost_is_raised(roof: Any) -> None:
    image, true = roof
    narrow = np.zeros_like(true)
    narrow[12:28, 12:28] = 10.0
    frame = a_frame(image)
    found = snap_edges(frame, unseen(frame), narrow, 2.0, NOISE)
    # of 144 cells; six at each corner have too little of the roof around them
    assert (found != true).sum() <= 24


def test_where_both_sides_look_alike_nothing_moves(roof: Any) -> None:
    _, true = roof
    wide = true.copy()
    wide[8:32, 8:32] = 10.0
    frame = a_frame(np.full(true.shape, 0.5))
    found = snap_edges(frame, unseen(frame), wide, 2.0, NOISE)
    assert (found != wide).sum() <= 4


def test_views_that_do_not_see_a_cell_have_no_say(roof: Any) -> None:
    image, true = roof
    wide = true.copy()
    wide[8:32, 8:32] = 10.0
    frame = a_frame(image)
    blocked = unseen(frame)
    blocked[1:] = 99.0  # all but one view are blocked high above: one view alone decides nothing
    assert (snap_edges(frame, blocked, wide, 2.0, NOISE) != wide).sum() <= 4


@pytest.mark.parametrize(("disagreeing", "moves"), [(1, True), (2, False)])
def test_three_views_in_four_have_to_agree(roof: Any, disagreeing: Any, moves: Any) -> None:
    image, true = roof
    wide = true.copy()
    wide[8:32, 8:32] = 10.0
    frame = a_frame(image, views=4)
    # from these the rim looks as the roof does, and the ground around does not
    frame.images[:disagreeing, 8:32, 8:32] = 0.8
    found = snap_edges(frame, unseen(frame), wide, 2.0, NOISE)
    assert ((found != wide).sum() > 100) == moves


def test_slopes_and_low_steps_are_left_alone() -> None:
    slope = np.tile(np.linspace(0, 12, 40, dtype=np.float32), (40, 1))
    kerb = np.zeros((40, 40), np.float32)
    kerb[:, 20:] = 1.5
    image = np.random.default_rng(1).uniform(0, 1, (40, 40))
    for height in (slope, kerb):
        frame = a_frame(image)
        np.testing.assert_allclose(snap_edges(frame, unseen(frame), height, 2.0, NOISE), height, atol=0.31)

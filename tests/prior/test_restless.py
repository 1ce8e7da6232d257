"""What does not settle hides nothing."""

from typing import Any

import numpy as np
from rendered import RANGE, views_of
from test_weights import PAIRS, SLOPES, streets

from sattools.prior import PriorOptions
from sattools.prior.matching.match import match
from sattools.prior.visibility.occlusion import compute_visibility
from sattools.prior.visibility.restless import restless

CELL = 0.5


def test_woods_are_restless_and_the_ground_around_them_is_not() -> None:
    """Every other row of 70 m x 70 m changes by 5 m; so 0.35 of the box around a cell 10 m from two sides of it."""
    before = np.zeros((240, 240), np.float32)
    height = before.copy()
    height[40:180:2, 40:180] = 5.0
    found = restless(height, before, CELL)
    assert found[60:160, 60:160].all()
    assert not found[:20].any()
    assert not found[:, 200:].any()


def test_small_places_and_small_changes_are_left_alone() -> None:
    before = np.zeros((240, 240), np.float32)
    small, slight = before.copy(), before.copy()
    small[100:160, 100:160] = 20.0  # 900 m2
    slight[:] = 1.9
    assert not restless(small, before, CELL).any()
    assert not restless(slight, before, CELL).any()


def test_a_row_of_trees_is_not_a_wood() -> None:
    before = np.zeros((240, 240), np.float32)
    height = before.copy()
    height[:, 100:116] = 9.0  # 8 of the 30 m of the box
    assert not restless(height, before, CELL).any()


def occluders(pairs: Any, monkeypatch: Any) -> list[np.ndarray]:
    """The surfaces that hide, pass by pass, in a town that does not settle anywhere."""
    seen = []

    def spy(frame: Any, surface: Any, *rest: Any) -> Any:
        seen.append(surface)
        return compute_visibility(frame, surface, *rest)

    monkeypatch.setattr("sattools.prior.matching.match.compute_visibility", spy)
    monkeypatch.setattr("sattools.prior.matching.match.restless", lambda height, *_: np.ones(height.shape, bool))
    match(views_of(streets(), SLOPES), pairs, RANGE, PriorOptions())
    return seen


def test_what_does_not_settle_hides_nothing_from_the_second_pass_on(monkeypatch: Any) -> None:
    first, *later = occluders(PAIRS, monkeypatch)
    assert first.max() > 5.0
    assert later
    assert all(surface.max() < RANGE[0] for surface in later)


def test_few_pairs_settle_nowhere_and_are_not_asked(monkeypatch: Any) -> None:
    assert all(surface.max() > 5.0 for surface in occluders(PAIRS[:20], monkeypatch))

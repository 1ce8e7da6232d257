"""Heights between the planes of the matching."""

from typing import Any

import numpy as np
import pytest
from rendered import RANGE, views_of

from sattools.prior.matching import match as matching
from sattools.prior.matching.subplane import best_nearby, local_planes, refine_subplane
from sattools.prior.matching.sweep import MatchTask
from sattools.prior.neighbours import relief
from sattools.prior.options import PriorOptions
from sattools.prior.visibility.occlusion import all_visible

SLOPES = [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.4, -0.3), (0.3, -0.5)]
PAIRS = np.array([(a, b) for a in range(5) for b in range(a + 1, 5)])


@pytest.fixture(scope="module")
def ramp() -> Any:
    """Ground that rises by 4 m over 40 m: four planes of the matching."""
    height = np.tile(np.linspace(4.0, 8.0, 80), (60, 1))
    return height, views_of(height, SLOPES)


def inner(error: Any) -> Any:
    return np.abs(error[8:-8, 8:-8])


def test_ground_between_two_planes_is_found_there(ramp: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    height, frame = ramp
    error = inner(matching.match(frame, PAIRS, RANGE, PriorOptions()).height - height)
    monkeypatch.setattr(matching, "refine_subplane", lambda task, visibility, surface: surface)
    before = inner(matching.match(frame, PAIRS, RANGE, PriorOptions()).height - height)
    # views are painted in steps of 0.05 m; planes lie 1 m apart
    assert error.mean() < 0.06
    assert before.mean() > 1.5 * error.mean()


def test_a_surface_off_by_half_a_plane_comes_back(ramp: Any) -> None:
    height, frame = ramp
    off = (height + 0.5).astype(np.float32)
    found = refine_subplane(
        MatchTask(frame, PAIRS, (0.0, 1.0), 1.0, PriorOptions(), robust=False), all_visible(frame), off
    )
    assert np.median(inner(found - height)) < 0.05


def test_neighbours_on_another_surface_have_no_vote() -> None:
    surface = np.zeros((21, 21), np.float32)
    surface[:, 10:] = 9.0
    volume = np.zeros((21, 21, 5), np.float32)
    volume[:, :10, 1] = volume[:, 10:, 3] = 1.0  # the low half wants down, the high half up
    refined = np.empty_like(surface)
    best_nearby(
        np.ascontiguousarray(np.swapaxes(volume, 1, 2)), surface, np.array([-1.0, -0.5, 0.0, 0.5, 1.0]), 1.0, refined
    )
    np.testing.assert_allclose(refined - surface, np.where(surface > 5, 0.5, -0.5), atol=1e-6)


def test_where_no_height_is_better_the_surface_stays() -> None:
    surface = np.full((9, 9), 3.0, np.float32)
    refined = np.empty_like(surface)
    best_nearby(np.zeros((9, 5, 9), np.float32), surface, np.array([-1.0, -0.5, 0.0, 0.5, 1.0]), 1.0, refined)
    assert (refined == 3.0).all()


def test_a_slope_keeps_its_height_up_to_a_wall() -> None:
    """A mean of the neighbours would pull the rim of a sloping roof towards its middle."""
    surface = np.tile(np.arange(20) * 0.1, (15, 1)).astype(np.float32)
    surface[:, 10:] += 8.0
    smooth = np.empty_like(surface)
    local_planes(surface, 1.0, smooth)
    np.testing.assert_allclose(smooth, surface, atol=1e-5)  # single precision at 10 m


def test_neighbours_up_a_steep_slope_of_wide_cells_are_of_the_same_surface() -> None:
    """40 degrees rise by 1.2 m from cell to cell of 1.4 m, more than two sides of a wall of narrow cells may differ."""
    slope = np.tile(1.2 * np.arange(40.0), (30, 1))
    noisy = (slope + np.random.default_rng(0).normal(0, 0.3, slope.shape)).astype(np.float32)
    apart, together = np.empty_like(noisy), np.empty_like(noisy)
    local_planes(noisy, 1.0, apart)
    local_planes(noisy, relief(1.4), together)
    # within 1 m only cells along the contour are neighbours, within 2 m three times as many
    assert inner(together - slope).mean() < 0.8 * inner(apart - slope).mean()

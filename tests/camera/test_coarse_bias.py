"""Shifts of views against each other, from the shifts of pairs across the direction of height."""

import numpy as np
import pytest

from sattools.camera.tiepoints import coarse_bias

ALONG = np.array([0.18, 0.98]) / np.hypot(0.18, 0.98)


def of_pairs(tangents: np.ndarray, errors: np.ndarray, noise: float) -> np.ndarray:
    """What all pairs of views show: errors across the direction of height of a pair alone, with noise [m]."""
    rng = np.random.default_rng(0)
    pairs = [(a, b) for a in range(len(tangents)) for b in range(a + 1, len(tangents))]
    shifts = []
    for a, b in pairs:
        run = tangents[b] - tangents[a]
        across = np.array([[-run[1], run[0]]]) / np.hypot(*run)
        shifts.append((across, across @ (errors[b] - errors[a]) + rng.normal(0, noise, 1), 20.0))
    return coarse_bias(pairs, shifts, tangents)


def test_views_of_one_pass_are_not_moved_along_it_by_what_they_cannot_tell() -> None:
    """Their directions of height differ by 3 minutes of arc: errors of 0.05 m would be many metres along them."""
    away = np.linspace(-0.5, 0.5, 6)
    tangents = away[:, None] * ALONG + np.outer(away**2, [0.001, 0.0])
    across = np.array([-ALONG[1], ALONG[0]])
    errors = np.array([0.0, 2.0, -1.0, 0.5, 3.0, -2.0])[:, None] * across
    found = of_pairs(tangents, errors, 0.05)
    assert np.abs(found).max() < 5.0
    differences = (found - found[0]) @ across
    assert differences == pytest.approx([0.0, 2.0, -1.0, 0.5, 3.0, -2.0], abs=0.2)


def test_views_from_all_around_are_told_apart_in_both_directions() -> None:
    turn = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    tangents = 0.4 * np.stack([np.cos(turn), np.sin(turn)], axis=1) * np.linspace(0.6, 1.0, 6)[:, None]
    errors = np.array([[0.0, 0.0], [2.0, -1.0], [0.5, 3.0], [-2.0, 0.0], [0.0, 0.5], [1.0, 1.0]])
    found = of_pairs(tangents, errors, 0.0)
    # a common movement, height included, cannot be seen
    movement = np.concatenate([np.tile(np.eye(2), (6, 1, 1)), tangents[:, :, None]], axis=2).reshape(12, 3)
    left = (found - errors).reshape(12)
    left = left - movement @ np.linalg.lstsq(movement, left, rcond=None)[0]
    assert np.abs(left).max() < 0.05

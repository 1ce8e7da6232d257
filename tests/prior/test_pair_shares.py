"""Pairs whose images are not alike, or look from nearly one direction, count less."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rendered import RANGE, views_of
from test_weights import PAIRS, SLOPES, streets

from sattools.prior import PriorOptions
from sattools.prior.matching import weights
from sattools.prior.matching.match import match
from sattools.prior.matching.weights import LEAST, likeness, pair_shares
from sattools.prior.reference import agreement
from sattools.prior.visibility.occlusion import all_visible

LEVEL = np.zeros((40, 40))
ALL_SURE = np.ones(LEVEL.shape, bool)


def of_two_seasons(height: Any, slopes: Any) -> Any:
    """Every other view shows the same surface with another texture."""
    summer, winter = views_of(height, slopes), views_of(height, slopes, seed=1)
    images = np.where((np.arange(len(slopes)) % 2 == 0)[:, None, None], summer.images, winter.images)
    return replace(summer, images=images - images.mean())


def shares_of(frame: Any, pairs: Any, sure: Any = ALL_SURE) -> Any:
    height = np.zeros(frame.shape, np.float32)
    return np.array(pair_shares(frame, all_visible(frame), height, sure, np.array(pairs), PriorOptions()))


def test_pairs_of_one_season_count_most() -> None:
    """The agreement of two textures that have nothing in common is 0.2 here; so one of them counts 0.1, the least."""
    frame = of_two_seasons(LEVEL, [(0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3)])
    alike = shares_of(frame, [(0, 2), (1, 3), (0, 1), (2, 3), (0, 3), (1, 2)])
    assert alike == pytest.approx([1, 1, LEAST, LEAST, LEAST, LEAST], abs=0.05)


def test_of_pairs_that_are_alike_each_counts_by_its_angle() -> None:
    """Tangents of 0.1, 0.2 and 0.4 to either side: 11.42, 22.62 and 43.60 degrees."""
    frame = views_of(LEVEL, [(side * slope, 0.0) for slope in (0.2, 0.4, 0.8) for side in (1, -1)])
    frame = replace(frame, images=frame.images - frame.images.mean())
    found = shares_of(frame, [(0, 1), (2, 3), (4, 5)])
    assert found == pytest.approx([(11.42 / 43.60) ** 0.75, (22.62 / 43.60) ** 0.75, 1.0], rel=0.1)


def test_likeness_is_the_mean_of_the_twins_agreement() -> None:
    rng = np.random.default_rng(0)
    value = rng.normal(0, 0.05, (2, 30, 30)).astype(np.float32)
    value[1] += value[0]
    shown = np.pad(np.ones((2, 28, 28), bool), ((0, 0), (1, 1), (1, 1)))
    shown[0, :, :4] = False
    options = PriorOptions()
    windows = [  # those that both show as a whole
        agreement(
            *(one[r - 1 : r + 2, c - 1 : c + 2].astype(float) for one in value), options.noise, options.brightness
        )
        for r in range(2, 28)
        for c in range(5, 28)
    ]
    found = likeness(value, shown, np.array([(0, 1)]), options)
    assert found == pytest.approx([np.mean(windows)], rel=1e-4)  # single precision


def test_pairs_of_which_little_is_known_count_by_their_angles() -> None:
    """17.06 and 12.04 degrees."""
    frame = of_two_seasons(LEVEL, [(0.3, 0.0), (-0.3, 0.0), (0.0, 0.3)])
    found = shares_of(frame, [(0, 1), (0, 2)], np.zeros(LEVEL.shape, bool))
    assert found == pytest.approx([1.0, (12.04 / 17.06) ** 0.75], abs=0.001)


def test_a_town_of_four_seasons_is_better_by_it(monkeypatch: Any) -> None:
    """Three noisy views of each: it was 2.01 m, is 1.33 m."""
    height = streets()
    seasons = [views_of(height, SLOPES, seed=season) for season in range(4)]
    images = np.stack([seasons[view // 3].images[view] for view in range(len(SLOPES))])
    images = images - images.mean() + np.random.default_rng(5).normal(0, 0.1, images.shape)
    frame = replace(seasons[0], images=images.astype(np.float32))

    def error() -> float:
        return float(np.abs(match(frame, PAIRS, RANGE, PriorOptions()).height - height).mean())

    found = error()
    monkeypatch.setattr(weights, "LEAST", 1.0)  # all pairs count alike
    assert found < 0.75 * error()


def test_few_pairs_are_all_needed(monkeypatch: Any) -> None:
    asked = []
    monkeypatch.setattr("sattools.prior.matching.match.pair_shares", lambda *_: asked.append(1))
    match(views_of(LEVEL, SLOPES[:6]), PAIRS[PAIRS.max(axis=1) < 6], RANGE, PriorOptions())
    assert not asked

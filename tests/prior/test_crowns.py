"""Crowns that a part of the images shows without leaves."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rendered import RANGE, views_of
from test_weights import PAIRS, SLOPES

from sattools.prior import PriorOptions
from sattools.prior.matching import match as stage
from sattools.prior.matching.match import match
from sattools.prior.matching.sweep import MatchTask, pair_weights
from sattools.prior.visibility.crowns import with_crowns

WINTER = (0, 1, 2, 3)  # of twelve views
TOP = 8.0
LEAVES, NOISE = 0.05, 0.05


def a_tree() -> Any:
    """A crown of 9 m on level ground, half an ellipsoid."""
    row, col = np.indices((96, 96)) - 47.5
    share = 1 - (row**2 + col**2) * 0.25 / 7.0**2
    return np.where(share > 0, 4.0 + (TOP - 4.0) * np.sqrt(np.maximum(share, 0)), 0.0)


CROWN = a_tree() > 0


def seasons(winter: tuple[int, ...], seed: int = 0) -> Any:
    """Views of the tree, of which the winter's show the ground alone; of leaves no two views show just the same."""
    rng = np.random.default_rng(seed)
    bare, leafy = views_of(np.zeros((96, 96)), SLOPES), views_of(a_tree(), SLOPES, seed=1)
    crown = np.abs(views_of(a_tree(), SLOPES).images - bare.images) > 1e-3
    leaves = leafy.images + rng.normal(0, LEAVES, leafy.images.shape)
    images = np.where(crown, leaves, bare.images).astype(np.float32)
    images[list(winter)] = bare.images[list(winter)]
    images += rng.normal(0, NOISE, images.shape).astype(np.float32)
    return replace(bare, images=images)


def heights(frame: Any, pairs: Any = PAIRS) -> Any:
    """Mean height of the crown and of the ground."""
    found = match(frame, pairs, RANGE, PriorOptions()).height
    return found[CROWN].mean(), np.abs(found[~CROWN]).mean()


def without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "bare_crowns", lambda *_: None)


def test_a_tree_that_is_bare_in_a_third_of_the_images_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    found = heights(seasons(WINTER))
    without(monkeypatch)
    lost = heights(seasons(WINTER))
    print(found, lost, a_tree()[CROWN].mean())
    assert 0


def test_no_leaves_no_crown() -> None:
    print(heights(seasons(tuple(range(12)))), heights(seasons(())), heights(seasons(tuple(range(8)))))
    assert 0

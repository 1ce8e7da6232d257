"""Crowns that a part of the images shows without leaves."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rendered import CELL, RANGE, views_of
from test_weights import PAIRS, SLOPES

from sattools.prior import PriorOptions
from sattools.prior.matching import match as stage
from sattools.prior.matching.match import match
from sattools.prior.matching.sweep import MatchTask, pair_weights
from sattools.prior.visibility import crowns
from sattools.prior.visibility.courtyards import RoughSurface
from sattools.prior.visibility.crowns import bare_crowns, with_crowns
from sattools.prior.visibility.occlusion import all_visible

LEAVES, NOISE = 0.05, 0.08  # of leaves, which no two views show just alike, and of every view
GROUND = np.zeros((96, 96))


def a_tree() -> Any:
    """A crown of 14 m on level ground, 8 m high."""
    row, col = np.indices(GROUND.shape) - 47.5
    share = 1 - (row**2 + col**2) * CELL**2 / 7.0**2
    return np.where(share > 0, 4.0 + 4.0 * np.sqrt(np.maximum(share, 0)), 0.0)


CROWN = a_tree() > 0


def seasons(bare: tuple[int, ...]) -> Any:
    """Twelve views of the tree, some of which show the ground alone."""
    rng = np.random.default_rng(0)
    winter, summer = views_of(GROUND, SLOPES), views_of(a_tree(), SLOPES, seed=1)
    crown = np.abs(views_of(a_tree(), SLOPES).images - winter.images) > 1e-3
    leaves = summer.images + rng.normal(0, LEAVES, crown.shape)
    images = np.where(crown, leaves, winter.images)
    images[list(bare)] = winter.images[list(bare)]
    return replace(winter, images=(images + rng.normal(0, NOISE, crown.shape)).astype(np.float32))


def crown_of(frame: Any, pairs: Any = PAIRS) -> float:
    """Mean height found where the crown is."""
    return float(match(frame, pairs, RANGE, PriorOptions()).height[CROWN].mean())


def test_a_tree_that_is_bare_in_a_quarter_of_the_images_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """5.5 m of 6.7; without it a third of the crown is lost, in the mean 4.6 m are found."""
    frame = seasons((0, 1, 2))
    found = crown_of(frame)
    monkeypatch.setattr(stage, "bare_crowns", lambda *_: None)
    assert found > crown_of(frame) + 0.5


@pytest.mark.parametrize("bare", [(), tuple(range(12))])
def test_where_all_images_show_the_same_nothing_changes(bare: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = seasons(bare)
    found = match(frame, PAIRS, RANGE, PriorOptions()).height
    monkeypatch.setattr(stage, "bare_crowns", lambda *_: None)
    assert np.array_equal(found, match(frame, PAIRS, RANGE, PriorOptions()).height)


def test_few_pairs_are_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "bare_crowns", lambda *_: pytest.fail("was asked"))
    crown_of(seasons((0, 1, 2)), PAIRS[:20])


def test_most_pairs_count_where_a_crown_is_looked_for() -> None:
    """By their root mean square, with hidden views as in any pass; else by their sixth power."""
    task = MatchTask(views_of(GROUND, SLOPES), PAIRS, RANGE, 1.0, PriorOptions(), robust=True)
    assert pair_weights(task)[0] == 3
    assert pair_weights(replace(task, by_most=True)) == (1, *pair_weights(task)[1:])


# What is asked of a crown: here 9 x 9 cells that lie 8 m above level ground, which every view sees in the sun.
BLOCK = np.s_[20:29, 20:29]


def case(**changed: Any) -> Any:
    """What `bare_crowns` makes of it, of other heights, agreement, score, images, first hits or shadows."""
    frame = views_of(GROUND, SLOPES)
    frame = replace(frame, images=(0.1 * frame.images).astype(np.float32))
    if "unlike" in changed:
        factor = np.linspace(0, 1, len(SLOPES), dtype=np.float32)[:, None, None]
        frame = replace(frame, images=frame.images + changed["unlike"] * factor)
    high = np.zeros(GROUND.shape, np.float32)
    high[BLOCK] = 8.0
    high = changed.get("high", high)
    visibility = all_visible(frame)
    if "shadow" in changed:
        visibility.shadow_height[: changed["shadow"]] = 10.0
    if "hidden" in changed:
        visibility.first_hit_height[: changed["hidden"]] = 4.0
    ground = np.zeros(GROUND.shape, np.float32)
    score = np.full(GROUND.shape, changed.get("score", 0.55), np.float32)
    agreed = np.full(GROUND.shape, changed.get("agreed", 0.45), np.float32)
    task = MatchTask(frame, PAIRS, RANGE, 1.0, PriorOptions(), robust=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(crowns, "sweep_blocks", lambda *_, **__: (high, agreed, agreed))
        surface = RoughSurface(ground, score, ground, visibility)
        return bare_crowns(task, surface, changed.get("restless"))


def test_a_crown_has_its_heights_and_nothing_else_has_any() -> None:
    found = case()
    assert (found[21:28, 21:28] == 8.0).all()
    assert np.isnan(found[:20]).all()
    assert np.isnan(found[:, 29:]).all()


def narrow() -> Any:
    high = np.zeros(GROUND.shape, np.float32)
    high[40:43, :] = 8.0  # 1.5 m
    return high


def lumps() -> Any:
    high = np.zeros(GROUND.shape, np.float32)
    high[20:32, 20:26], high[20:32, 26:32] = 4.0, 16.0
    return high


@pytest.mark.parametrize(
    "changed",
    [
        {"agreed": 0.34},  # as by chance
        {"score": 0.65},  # other pairs agree about the ground as about streets
        {"shadow": 6},  # half of the views show it in shadow, too
        {"hidden": 2},  # two of twelve do not see the ground
        {"unlike": 0.5},  # images are not as bright
        {"restless": np.ones(GROUND.shape, bool)},
        {"high": narrow()},
        {"high": lumps()},
        {"high": np.full(GROUND.shape, 1.5, np.float32)},  # a shrub
        {"high": np.full(GROUND.shape, 35.0, np.float32)},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_what_is_no_crown(changed: Any) -> None:
    assert case(**changed) is None


def test_a_surface_keeps_what_it_has() -> None:
    height, lacking = np.array([[0.0, 7.0, 9.0, 3.0]]), np.array([[8.0, 8.0, 8.0, np.nan]])
    assert with_crowns(height, lacking).tolist() == [[8.0, 7.0, 9.0, 3.0]]

"""The left-right check on the ground grid: rays, consistent views, and what is filled."""

from dataclasses import replace
from typing import Any

import numpy as np

from sattools.prior.frame import Frame
from sattools.prior.visibility.consistency import (
    RayMinima,
    count_consistent_views,
    filled,
    own_pixel_votes,
    standing,
    supported,
    typical_look,
    update_minima,
)
from sattools.prior.visibility.occlusion import UNKNOWN

HEIGHTS = np.array([0.0, 2.0])
MARGIN = 2


def frame() -> Any:
    """A vertical view of one row of five cells, and one in which 2 m of height move a point by one column."""
    shape = (2, 1 + 2 * MARGIN, 5 + 2 * MARGIN)
    slopes = np.array([[0.0, 0.0], [0.0, 0.5]])
    return Frame(np.zeros(shape, np.float32), np.ones(shape, np.uint8), slopes, 0.0, 1.0, MARGIN, (None, None))


def followed(cost: Any) -> Any:
    """The rays of `frame` after a cost ``[5][2]`` of the five cells at both heights."""
    minima = RayMinima.unknown(frame())
    volume = np.array(cost, np.float32).T[None]
    update_minima(volume, frame().parallax, HEIGHTS, 0.0, MARGIN, MARGIN, minima.cost, minima.height)
    return minima


def bear_witness(minima: Any, height: Any, first_hit_height: Any = None) -> Any:
    f = frame()
    first_hit_height = np.full(f.images.shape, UNKNOWN, np.float32) if first_hit_height is None else first_hit_height
    return count_consistent_views(f, first_hit_height, minima, np.array([height], np.float32), tolerance=0.5, step=0.5)


# the second cell is a roof of 2 m, all others lie on the ground
ROOF = [[1, 5], [4, 0], [1, 5], [1, 5], [1, 5]]


def test_every_ray_keeps_its_cheapest_place() -> None:
    minima = followed(ROOF)
    # the leaning view shows the roof where the ground of the third cell would be
    np.testing.assert_array_equal(minima.height[0, MARGIN, MARGIN : MARGIN + 5], [0, 2, 0, 0, 0])
    np.testing.assert_array_equal(minima.height[1, MARGIN, MARGIN : MARGIN + 5], [0, 0, 2, 0, 0])
    assert minima.cost[1, MARGIN, MARGIN + 2] == 0
    assert np.isnan(minima.height[1, MARGIN, 0]), "no cell lies on this ray"


def test_blocks_leave_the_rays_as_the_whole_does() -> None:
    whole, parts = followed(ROOF), RayMinima.unknown(frame())
    volume = np.array(ROOF, np.float32).T[None]
    for first, last in ((3, 5), (0, 3)):
        at = (MARGIN, MARGIN + first)
        update_minima(volume[..., first:last], frame().parallax, HEIGHTS, 0.0, *at, parts.cost, parts.height)
    np.testing.assert_array_equal(parts.cost, whole.cost)
    np.testing.assert_array_equal(parts.height, whole.height)


def test_ground_whose_pixel_shows_the_roof_loses_a_witness() -> None:
    agreeing, views = bear_witness(followed(ROOF), [0, 2, 0, 0, 0])
    np.testing.assert_array_equal(agreeing, [[2, 2, 1, 2, 2]])
    np.testing.assert_array_equal(views, [[2, 2, 2, 2, 2]])


def test_a_view_that_cannot_see_the_place_is_no_witness() -> None:
    first_hit_height = np.full(frame().images.shape, UNKNOWN, np.float32)
    first_hit_height[1, MARGIN, MARGIN + 3] = 9.0
    agreeing, views = bear_witness(followed(ROOF), [0, 2, 0, 0, 0], first_hit_height)
    np.testing.assert_array_equal(agreeing, [[2, 2, 1, 1, 2]])
    np.testing.assert_array_equal(views, [[2, 2, 2, 1, 2]])


def test_heights_up_to_three_planes_apart_are_one_place() -> None:
    assert bear_witness(followed(ROOF), [1.5, 2, 0, 0, 0])[0][0, 0] == 2
    assert bear_witness(followed(ROOF), [1.6, 2, 0, 0, 0])[0][0, 0] == 0


def test_a_hole_beside_a_wall_takes_the_ground() -> None:
    height = np.zeros((9, 9), np.float32)
    height[:, :4] = 10.0  # a house to the left of a hole of one column
    stands = np.ones(height.shape, bool)
    stands[:, 4] = False
    height[:, 4] = 7.0
    expected = np.where(np.arange(9) < 4, 10.0, 0.0)
    np.testing.assert_array_equal(filled(height, stands, 1.0)[4], expected)


def test_one_or_two_low_strays_do_not_fill_a_roof() -> None:
    height = np.full((9, 9), 10.0, np.float32)
    height[0, 4] = height[4, 0] = -3.0
    height[4, 4] = 20.0
    stands = np.ones(height.shape, bool)
    stands[1:8, 1:8] = False
    assert filled(height, stands, 1.0)[4, 4] == 10.0


def test_nothing_beyond_twenty_metres_fills_a_hole() -> None:
    height = np.full((1, 40), 7.0, np.float32)
    stands = np.zeros(height.shape, bool)
    height[0, 30], stands[0, 30] = 3.0, True
    fine, coarse = filled(height, stands, 1.0)[0], filled(height, stands, 2.0)[0]
    assert (fine[10], fine[9]) == (3.0, 7.0)
    assert (coarse[20], coarse[19]) == (3.0, 7.0)


def readable_votes(
    value: np.ndarray, seen: np.ndarray, best: np.ndarray, height: np.ndarray, parallax: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray]:
    """The twin of `typical_look` and `own_pixel_votes` that can be read."""
    look = np.nanmedian(np.where(seen, value, np.nan), axis=0)
    look[seen.sum(axis=0) < 4] = np.nan
    votes = np.zeros(seen.shape, bool)
    for v, row, col in zip(*np.nonzero(seen & (best < height)), strict=True):
        rise = height[row, col] - best[v, row, col]
        r, c = (round(at + per_metre * rise) for at, per_metre in zip((row, col), parallax[v], strict=True))
        if not (0 <= r < height.shape[0] and 0 <= c < height.shape[1]) or abs(height[r, c] - best[v, row, col]) > near:
            continue
        unlike = abs(value[v, row, col] - look[r, c]) - 0.1
        votes[v, row, col] = abs(value[v, row, col] - look[row, col]) < 0.25 * unlike
    return look, votes


def test_pixels_vote_as_in_the_readable_twin() -> None:
    rng = np.random.default_rng(4)
    shape = (5, 12, 14)
    height = rng.choice([0.0, 6.0], shape[1:]).astype(np.float32)
    value = (0.2 + 0.5 * (height > 3) + rng.normal(0, 0.05, shape)).astype(np.float32)
    seen = rng.random(shape) < 0.8
    seen[0] = True
    best = rng.choice([0.0, 6.0, np.nan], shape).astype(np.float32)
    parallax = rng.uniform(-0.5, 0.5, (5, 2))
    look, votes = readable_votes(value, seen, best, height, parallax, 1.5)
    found, agree = np.empty_like(height), np.zeros(shape, bool)
    typical_look(value, seen, found)
    own_pixel_votes(value, seen, found, best, height, parallax, np.float32(1.5), agree)
    np.testing.assert_allclose(found, look, atol=1e-6)
    np.testing.assert_array_equal(agree, votes)
    assert 20 < votes.sum() < seen.sum() / 2


def crown_votes(times: int) -> list[int]:
    """Votes for a dark crown on bright ground, by two views that were taken so many times; the best place is below."""
    f = frame()
    height = np.array([[0, 2, 0, 0, 0]], np.float32)
    crown = np.full(f.images.shape, 0.6, np.float32)
    for image, columns in zip(crown, (slice(2, 5), slice(3, 6)), strict=True):
        image[:, columns] = 0.0  # two metres of height are one column of the second view
    many = replace(
        f,
        images=np.concatenate([crown] * times),
        masks=np.concatenate([f.masks] * times),
        parallax=np.concatenate([f.parallax] * times),
        suns=f.suns * times,
    )
    flat = RayMinima(np.zeros(many.images.shape, np.float32), np.zeros(many.images.shape, np.float32))
    hits = np.full(many.images.shape, UNKNOWN, np.float32)
    votes = count_consistent_views(many, hits, flat, height, tolerance=0.5, step=0.5)[0]
    return [int(v) for v in votes[0]]


def test_a_tree_stays_though_the_ground_behind_it_agrees_better() -> None:
    # the view from straight above has no vote: what is below the crown is the crown's own cell
    assert crown_votes(times=2) == [4, 2, 4, 4, 4]


def test_of_few_views_none_has_a_vote() -> None:
    """The median of two or three would be the pixel itself."""
    assert crown_votes(times=1) == [2, 0, 2, 2, 2]


def test_cells_in_which_two_views_agree_by_chance_do_not_stand() -> None:
    height = np.zeros((40, 40), np.float32)
    agreeing, views = np.full((40, 40), 2, np.uint8), np.full((40, 40), 3, np.uint8)
    agreeing[10:30, 10:30] = 1  # a place about which the views disagree,
    chance = np.random.default_rng(0).random((40, 40)) < 0.1
    agreeing[chance] = 2  # but for a tenth of its cells, at any height
    height[10:30, 10:30] = -50.0
    inside = np.s_[13:27, 13:27]
    stands = supported(standing(agreeing, views), height, agreeing, 0.5)
    assert not stands[inside].any()
    assert stands[:8].all()
    assert (filled(height, stands, 0.5)[inside] == 0.0).all()
    assert (filled(height, 2 * agreeing > views, 0.5)[inside] == -50.0).any()


def test_cells_stand_together_at_one_height() -> None:
    agreeing, stands = np.full((20, 20), 2, np.uint8), np.ones((20, 20), bool)
    height = np.random.default_rng(0).uniform(-100, 100, (20, 20)).astype(np.float32)
    slope = np.float32(0.7) * np.arange(20, dtype=np.float32)[:, None] * np.ones((1, 20), np.float32)
    for shaded in (None, np.zeros((20, 20), bool), np.ones((20, 20), bool)):
        assert not supported(stands, height, agreeing, 1.0, shaded).any()
        assert supported(stands, slope, agreeing, 1.0, shaded).all()


def test_what_is_taken_to_stand_needs_support_like_the_others() -> None:
    nothing = np.zeros((20, 20), np.uint8)
    taken = np.zeros((20, 20), bool)
    taken[10:] = True
    taken[3, 3] = True
    stands = supported(standing(nothing, nothing, taken), np.zeros((20, 20), np.float32), nothing, 1.0)
    assert stands[11:].all()
    assert not stands[:9].any()


def test_four_views_of_many_agree_for_a_reason() -> None:
    """So small parts keep heights of their own; in shadow, where all looks alike, among others that stand only."""
    height = np.zeros((40, 40), np.float32)
    height[10:12, 10:12] = 9.0  # a chimney
    height[20:36, 20:36] = 12.0
    views, agreeing = np.full((40, 40), 9, np.uint8), np.full((40, 40), 6, np.uint8)
    agreeing[20:36, 20:36] = 1  # a place about which the views disagree, but for one cell
    agreeing[28, 28] = 6
    stands, light = standing(agreeing, views), np.zeros((40, 40), bool)
    for shaded, alone in ((light, True), (~light, False)):
        found = supported(stands, height, agreeing, 0.5, shaded)
        assert found[10:12, 10:12].all()
        assert found[28, 28] == alone
    assert not supported(stands, height, agreeing, 0.5)[10:12, 10:12].any()


def test_most_of_the_views_must_agree() -> None:
    agreeing = np.array([[0, 2, 3]], np.uint8)
    assert standing(agreeing, np.full((1, 3), 5, np.uint8)).tolist() == [[False, False, True]]

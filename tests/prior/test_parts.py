"""Choice of pairs, planes, normals, confidence: pure functions with answers known by hand."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sattools.prior.confidence import match_confidence
from sattools.prior.frame import Frame
from sattools.prior.matching.match import Match, for_hills, margin_for, plane_distance
from sattools.prior.matching.pairs import angle_deg, choose_pairs
from sattools.prior.matching.penalties import penalties, scarcity
from sattools.prior.matching.sweep import narrow, planes
from sattools.prior.normals import normals
from sattools.prior.options import PriorOptions
from sattools.prior.tones import LINEAR_TONE, tone_of, toned, toned_views, with_contrast
from sattools.prior.visibility.occlusion import disk
from sattools.views.resample import View


def lean(angle: Any) -> Any:
    """Slope of a view that leans eastward by an angle in degrees."""
    return (math.tan(math.radians(angle)), 0.0)


def sun(azimuth: Any) -> Any:
    a = math.radians(azimuth)
    return (0.7 * math.sin(a), 0.7 * math.cos(a), math.sqrt(0.51))


def test_the_angle_between_two_views() -> None:
    assert angle_deg((*lean(-10), 1.0), (*lean(15), 1.0)) == pytest.approx(25.0)


def test_pairs_of_one_sun_come_before_the_ideal_angle() -> None:
    slopes = [lean(0), lean(25), lean(20), lean(38)]
    suns = [sun(100), sun(160), sun(100), sun(160)]
    # (0, 2) and (1, 3) share their sun; (0, 1) has the ideal angle but suns some 41 degrees apart
    pairs = choose_pairs(slopes, suns, 3, limits=(12, 40))
    assert pairs[:2].tolist() == [[0, 2], [1, 3]]


def test_pairs_outside_the_limits_are_taken_only_for_want_of_others() -> None:
    many = [lean(a) for a in (0, 20, 25, 28, 60)]
    assert 4 not in choose_pairs(many, [None] * 5, 10, limits=(12, 40))[:, 0:2][:3]
    one_pass = [lean(-6), lean(0), lean(6.5)]  # as of a Pleiades triplet
    assert choose_pairs(one_pass, [None] * 3, 25, limits=(12, 40)).tolist() == [[0, 2], [1, 2], [0, 1]]
    assert choose_pairs([lean(0), lean(7)], [None, None], 25, limits=(12, 40)).tolist() == [[0, 1]]


def test_a_few_narrow_pairs_come_to_the_others_to_look_into_courts() -> None:
    slopes = [lean(a) for a in (-30, -24, -16.5, -8, 0, 8, 20.5)]
    pairs = choose_pairs(slopes, [None] * 7, 12, limits=(12, 40))
    angles = [angle_deg((*slopes[a], 1.0), (*slopes[b], 1.0)) for a, b in pairs]
    assert all(12 <= a <= 40 for a in angles[:12])
    assert angles[12:] == pytest.approx([8.5, 8.0])  # one for six, the nearest to 25 degrees; (0, 1) has 6


def test_views_from_one_direction_make_no_pair() -> None:
    assert choose_pairs([lean(10), lean(10.5)], [None, None], 25).shape == (0, 2)


def test_unknown_suns_leave_the_choice_to_the_angle() -> None:
    assert choose_pairs([lean(0), lean(24), lean(35)], [None] * 3, 1).tolist() == [[0, 1]]


def test_planes_reach_one_step_beyond_the_range() -> None:
    assert planes((10.0, 13.0), 1.0).tolist() == [9.0, 10.0, 11.0, 12.0, 13.0, 14.0]
    assert len(planes((10.0, 10.5), 4.0)) >= 3


def test_planes_stand_two_cells_apart_or_as_far_as_the_best_pair_needs() -> None:
    frame = Frame(
        np.zeros((3, 4, 4)),
        np.ones((3, 4, 4)),
        np.array([(0.0, 0.0), (0.8, 0.0), (0.0, 0.1)]),
        0.0,
        0.5,
        0,
        (None,) * 3,
    )
    assert plane_distance(frame, np.array([(0, 1), (0, 2)])) == pytest.approx(1.25)  # 0.8 cells a metre
    assert plane_distance(frame, np.array([(0, 2)])) == pytest.approx(10.0)
    wide = replace(frame, parallax=frame.parallax * 10)
    assert plane_distance(wide, np.array([(0, 1)])) == 1.0


def test_the_margin_holds_the_farthest_displacement() -> None:
    # 0.5 cells a metre over 60 m = 30 cells, 2 cells of window either side, some for rounding
    assert 34 <= margin_for(np.array([(0.5, -0.2)]), 20.0, (0.0, 80.0), 2) <= 40


def test_the_height_range_closes_on_what_was_found_but_for_strays() -> None:
    heights = np.concatenate([np.linspace(100, 120, 5000), np.full(20, 900.0), np.full(20, -50.0)])
    low, high = narrow(heights, (-100.0, 1000.0), 5.0, 1.0)
    assert 94.9 < low <= 95.1
    assert 124.9 <= high < 125.1
    assert narrow(heights[:50], (-100.0, 1000.0), 5.0, 1.0) == (-100.0, 1000.0)  # too few to say
    assert narrow(heights, (98.0, 119.0), 5.0, 1.0) == (98.0, 119.0)  # never wider than before


def test_a_disk_of_one_cell_is_a_cross() -> None:
    assert disk(1.0).astype(int).tolist() == [[0, 1, 0], [1, 1, 1], [0, 1, 0]]


def test_halving_keeps_a_point_where_it_was() -> None:
    images = np.arange(2 * 8 * 8, dtype=np.float32).reshape(2, 8, 8)
    masks = np.ones((2, 8, 8), np.uint8)
    masks[0, 0, 1] = 0
    half = Frame(images, masks, np.array([(0.4, 0.2), (0.0, 0.0)]), 7.0, 0.5, 2, (None, None)).halved()
    assert half.images[0, 0, 0] == images[0, :2, :2].mean()
    assert half.masks[0, 0, 0] == 0  # one invalid pixel spoils the cell
    assert half.masks[0, 0, 1] == 1
    assert (half.cell, half.margin, half.shape) == (1.0, 1, (2, 2))
    assert half.parallax[0].tolist() == [0.2, 0.1]


def test_normal_of_a_plane() -> None:
    y, x = np.mgrid[0:6, 0:7]
    # rises 0.3 m a metre eastward and 0.4 m a metre northward (rows count southward), cells of 2 m
    n = normals(0.3 * 2 * x - 0.4 * 2 * y, 2.0)
    expected = np.array([-0.3, -0.4, 1.0]) / math.sqrt(1.25)
    np.testing.assert_allclose(n, np.broadcast_to(expected[:, None, None], n.shape), atol=1e-6)


def test_normals_leave_out_what_is_unknown() -> None:
    height = np.zeros((5, 5))
    height[2, 2] = np.nan
    n = normals(height, 1.0)
    assert np.isnan(n[:, 2, 2]).all()
    np.testing.assert_allclose(n[:, 2, 1], [0, 0, 1])
    assert np.isnan(normals(np.full((3, 3), np.nan), 1.0)).all()


def a_match(**changed: Any) -> Any:
    shape = (9, 9)
    parts = {"height": 5.0, "score": 0.9, "uniqueness": 1.0, "views": 10, "consistent_views": 10} | changed
    counts = ("views", "consistent_views")
    return Match(*(np.full(shape, parts[n], np.uint8 if n in counts else np.float32) for n in parts))


def test_confidence_falls_with_every_doubt() -> None:
    def of(**changed: Any) -> Any:
        return float(match_confidence(a_match(**changed))[4, 4])

    assert 0.9 < of() <= 1.0
    assert of(score=0.45) == pytest.approx(of() / 2, rel=1e-4)
    assert of(uniqueness=0.1) < 0.5 * of()
    assert 0 < of(consistent_views=2) < of(consistent_views=3) < of()
    assert of(consistent_views=1) == of(consistent_views=0) == of(uniqueness=0.0) == of(score=0.0) == 0.0


def test_confidence_is_halved_beside_a_step_of_three_metres() -> None:
    match = a_match()
    match.height[:, 5:] = 8.0
    c = match_confidence(match)
    assert c[4, 4] == pytest.approx(c[4, 1] / 2, rel=1e-4)
    assert c[4, 8] == pytest.approx(c[4, 1])


def test_linear_images_get_a_tone_curve_and_all_the_same_contrast() -> None:
    images = np.linspace(0.01, 0.5, 7 * 1000, dtype=np.float32).reshape(1, 70, 100)
    masks = np.ones(images.shape, np.uint8)
    for scale in (1.0, 0.1):
        eye = with_contrast(toned(images * scale, LINEAR_TONE), masks)
        low, high = np.percentile(eye, [2, 98])
        assert high - low == pytest.approx(0.83, abs=0.01)
    dark = with_contrast(toned(images, LINEAR_TONE), masks)[0].ravel()
    straight = with_contrast(images, masks)[0].ravel()
    assert dark[700] - dark[0] > 1.5 * (straight[700] - straight[0])


def test_dark_images_of_eight_bits_get_a_tone_curve_as_linear_ones_have() -> None:
    """Most programs scale 11 bits down without one, and shadows are then a few numbers."""
    masks = np.ones((1, 80, 100), np.uint8)
    toned_already = np.linspace(0.0, 1.0, masks.size, dtype=np.float32).reshape(masks.shape)
    scaled = toned_already**2.2
    assert tone_of(toned_already, masks) == 1.0
    # the middle is 0.5 of white, 0.98, after the curve
    exponent = tone_of(scaled, masks)
    low, high = np.percentile(toned(scaled, exponent), [50, 98])
    assert low / high == pytest.approx(0.5, abs=0.01)
    assert 1 / 2.2 <= exponent < 0.5
    assert tone_of(scaled**2, masks) == LINEAR_TONE == pytest.approx(1 / 2.2)
    dark, straight = with_contrast(toned(scaled, exponent), masks)[0].ravel(), with_contrast(scaled, masks)[0].ravel()
    assert dark[800] - dark[0] > 5 * (straight[800] - straight[0])


def test_bands_get_their_tone_curve_one_by_one() -> None:
    """In the mean of linear bands the brightest one decides."""
    target = np.full((20, 30, 2), 0.04, np.float32)
    target[:, 15:, 0] = 0.16  # one band of two shows the edge, four times as bright; the other is white
    target[..., 1] = 1.0
    view: Any = View("a", target, np.ones((20, 30), np.uint8), None, 0.0, None, 0.0)
    source: Any = SimpleNamespace(linear=True)
    (seen,), tone = toned_views([source], [view], None)
    assert tone == pytest.approx(1 / 2.2)
    dark, bright = seen.target[0, 0], seen.target[0, 20]
    assert bright[0] / dark[0] == pytest.approx(4 ** (1 / 2.2), rel=1e-5)
    assert dark[1] == bright[1] == 1.0
    (same,), tone = toned_views([source], [view], 1.0)
    assert tone == 1.0
    assert same.target is target


def test_what_is_masked_or_black_does_not_decide_the_tone_curve() -> None:
    images = np.full((1, 80, 100), 0.6, np.float32)
    images[:, :60] = 0.01
    masks = np.ones(images.shape, np.uint8)
    masks[:, :60] = 0
    assert tone_of(images, masks) == 1.0
    assert tone_of(np.zeros_like(images), masks) == 1.0
    assert tone_of(-images, masks) == 1.0


def test_height_jumps_cost_more_with_fewer_pairs_whose_agreement_is_noisier() -> None:
    # the noise of a mean falls with the square root of its terms; a single pair is not trusted sixteen times less
    assert [scarcity(n) for n in (136, 60, 15, 3, 1)] == pytest.approx([1.0, 1.0, 2.0, 4.0, 4.0])
    options = PriorOptions(small_jump=0.2, large_jump=0.5, edges=0.04)
    assert penalties(options, 15) == pytest.approx((0.2 * 2**0.5, 1.4, 0.4, 0.04))
    # a change by one plane is what slopes are made of: it gets less dear, and from fewer pairs on
    assert [penalties(options, n).small for n in (60, 30, 15, 10, 1)] == pytest.approx(
        [0.2, 0.2, 0.2828, 0.3, 0.3], abs=1e-4
    )
    # on hills slopes of one material look unlike, and heights change from cell to cell, however many pairs tell of them
    assert penalties(for_hills(options, 1.0), 15, hills=1.0) == pytest.approx((0.1, 1.4, 0.4, 0.12))
    assert penalties(replace(options, edges=0.0), 15) == pytest.approx((0.2 * 2**0.5, 1.0, 1.0, 1.0))


def test_normals_of_a_large_map_are_worked_out_in_strips(monkeypatch: pytest.MonkeyPatch) -> None:
    import sattools.prior.normals as module

    height = np.random.default_rng(0).normal(size=(11, 7)).astype(np.float32)
    height[4, 2:5] = np.nan
    at_once = normals(height, 0.5)
    monkeypatch.setattr(module, "STRIP_CELLS", 21)
    monkeypatch.setattr(module, "LEAST_ROWS", 1)
    assert np.array_equal(normals(height, 0.5), at_once, equal_nan=True)

"""Tie points: matches stay in their corridor, tracks see a view once, false matches do not survive."""

from typing import Any

import numpy as np
import pytest
from synthetic_views import parallel_rpc, render, texture

from sattools.camera.ground import localize
from sattools.camera.matching import corridor_matches, free_matches, vote
from sattools.camera.tiepoints import (
    TiePointImage,
    TiePointOptions,
    choose_pairs,
    coarse_bias,
    find_tie_points,
    normalised_contrast,
    spread_evenly,
)
from sattools.camera.tracks import Tracks, build_tracks
from sattools.errors import InputError


def unit_descriptors(n: Any, seed: Any = 0) -> Any:
    d = np.abs(np.random.default_rng(seed).normal(size=(n, 128))).astype(np.float32)
    d -= d.mean(1, keepdims=True)  # unrelated descriptors are then nearly orthogonal
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def two_views(n: Any = 60, run: Any = (0.0, 0.4), across: Any = 0.0, seed: Any = 0) -> Any:
    rng = np.random.default_rng(seed)
    a, d, height = rng.uniform(0, 200, (n, 2)), unit_descriptors(n), rng.uniform(-10, 10, n)
    b = a - height[:, None] * np.array(run)
    b[:, 0] += across
    order = rng.permutation(n)
    return a, d, b[order], d[order], np.argsort(order)


def test_both_searches_find_every_true_match() -> None:
    a, d, b, e, truth = two_views()
    run = np.array([0.0, 0.4])
    free = free_matches(a, d, b, e, run, half_height=20.0, half_bias=10.0)
    narrow, _ = corridor_matches(a, d, b, e, run, half_height=15.0, half_width=1.0)
    for found in (free, narrow):
        assert len(found) == 60
        assert (found[:, 1] == truth[found[:, 0]]).all()


def test_a_match_outside_its_corridor_is_not_found() -> None:
    a, d, b, e, _ = two_views(across=3.0)
    found, _ = corridor_matches(a, d, b, e, np.array([0.0, 0.4]), half_height=15.0, half_width=1.0)
    assert len(found) == 0


def test_the_same_descriptor_twice_within_reach_is_no_match() -> None:
    d = unit_descriptors(1)
    b = np.array([[0.0, 0.5], [0.0, -0.5]])
    found, _ = corridor_matches(
        np.zeros((1, 2)), d, b, np.repeat(d, 2, 0), np.array([0.0, 0.4]), half_height=15.0, half_width=1.0
    )
    assert len(found) == 0


def test_the_vote_sees_the_shift_across_the_run_among_false_matches() -> None:
    a, _, b, _, truth = two_views(n=80, across=7.3)
    b = b[truth]
    rng = np.random.default_rng(5)
    b[:40, 0] = rng.uniform(-30, 30, 40)  # half of them false
    axes, shift, weight = vote(a, a + (b - a), np.array([0.0, 0.4]), pixel_m=0.5)
    assert (axes * shift[:, None]).sum(0) == pytest.approx([7.3, 0.0], abs=0.15)
    assert weight >= 40


def test_the_vote_is_silent_without_a_majority() -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 200, (100, 2))
    _, shift, weight = vote(a, rng.uniform(0, 200, (100, 2)), np.array([0.0, 0.4]), pixel_m=0.5)
    assert len(shift) == 0
    assert weight == 0.0


def test_coarse_errors_of_views_are_recovered_from_pairs() -> None:
    tangents = np.array([[0.3, 0.0], [0.0, 0.3], [-0.3, 0.1], [0.1, -0.3], [0.2, 0.25]])
    truth = np.zeros((5, 2))
    truth[3] = (2.0, -11.0)
    pairs = choose_pairs(tangents, 100)
    shifts = []
    for a, b in pairs:
        run = tangents[b] - tangents[a]
        across = np.array([-run[1], run[0]]) / np.hypot(*run)
        shifts.append((across[None], np.array([across @ (truth[b] - truth[a])]), 50.0))
    shifts[0] = (shifts[0][0], shifts[0][1] + 9.0, 5.0)  # one pair voted wrongly
    assert coarse_bias(pairs, shifts, tangents) == pytest.approx(truth, abs=0.1)


def test_pairs_are_limited_to_the_most_similar_views_and_stay_connected() -> None:
    tangents = np.stack([np.linspace(-0.4, 0.4, 30), np.zeros(30)], 1)
    pairs = choose_pairs(tangents, 100)
    assert len(pairs) < 435 / 2
    assert {(k, k + 1) for k in range(29)} <= set(pairs)


def test_tracks_join_matches_and_never_see_a_view_twice() -> None:
    pixels = [np.array([[0.0, 0], [1, 1]]), np.array([[2.0, 2], [3, 3]]), np.array([[4.0, 4]])]
    matches = [
        (0, 1, np.array([[0, 0], [1, 1]]), np.array([0.1, 0.2], np.float32)),
        (1, 2, np.array([[0, 0]]), np.array([0.1], np.float32)),
        (0, 2, np.array([[1, 0]]), np.array([0.4], np.float32)),  # would join both tracks: refused
    ]
    tracks = build_tracks(pixels, matches)
    assert tracks.sizes().tolist() == [3, 2]
    assert tracks.view.tolist() == [0, 1, 2, 0, 1]
    assert tracks.pixel[2].tolist() == [4.0, 4.0]


def test_dropping_observations_drops_points_that_too_few_views_see() -> None:
    pixels = [np.zeros((2, 2)), np.ones((2, 2)), np.ones((2, 2))]
    pair = np.array([[0, 0], [1, 1]])
    score = np.zeros(2, np.float32)
    tracks = build_tracks(pixels, [(0, 1, pair, score), (1, 2, pair, score)])
    left, old = tracks.kept(np.array([True, True, True, True, False, False]))
    assert (left.n_points, old.tolist(), left.view.tolist()) == (1, [0], [0, 1, 2])


def test_features_are_spread_over_the_image() -> None:
    rng = np.random.default_rng(0)
    crowd, rest = rng.uniform(0, 10, (500, 2)), rng.uniform(0, 160, (500, 2))
    chosen = spread_evenly(np.concatenate([crowd, rest]), np.r_[np.full(500, 9.0), np.ones(500)], 200)
    assert len(chosen) == 200
    assert (chosen < 500).sum() < 20  # the strong crowd lies in one of 256 cells


def test_contrast_is_the_same_after_gain_and_offset_and_masks_nan() -> None:
    image = render(texture(), (0, 0), size=(80, 90))
    dark, _ = normalised_contrast(image * 0.3 + 50, 12.0)
    bright, _ = normalised_contrast(image, 12.0)
    assert np.abs(dark.astype(int) - bright).max() <= 1
    image[:10] = np.nan
    masked, valid = normalised_contrast(image, 12.0)
    assert not valid[:10].any()
    assert (masked[:10] == 128).all()


def test_one_view_has_no_tie_points() -> None:
    with pytest.raises(InputError, match="found 1 image"):
        find_tie_points([TiePointImage("a", np.ones((64, 64), np.float32), parallel_rpc())], "EPSG:32633")


def test_tie_points_are_the_same_on_every_run_and_with_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    ground = texture()
    runs = [(0.3, 0.0), (-0.2, 0.2), (0.1, -0.3)]
    views = [TiePointImage(str(k), render(ground, r), parallel_rpc(r)) for k, r in enumerate(runs)]

    def found(threads: int) -> Tracks:
        monkeypatch.setenv("NUMBA_NUM_THREADS", str(threads))
        return find_tie_points(views, "EPSG:32633", TiePointOptions(max_height_m=60))

    first = found(1)
    assert first.n_points > 100
    for threads in (1, 3):
        assert np.array_equal(first.pixel, found(threads).pixel)


def test_tie_points_of_views_with_other_pixel_sizes_lie_on_the_same_ground() -> None:
    """OpenCV's SIFT places them 0.25 px off, 0.12 m of these and 0.25 m of those: the views would be 0.12 m apart."""
    ground, size = texture(), {0.5: (240, 260), 1.0: (120, 130)}

    def view(run: tuple[float, float], gsd: float) -> TiePointImage:
        level = render(ground, run, gsd, size[gsd], lambda east, north: 0 * east)
        return TiePointImage(str(gsd), level, parallel_rpc(run, gsd, size[gsd]))

    views = [view((0.0, 0.0), 0.5), view((0.1, 0.1), 1.0)]
    tracks = find_tie_points(views, "EPSG:32633", TiePointOptions(max_height_m=20))
    fine, wide = (np.stack(localize(v.rpc, "EPSG:32633", *tracks.pixel[k::2].T, 100.0)) for k, v in enumerate(views))
    assert tracks.n_points > 50
    assert np.median(wide - fine, axis=1) == pytest.approx([0.0, 0.0], abs=0.04)

"""Matching of made-up views of a known surface."""

import itertools
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rendered import CELL, RANGE, views_of
from scipy.ndimage import grey_erosion

from sattools import compiled
from sattools.prior.confidence import match_confidence
from sattools.prior.frame import Frame
from sattools.prior.matching.kernels import correlate
from sattools.prior.matching.match import _prepared, _rough_passes, for_hills, how_hilly, match
from sattools.prior.matching.penalties import penalties
from sattools.prior.matching.sweep import BLOCK, FEW_PAIRS, MatchTask, _blocks, pair_weights
from sattools.prior.options import PriorOptions
from sattools.prior.visibility.consistency import filled, supported
from sattools.prior.visibility.occlusion import disk, erode
from sattools.progress import silent


@pytest.fixture(scope="module")
def house() -> Any:
    height = np.zeros((84, 60))
    height[20:42, 24:44] = 9.0
    slopes = [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.4, -0.3), (0.3, -0.5)]
    return height, views_of(height, slopes)


ALL = np.array([(a, b) for a in range(5) for b in range(a + 1, 5)])


def test_a_house_is_found_with_its_roof_and_the_ground_around(house: Any) -> None:
    height, frame = house
    found = match(frame, ALL, RANGE, PriorOptions())
    error = np.abs(found.height - height)
    assert error[24:38, 28:40].max() < 0.3  # roof, away from its edges
    assert np.median(error) < 0.1
    assert np.mean(error) < 0.5  # walls are smeared by a cell or two
    assert found.views.max() == 5
    assert found.height.dtype == np.float32
    assert found.score.min() >= 0
    assert found.score.max() <= 1


def test_hidden_ground_is_seen_by_fewer_views(house: Any) -> None:
    _, frame = house
    found = match(frame, ALL, RANGE, PriorOptions(erode=0.5))
    # a lean of half a cell a metre hides 4.5 cells beside a house of 9 m from a view
    beside = found.views[43:45, 30:38]
    assert beside.mean() < 4.8
    assert found.views[5:10, 5:15].min() == 5


@pytest.mark.parametrize("times", [1, 3])  # 10 or 30 pairs
def test_a_wing_of_five_metres_hides_what_is_behind_it_in_few_images_and_in_many(times: int) -> None:
    height = np.zeros((84, 60))
    height[20:30, 14:46] = 9.0  # 10 cells of half a metre wide: eroded by 2 m a ridge is left
    frame = views_of(height, [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.4, -0.3), (0.3, -0.5)])
    _, surface = _rough_passes(_prepared(frame, np.concatenate([ALL] * times), RANGE, PriorOptions()), silent)
    assert surface.height[12:13, 10:20].mean() == pytest.approx(9.0, abs=0.5)  # its ridge, on cells of a metre
    assert surface.visibility.first_hit_height.max() > 8


def test_on_wide_cells_the_surface_is_eroded_by_one_of_them(house: Any) -> None:
    _, frame = house

    def hiding(erode: float) -> Any:
        return _rough_passes(_prepared(frame, ALL, RANGE, PriorOptions(erode=erode)), silent)[1].eroded

    np.testing.assert_array_equal(hiding(0.1), hiding(2 / 3))  # times 1.5, the rough passes' cells are a metre wide
    assert (hiding(0.0) > 8).sum() > 1.3 * (hiding(0.1) > 8).sum()  # 11 x 10 cells, less their rim


@pytest.mark.parametrize("radius", [0.0, 1.0, 2.9, 5.0, 12.3])
def test_erosion_takes_the_lowest_height_of_a_disk(radius: float) -> None:
    surface = np.random.default_rng(0).random((31, 47), np.float32)
    expected = grey_erosion(surface, footprint=disk(radius), mode="nearest")
    np.testing.assert_array_equal(erode(surface, radius), expected)


def test_erosion_by_a_wide_disk_takes_no_more_memory_than_some_surfaces() -> None:
    surface = np.random.default_rng(0).random((200, 200), np.float32)
    tracemalloc.start()
    erode(surface, 71.0)  # 50 m on cells of 0.7 m
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10 * surface.nbytes


def test_two_views_are_enough_for_open_ground(house: Any) -> None:
    height, frame = house
    two = Frame(frame.images[:2], frame.masks[:2], frame.parallax[:2], 0.0, CELL, frame.margin, (None,) * 2)
    found = match(two, np.array([(0, 1)]), RANGE, PriorOptions())
    assert np.median(np.abs(found.height - height)) < 0.15


def test_with_two_views_ground_behind_a_wall_is_taken_from_the_ground_and_is_not_trusted(house: Any) -> None:
    height, _ = house
    found = match(views_of(height, [(-0.4, 0.0), (0.4, 0.0)]), np.array([(0, 1)]), RANGE, PriorOptions())
    error = np.abs(found.height - height)
    # 3.6 cells on either side are hidden from one view; smeared roofs alone leave 1.6 m there
    assert error[np.r_[12:20, 42:50], 24:44].mean() < 1.3
    guessed = found.consistent_views < 2
    assert error[guessed].mean() > 5 * error[~guessed].mean()
    assert match_confidence(found)[guessed].max() == 0
    assert match_confidence(found)[5:10, 5:15].min() > 0


def test_a_masked_corner_is_seen_by_no_one_and_spoils_nothing_else(house: Any) -> None:
    height, frame = house
    masks = frame.masks.copy()
    masks[:, : frame.margin + 15, : frame.margin + 15] = 0
    images = np.where(masks > 0, frame.images, 0)
    found = match(Frame(images, masks, frame.parallax, 0.0, CELL, frame.margin, frame.suns), ALL, RANGE, PriorOptions())
    assert found.views[:8, :8].max() == 0
    assert np.median(np.abs(found.height - height)[20:, 20:]) < 0.1


def test_nothing_is_filled_where_no_image_reaches(house: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    _, frame = house
    masks = frame.masks.copy()
    masks[:, : frame.margin + 15, : frame.margin + 15] = 0
    asked = []

    def spy(height: Any, stands: Any, cell: Any) -> Any:
        asked.append(stands)
        return filled(height, stands, cell)

    monkeypatch.setattr("sattools.prior.matching.match.filled", spy)
    match(replace(frame, masks=masks), ALL, RANGE, PriorOptions())
    assert asked[-1][:8, :8].all()  # of the last pass
    assert not asked[0].all()  # beside the walls something is filled


@pytest.mark.parametrize(("memory", "planes", "guided"), [(10**9, 50, False), (10**7, 50, True), (10**9, 400, True)])
def test_blocks_cover_every_cell_once(memory: Any, planes: Any, guided: Any) -> None:
    count = np.zeros((700, 900), int)
    blocks = _blocks(count.shape, memory, planes, guided)
    for block in blocks:
        count[block] += 1
    assert (count == 1).all()
    assert len(blocks) == 1 if memory == 10**9 and planes == 50 else len(blocks) > 1
    if planes == 400:
        assert count[blocks[0]].size <= BLOCK**2


def test_blocks_give_the_surface_that_the_whole_gives(house: Any) -> None:
    _, frame = house
    whole = match(frame, ALL, RANGE, PriorOptions())
    # two volumes of 84 x 60 cells and 23 heights take 0.93 MB
    parts = match(frame, ALL, RANGE, PriorOptions(memory=0.2))
    assert not np.array_equal(whole.height, parts.height), "must have been matched in blocks"
    assert np.mean(np.abs(whole.height - parts.height) < 0.3) > 0.97


def test_the_result_does_not_depend_on_the_number_of_threads(house: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    _, frame = house
    found = []
    for threads in (1, 2, 3):
        monkeypatch.setattr(compiled, "MOST_THREADS", threads)
        found.append(match(frame, ALL, RANGE, PriorOptions()).height)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_steep_views_and_few_planes_never_read_beyond_the_frame(house: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernels test no bounds; reading too far would make results depend on what else is in memory."""
    _, frame = house
    seen = []

    def spy(
        images: Any,
        masks: Any,
        view_weights: Any,
        slopes: Any,
        heights: Any,
        base: Any,
        z_ref: Any,
        first_hit_height: Any,
        shadow_height: Any,
        dark: Any,
        tolerance: Any,
        pairs: Any,
        pair_shares: Any,
        radius: Any,
        *rest: Any,
    ) -> Any:
        margin = rest[3]
        reached = np.add.outer(heights, base.ravel() if base.size else [0.0])
        seen.append(margin - radius - 1 - np.abs(slopes).max() * np.abs(reached - z_ref).max())
        return correlate(
            images,
            masks,
            view_weights,
            slopes,
            heights,
            base,
            z_ref,
            first_hit_height,
            shadow_height,
            dark,
            tolerance,
            pairs,
            pair_shares,
            radius,
            *rest,
        )

    monkeypatch.setattr("sattools.prior.matching.kernels.correlate", spy)
    match(frame, ALL, RANGE, PriorOptions(step=4.0, rough_passes=1))
    assert len(seen) == 3
    assert min(seen) >= 0


def test_three_pairs_or_hills_count_only_what_is_surely_seen_and_few_are_not_outvoted(house: Any) -> None:
    """What a surface hides weighs little where others outvote it; one of three pairs, or of few on hills, decides."""
    _, frame = house

    def weights(pairs: int, *, robust: bool = False, hills: float = 0.0) -> tuple[Any, ...]:
        indices = np.zeros((pairs, 2), np.int64)
        return pair_weights(MatchTask(frame, indices, RANGE, 1.0, PriorOptions(), robust=robust, hills=hills))

    assert weights(FEW_PAIRS - 1) == weights(20, hills=0.5) == (1, 0.0, 0.0)
    assert weights(FEW_PAIRS) == pytest.approx((1, 0.05, 0.1))
    assert weights(20, robust=True) == weights(30, robust=True, hills=1.0) == pytest.approx((3, 0.05, 0.1))


def test_hills_let_views_differ_in_brightness() -> None:
    """On a slope of 27 degrees every cell is a slope; a town of level ground and walls keeps what was asked for."""
    options = PriorOptions(brightness=0.1, edges=0.04)
    town = np.zeros((20, 20), np.float32)
    town[:, 10:] = 8.0
    everywhere = np.ones((20, 20), bool)
    slope = np.tile(0.5 * np.arange(20, dtype=np.float32), (20, 1))
    assert how_hilly(town, everywhere, 1.0) == 0.0
    assert how_hilly(slope, everywhere, 1.0) == 1.0
    assert how_hilly(slope, ~everywhere, 1.0) == 0.0  # nobody is sure that it is one
    hills = for_hills(options, 1.0)
    assert (hills.brightness, hills.edges) == pytest.approx((0.3, 0.12))
    assert for_hills(options, 0.0) == options


@pytest.mark.parametrize("count", [14, FEW_PAIRS])
def test_a_town_of_few_views_is_robust_once_it_is_known_to_be_one(count: int) -> None:
    """On level ground many pairs or four outvote chance, on a slope they are asked as few are."""
    slopes = [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.4, -0.3), (0.3, -0.5), (-0.3, 0.4)]
    pairs = np.array(list(itertools.combinations(range(6), 2)), np.int64)[:count]
    level = np.zeros((84, 60))
    level[30:50, 20:40] = 6.0
    hill = np.tile(0.15 * np.arange(60.0), (84, 1))  # 17 degrees on cells of half a metre
    for surface, robust in ((level, True), (hill, False)):
        task = _prepared(views_of(surface, slopes), pairs, RANGE, PriorOptions())
        assert not task.robust
        known, _ = _rough_passes(task, silent)
        assert known.robust == robust
    known, _ = _rough_passes(_prepared(views_of(level, slopes), pairs[: FEW_PAIRS - 1], RANGE, PriorOptions()), silent)
    assert not known.robust  # those of three views


@pytest.mark.parametrize(("pairs", "asked"), [(ALL, True), (ALL[:4], False)])
def test_of_few_pairs_what_stands_is_alike_around_it(pairs: Any, asked: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where twelve pairs decide, four views do not agree by chance unless in shadow; fewer pairs are not believed."""
    from sattools.prior.matching import match as module

    shades: list[bool] = []

    def spy(*arguments: Any) -> Any:
        shades.extend(one is not None for one in arguments[4:])  # of the last pass
        return supported(*arguments)

    level = np.zeros((84, 60))
    level[30:50, 20:40] = 6.0
    frame = views_of(level, [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.4, -0.3), (0.3, -0.5), (-0.3, 0.4)])
    monkeypatch.setattr(module, "supported", spy)
    monkeypatch.setattr(module, "CHANCE_PAIRS", 10)  # those of five views
    match(frame, pairs, RANGE, PriorOptions())
    assert shades == [asked]


@pytest.mark.parametrize(("pairs", "walls"), [(ALL, False), (ALL[:9], True)])
def test_few_pairs_are_not_believed_that_it_is_a_hill(pairs: Any, walls: bool) -> None:
    slope = np.tile(0.1 * np.arange(60.0), (84, 1))  # 11 degrees on cells of half a metre
    frame = views_of(slope, [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.4, -0.3), (0.3, -0.5)])
    task, _ = _rough_passes(_prepared(frame, pairs, RANGE, PriorOptions()), silent)
    assert (task.hills < 1) == walls


@pytest.mark.parametrize(("pairs", "walls"), [(ALL, False), (ALL[:9], True)])
def test_walls_are_moved_in_towns_alone(pairs: Any, walls: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    from sattools.prior.matching import match as module

    asked = []

    def moved(frame: Frame, hits: np.ndarray, height: np.ndarray, *_: Any, few: bool) -> tuple[Any, ...]:
        asked.append(height)
        assert few == (len(pairs) < 30)
        return height, None, 1.0, None

    monkeypatch.setattr(module, "snap_edges", moved)
    slope = np.tile(0.1 * np.arange(60.0), (84, 1))  # 11 degrees on cells of half a metre
    frame = views_of(slope, [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.4, -0.3), (0.3, -0.5)])
    match(frame, pairs, RANGE, PriorOptions())
    assert len(asked) == walls


def test_half_a_hill_keeps_its_walls() -> None:
    half = np.zeros((20, 200), np.float32)
    half[:, 77:] = 0.5 * np.arange(123)  # 61.5 % of the cells: halfway from town to hills
    hills = how_hilly(half, np.ones(half.shape, bool), 1.0)
    options = PriorOptions(brightness=0.1, small_jump=0.2)
    found = for_hills(options, hills)
    assert hills < 1
    assert found.brightness == pytest.approx(0.2)
    assert penalties(options, 60, hills).small == pytest.approx(0.15)
    assert found.edges == pytest.approx(2 * PriorOptions().edges)

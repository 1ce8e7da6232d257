"""Walls move to where the images change."""

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from sattools.prior.frame import Frame
from sattools.prior.visibility.edges import FOOT, LIT_FOOT, leaning, snap_edges
from sattools.prior.visibility.sides import Surroundings, compare_sides

NOISE = 0.04


def a_frame(image: Any, views: Any = 3) -> Any:
    """The same picture from all views, straight from above: what is where does not depend on height."""
    rng = np.random.default_rng(0)
    images = np.stack([image + rng.normal(0, 0.01, image.shape) for _ in range(views)]).astype(np.float32)
    return Frame(images, np.ones(images.shape, np.uint8), np.zeros((views, 2)), 0.0, 0.5, 0, (None,) * views)


@pytest.fixture
def roof() -> Any:
    """A bright roof of 20 x 20 cells, 10 m high, on dark ground; and its true height."""
    height = np.zeros((40, 40), np.float32)
    height[10:30, 10:30] = 10.0
    return np.where(height > 5, 0.8, 0.2), height


@pytest.fixture
def wide() -> Any:
    """The same height, two cells too wide on every side."""
    height = np.zeros((40, 40), np.float32)
    height[8:32, 8:32] = 10.0
    return height


def unseen(frame: Any) -> Any:
    return np.full(frame.images.shape, -1e9, np.float32)


def test_a_rim_that_looks_like_the_ground_is_lowered(roof: Any, wide: Any) -> None:
    image, true = roof
    frame = a_frame(image)
    found = snap_edges(frame, unseen(frame), wide, 2.0, NOISE)[0]
    # the median filter at the end may round the four corners
    assert (found != true).sum() <= 4


def test_a_wall_comes_to_lie_between_the_matchings_step_and_the_edge_that_images_show(roof: Any) -> None:
    image, true = roof
    wide = true.copy()
    wide[7:33, 7:33] = 10.0  # three cells too wide on every side
    # the strip looks a little more like the ground: likeness about 0.6 * (0.34 - 0.46) / 0.3**2 / 2 = -0.4, as the high
    # side holds some of it
    frame = a_frame(np.where((wide > 5) & (true < 5), 0.34, image))
    found = snap_edges(frame, unseen(frame), wide, 2.0, 0.3)[0]
    # 0.3 a cell: it takes 0.15 to lower the outermost cell, 0.45 the one behind it
    assert (found[20, 7:10] > 5).tolist() == [False, True, True]
    assert (found[7:10, 20] > 5).tolist() == [False, True, True]
    # on cells of half the size, where the same strip is twice as many, it takes half as much a cell
    finer = snap_edges(frame, unseen(frame), wide, 2.0, 0.3, 2.0)[0]
    assert (finer[20, 7:10] > 5).tolist() == [False, False, True]


def test_a_roofs_edge_that_was_lost_is_raised(roof: Any) -> None:
    image, true = roof
    narrow = np.zeros_like(true)
    narrow[12:28, 12:28] = 10.0
    frame = a_frame(image)
    found = snap_edges(frame, unseen(frame), narrow, 2.0, NOISE)[0]
    # of 144 cells; six at each corner have too little of the roof around them
    assert (found != true).sum() <= 24


def test_where_both_sides_look_alike_nothing_moves(roof: Any, wide: Any) -> None:
    _, true = roof
    frame = a_frame(np.full(true.shape, 0.5))
    found = snap_edges(frame, unseen(frame), wide, 2.0, NOISE)[0]
    assert (found != wide).sum() <= 4


def test_views_that_do_not_see_a_cell_have_no_say(roof: Any, wide: Any) -> None:
    image, _ = roof
    frame = a_frame(image)
    blocked = unseen(frame)
    blocked[1:] = 99.0  # all but one view are blocked high above: one view alone decides nothing
    assert (snap_edges(frame, blocked, wide, 2.0, NOISE)[0] != wide).sum() <= 4


@pytest.mark.parametrize(("disagreeing", "moves"), [(1, True), (2, False)])
def test_one_view_of_four_that_disagrees_is_outvoted(roof: Any, wide: Any, disagreeing: Any, moves: Any) -> None:
    image, _ = roof
    frame = a_frame(image, views=4)
    # from these the rim looks as the roof does, and the ground around does not
    frame.images[:disagreeing, 8:32, 8:32] = 0.8
    found = snap_edges(frame, unseen(frame), wide, 2.0, NOISE)[0]
    assert ((found != wide).sum() > 100) == moves


NORTH, SOUTH = (0.0, 0.6, 0.8), (0.0, -0.6, 0.8)  # where the sun may stand; views look at the northern wall
MARGIN, FROM_NORTH = 10, (0.8, 0.0)  # a point moves south by 0.8 cells a metre: cameras stand in the north


def from_the_north(image: Any, wall: Any, foot: Any) -> Any:
    """What they see of the roof, with its northern wall and two cells at the foot of it."""
    shown = np.roll(np.pad(image, MARGIN, mode="edge"), 8, axis=0)
    shown[MARGIN + 10 : MARGIN + 18, MARGIN + 10 : MARGIN + 30] = wall
    shown[MARGIN + 8 : MARGIN + 10, MARGIN + 10 : MARGIN + 30] = foot
    return shown


def frame_of(pictures: Any, slopes: Any, suns: Any) -> Any:
    images = np.stack(pictures).astype(np.float32)
    return Frame(images, np.ones(images.shape, np.uint8), np.array(slopes), 0.0, 0.5, MARGIN, tuple(suns))


@pytest.mark.parametrize(
    ("strip", "sun", "few", "stays"),
    [
        (0.2, None, False, False),
        (0.35, None, False, True),
        (0.35, NORTH, False, True),
        (0.35, (0.0, 0.0, 1.0), False, True),
        (0.35, SOUTH, False, False),  # the ground may be dark for its shadow
        (0.35, SOUTH, True, True),
    ],
)
def test_a_rim_is_lowered_only_where_views_from_outside_see_the_ground_in_the_sun(
    roof: Any, wide: Any, strip: Any, sun: Any, few: Any, stays: Any
) -> None:
    image, _ = roof
    # at the foot: ground, or more of the wall
    frame = frame_of([from_the_north(image, 0.35, strip)] * 3, [FROM_NORTH] * 3, [sun] * 3)
    found = snap_edges(frame, unseen(frame), wide, 2.0, NOISE, few=few)[0]
    northern_rim = found[8:10, 14:26]
    assert (northern_rim == (10.0 if stays else 0.0)).all()


@pytest.mark.parametrize(
    ("foot", "sun", "few", "rim"),
    [
        (0.2, None, False, [False, False]),  # they see ground where the rim should stand
        (0.8, None, False, [True, True]),  # they see no ground there
        (0.2, NORTH, False, [False, False]),
        (0.8, SOUTH, False, [False, True]),  # ground in shadow, perhaps: as if nobody saw it
        (0.8, SOUTH, True, [True, True]),  # so few views have to do with the ground in shadow, too
    ],
)
def test_where_the_edge_is_faint_views_of_the_foot_say_whether_ground_is_there(
    roof: Any, wide: Any, foot: Any, sun: Any, few: Any, rim: Any
) -> None:
    image, _ = roof
    above = np.pad(image, MARGIN, mode="edge")
    above[MARGIN + 8 : MARGIN + 10, MARGIN + 10 : MARGIN + 30] = 0.43  # a little more like ground than like roof
    oblique = from_the_north(image, 0.8, foot)  # the wall is as bright as the roof
    frame = frame_of([above] * 3 + [oblique] * 3, [(0.0, 0.0)] * 3 + [FROM_NORTH] * 3, [sun] * 6)
    # of that likeness of -0.2 it takes 0.15 to lower the outer cell and 0.45 to lower the inner one
    found = snap_edges(frame, unseen(frame), wide, 2.0, 0.3, few=few)[0]
    assert (rim == (found[8:10, 14:26] > 5).T).all()


@pytest.mark.parametrize(("lit", "of", "stays"), [(1, 4, False), (4, 4, True)])
def test_one_lit_view_alone_makes_no_wall_lean(roof: Any, wide: Any, lit: int, of: int, stays: bool) -> None:
    image, _ = roof
    wall, ground = (from_the_north(image, 0.35, foot) for foot in (0.35, 0.2))
    pictures = [wall] * lit + [ground] * (of - lit)
    frame = frame_of(pictures, [FROM_NORTH] * of, [NORTH] * lit + [SOUTH] * (of - lit))
    found = snap_edges(frame, unseen(frame), wide, 2.0, NOISE)[0]
    assert (found[8:10, 14:26] == (10.0 if stays else 0.0)).all()


def test_walls_lean_where_the_foot_of_their_rims_looks_like_the_high_side() -> None:
    rims = np.zeros((9, 9), bool)
    rims[4, 2:7] = True
    foot = np.full((9, 9), np.nan)
    for likeness, lean_lit, lean in ((-0.5, 0.0, 0.0), (-0.2, 0.0, 0.5), (-0.1, 0.5, 1.0), (0.4, 1.0, 1.0)):
        foot[rims] = likeness
        np.testing.assert_allclose(leaning(rims, foot, 40.0, LIT_FOOT), lean_lit, atol=1e-5)  # single precision
        np.testing.assert_allclose(leaning(rims, foot, 40.0, FOOT), lean, atol=1e-5)
    foot[4, 2] = np.nan  # one that no view tells of is left out of the mean
    np.testing.assert_allclose(leaning(rims, foot, 40.0, FOOT), 1.0, atol=1e-5)
    np.testing.assert_array_equal(leaning(np.zeros((9, 9), bool), foot, 40.0, FOOT), 0.0)
    np.testing.assert_array_equal(leaning(rims, np.full((9, 9), np.nan), 40.0, FOOT), 0.0)


def test_slopes_and_low_steps_are_left_alone() -> None:
    slope = np.tile(np.linspace(0, 12, 40, dtype=np.float32), (40, 1))
    kerb = np.zeros((40, 40), np.float32)
    kerb[:, 20:] = 1.5
    image = np.random.default_rng(1).uniform(0, 1, (40, 40))
    for height in (slope, kerb):
        frame = a_frame(image)
        np.testing.assert_allclose(snap_edges(frame, unseen(frame), height, 2.0, NOISE)[0], height, atol=0.31)


def plain_sides(
    frame: Any, height: Any, outward: Any, sunlight: Any, uphill: Any, row: int, col: int, around: Surroundings
) -> list[Any]:
    """`compare_sides` for one cell of heights 0 and 10 m that all views see, in plain NumPy."""
    sure = minimum_filter(maximum_filter(height, 3) - minimum_filter(height, 3) < 1.5, 3)
    i, j = np.indices((2 * around.look + 1,) * 2) - around.look
    r, c = row + i, col + j
    asked = ((i + j) % 2 == 0) & (r >= 0) & (c >= 0) & (r < height.shape[0]) & (c < height.shape[1])
    i, j, r, c = (a[asked] for a in (i, j, r, c))
    kept = sure[r, c]
    i, j, high = i[kept], j[kept], height[r, c][kept] > 5
    weight = np.exp(-(i**2 + j**2) / (2 * np.where(high, around.high_fall, around.low_fall) ** 2))
    found = []
    for z, in_the_sun in ((10.0, False), (0.0, False), (0.0, True)):
        likeness = []
        for image, slope, out, light in zip(frame.images, frame.parallax, outward, sunlight, strict=True):
            if z == 0 and (out @ uphill <= 0.2 or (in_the_sun and light @ uphill <= 0.2)):
                continue
            at = np.array([row, col]) + frame.margin + slope * z
            near = np.rint(at).astype(int)
            values = image[near[0] + i, near[1] + j].astype(float)
            mean = [np.average(values[side], weights=weight[side]) for side in (~high, high)]
            pairs = zip((~high, high), mean, strict=True)
            spread = [np.average((values[s] - m) ** 2, weights=weight[s]) for s, m in pairs]
            variance = NOISE**2 + sum(spread) / 2
            if (mean[1] - mean[0]) ** 2 >= 0.25 * variance:
                here = map_coordinates(image.astype(float), at[:, None], order=1)[0]
                likeness.append(np.clip((mean[1] - mean[0]) * (here - sum(mean) / 2) / variance / 2, -1, 1))
        found.append(np.mean(likeness) if likeness else np.nan)
    return found


@pytest.mark.parametrize("around", [Surroundings(), Surroundings().times(1 / 0.7)])
def test_the_kernel_does_as_plain_numpy(roof: Any, around: Surroundings) -> None:
    image, height = roof
    rng = np.random.default_rng(3)
    margin = 10
    slopes = np.array([[0.31, 0.12], [-0.27, 0.4], [0.05, -0.33], [0.4, 0.1], [0.3, -0.2]])
    images = np.pad(image, margin, mode="edge") + rng.normal(0, 0.1, (5, 60, 60))
    frame = Frame(images.astype(np.float32), np.ones(images.shape, np.uint8), slopes, 0.0, 0.5, margin, (None,) * 5)
    outward = slopes / np.hypot(*slopes.T)[:, None]
    # in the sun, any, any, in shadow, unknown: all but the second and third see the northern wall's foot
    sunlight = np.array([[0.8, 0.6], [1.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [np.nan, np.nan]])
    sure = minimum_filter(maximum_filter(height, 3) - minimum_filter(height, 3) < 1.5, 3)
    uphill = np.zeros((2, 40, 40), np.float32)
    uphill[0] = 1.0  # the northern wall
    below, above, roof, told = (np.empty_like(height) for _ in range(4))
    foot, lit_foot = (np.empty((2, *height.shape), np.float32) for _ in range(2))
    compare_sides(
        height, sure, uphill, frame.images, frame.masks, slopes, outward, sunlight, 0.0, margin, unseen(frame), 2.0,
        NOISE, around, below, above, roof, told, foot, lit_foot,
    )  # fmt: skip
    for row, col in ((9, 20), (10, 17), (8, 24), (11, 13)):
        expected = plain_sides(frame, height, outward, sunlight, np.array([1.0, 0.0]), row, col, around)
        np.testing.assert_allclose([like[row, col] for like in (roof, foot[0], lit_foot[0])], expected, atol=1e-4)
        assert [number[row, col] for number in (told, foot[1], lit_foot[1])] == [5, 3, 2]
        assert (below[row, col], above[row, col]) == (0.0, 10.0)
    assert np.isnan(below[20, 20])
    assert np.isnan([foot[0, 20, 20], lit_foot[0, 20, 20]]).all()
    assert [number[20, 20] for number in (told, foot[1], lit_foot[1])] == [0, 0, 0]


def test_distances_around_a_wall_stay_the_same_on_finer_cells() -> None:
    assert Surroundings().times(1.0) == Surroundings()
    twice = Surroundings().times(2.0)
    assert twice == Surroundings(6, 10, 6.0, 18, 8.0, 6.0, 6.0, 1.2)  # weights are areas


@pytest.mark.parametrize(("rim", "height"), [(0.45, 0.0), (0.55, 10.0)])
def test_a_pixel_that_mixes_both_sides_belongs_to_the_one_it_has_more_of(roof: Any, rim: Any, height: Any) -> None:
    image, true = roof
    picture = image.copy()
    start = true.copy()
    picture[8:10, 10:30] = rim
    start[8:10, 10:30] = 10.0 if height == 0 else 0.0
    found = snap_edges(a_frame(picture), unseen(a_frame(picture)), start, 2.0, NOISE)[0]
    assert (found[9, 14:26] == height).all()


def test_cells_beside_a_wall_belong_to_a_side_and_others_to_none(roof: Any) -> None:
    image, true = roof
    frame = a_frame(image)
    side = snap_edges(frame, unseen(frame), true, 2.0, NOISE).side
    known = np.isfinite(side)
    assert ((side[known] > 0) == (true[known] > 5)).all()
    assert known[20, 7:13].all()
    assert not known[20, 20]
    assert not known[2].any()
    flat = snap_edges(frame, unseen(frame), np.zeros_like(true), 2.0, NOISE).side
    assert np.isnan(flat).all()


def test_walls_that_show_one_side_or_the_other_divide_cells_sharply(roof: Any) -> None:
    image, true = roof
    frame = a_frame(image)
    assert snap_edges(frame, unseen(frame), true, 2.0, NOISE)[2] == 0.0
    flat = a_frame(np.full(true.shape, 0.5))
    assert snap_edges(flat, unseen(flat), true, 2.0, NOISE)[2] == 1.0

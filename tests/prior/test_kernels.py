"""Compiled matching kernels against their plain twins, and on cases with known answers."""

from typing import Any

import numpy as np
import pytest
from rendered import by_cell

from sattools.prior import reference
from sattools.prior.matching.kernels import TILE, TILE_COLS, correlate
from sattools.prior.matching.look import mean_look
from sattools.prior.matching.sweep import PLANES, active_planes
from sattools.prior.visibility.kernels import TOGETHER, descend, first_hit_heights, look_at, shadow_heights

ROOT_MEAN_SQUARE = {"power": 1, "weak": 0.0, "mixed": 0.0}
LOW, MARGIN = -1e9, 5
SETTINGS = {"radius": 1, "noise": 0.01, "shadow_noise": 0.03, "brightness": 0.2, "margin": MARGIN, "unseen": 0.3}


def a_frame(seed: Any = 0, views: Any = 4) -> Any:
    rng = np.random.default_rng(seed)
    images = rng.normal(0, 0.1, (views, 17, 19)).astype(np.float32)
    masks = (rng.random(images.shape) > 0.15).astype(np.uint8)
    slopes = rng.uniform(-0.5, 0.5, (views, 2))
    first_hit_height = np.where(rng.random(images.shape) > 0.3, LOW, 4.0).astype(np.float32)
    return images, masks, slopes, first_hit_height


def run_correlate(
    images: Any,
    masks: Any,
    slopes: Any,
    first_hit_height: Any,
    pairs: Any,
    heights: Any,
    z_ref: Any = 1.0,
    tolerance: Any = 0.5,
    shadow_height: Any = None,
    dark: Any = None,
    base: Any = PLANES,
    active: Any = None,
    view_weights: Any = None,
    pair_shares: Any = None,
    **changed: Any,
) -> Any:
    s = SETTINGS | ROOT_MEAN_SQUARE | changed
    m = s["margin"]
    rows, cols = images.shape[1] - 2 * m, images.shape[2] - 2 * m
    volume = np.empty((rows, len(heights), cols), np.float32)
    order = (s["radius"], s["noise"], s["shadow_noise"], s["brightness"], m, np.float32(s["unseen"]))
    order += (s["power"], np.float32(s["weak"]), np.float32(s["mixed"]))
    if shadow_height is None:
        shadow_height = np.full((len(images), rows, cols), LOW, np.float32)
    if dark is None:
        dark = np.full(len(images), LOW, np.float32)
    correlate(
        images,
        masks,
        np.ones(len(images), np.float32) if view_weights is None else view_weights,
        slopes,
        heights,
        base,
        z_ref,
        first_hit_height,
        shadow_height,
        dark,
        tolerance,
        pairs,
        np.ones(len(pairs), np.float32) if pair_shares is None else pair_shares,
        *order,
        active_planes(heights, None, (rows, cols), 0, 0.0) if active is None else active,
        volume,
    )
    return by_cell(volume)


@pytest.mark.parametrize("radius", [1, 2])
def test_correlation_is_that_of_the_plain_twin(radius: Any) -> None:
    images, masks, slopes, first_hit_height = a_frame()
    pairs, heights = np.array([(0, 1), (0, 2), (2, 3), (1, 3)]), np.array([-2.0, 0.3, 2.0, 4.5])
    shadow_height = np.random.default_rng(3).choice([LOW, 1.0, 3.0], (4, 7, 9)).astype(np.float32)
    dark = np.array([-0.2, -0.15, LOW, -0.25], np.float32)
    fast = run_correlate(
        images, masks, slopes, first_hit_height, pairs, heights, radius=radius, shadow_height=shadow_height, dark=dark
    )
    settings = SETTINGS | {"radius": radius}
    slow = reference.correlate(
        images.astype(float), masks, slopes, heights, 1.0, first_hit_height, shadow_height, dark, 0.5, pairs, **settings
    )
    assert (slow == 0.3).any(), "the case must contain points that no pair sees"
    # single precision, running sums
    np.testing.assert_allclose(fast, slow, atol=2e-4)


@pytest.mark.parametrize("power", [1, 3])
def test_a_weighted_power_mean_is_that_of_the_plain_twin(power: Any) -> None:
    images, masks, slopes, first_hit_height = a_frame()
    pairs, heights = np.array([(0, 1), (0, 2), (2, 3), (1, 3)]), np.array([-2.0, 0.3, 2.0, 4.5])
    shadow_height = np.random.default_rng(3).choice([LOW, 1.0, 3.0], (4, 7, 9)).astype(np.float32)
    dark = np.full(4, LOW, np.float32)
    robust = {"power": power, "weak": 0.05, "mixed": 0.1}
    robust["view_weights"] = np.array([1.0, 0.2, 0.6, 1.0], np.float32)
    robust["pair_shares"] = np.array([0.3, 1.0, 0.05, 0.7], np.float32)
    fast = run_correlate(images, masks, slopes, first_hit_height, pairs, heights, shadow_height=shadow_height, **robust)
    settings = SETTINGS | robust
    slow = reference.correlate(
        images.astype(float), masks, slopes, heights, 1.0, first_hit_height, shadow_height, dark, 0.5, pairs, **settings
    )
    np.testing.assert_allclose(fast, slow, atol=5e-4)


def test_what_no_image_can_contradict_is_worth_what_the_hidden_images_show() -> None:
    images, masks, slopes, first_hit_height = a_frame()
    first_hit_height[:] = 3.0  # nothing below 3 m is seen
    masks[:] = 1
    images[1:] = -images[:1]  # and there the images disagree
    arguments = (images, masks, slopes * 0, first_hit_height, np.array([(0, 1)]), np.array([0.0]))
    seen = run_correlate(images, masks, slopes * 0, first_hit_height, np.array([(0, 1)]), np.array([4.0]))
    np.testing.assert_allclose(run_correlate(*arguments, weak=0.05), seen, atol=1e-5)


def test_with_the_sixth_power_pairs_that_agree_outvote_those_that_are_disturbed() -> None:
    images, masks, slopes, first_hit_height = a_frame()
    masks[:], first_hit_height[:], images[1] = 1, LOW, images[0]  # views 0 and 1 are equal, 2 and 3 are not like them
    pairs = np.array([(0, 1), (0, 2), (0, 3), (2, 3)])
    square = run_correlate(images, masks, slopes * 0, first_hit_height, pairs, np.array([0.0]))
    sixth = run_correlate(images, masks, slopes * 0, first_hit_height, pairs, np.array([0.0]), power=3)
    assert sixth.min() > 0.25 ** (1 / 6) - 1e-3  # one pair in four agrees fully
    assert (sixth >= square - 1e-5).all()


def test_correlation_along_a_surface_is_that_of_the_plain_twin() -> None:
    images, masks, slopes, first_hit_height = a_frame()
    pairs, heights = np.array([(0, 1), (0, 2), (2, 3), (1, 3)]), np.array([-1.0, 0.0, 1.0])
    base = np.random.default_rng(4).uniform(-1, 3, (9, 11)).astype(np.float32)  # 7 x 9 cells and a border of one
    fast = run_correlate(images, masks, slopes, first_hit_height, pairs, heights, base=base)
    no_shade, no_dark = np.full((4, 7, 9), LOW), np.full(4, LOW)
    slow = reference.correlate(
        images.astype(float),
        masks,
        slopes,
        heights,
        1.0,
        first_hit_height,
        no_shade,
        no_dark,
        0.5,
        pairs,
        **SETTINGS,
        base=base,
    )
    np.testing.assert_allclose(fast, slow, atol=2e-4)


def test_a_level_surface_is_a_plane() -> None:
    images, masks, slopes, first_hit_height = a_frame()
    pairs, heights = np.array([(0, 1), (2, 3)]), np.array([-1.0, 0.5, 2.0])
    planes = run_correlate(images, masks, slopes, first_hit_height, pairs, heights + 0.75)
    level = run_correlate(
        images, masks, slopes, first_hit_height, pairs, heights, base=np.full((9, 11), 0.75, np.float32)
    )
    np.testing.assert_allclose(level, planes, atol=1e-5)


def test_correlation_over_many_tiles_is_that_of_one() -> None:
    rng = np.random.default_rng(1)
    images = rng.normal(0, 0.1, (2, 70, 30)).astype(np.float32)
    masks, first_hit_height = np.ones(images.shape, np.uint8), np.full(images.shape, LOW, np.float32)
    slopes, heights = np.array([(0.3, 0.1), (-0.3, 0.2)]), np.array([0.0, 1.0, 2.0])
    pairs = np.array([(0, 1)])
    whole = run_correlate(images, masks, slopes, first_hit_height, pairs, heights)
    south = [np.ascontiguousarray(array[:, 40:]) for array in (images, masks, first_hit_height)]
    part = run_correlate(south[0], south[1], slopes, south[2], pairs, heights)
    np.testing.assert_allclose(whole[40:], part, atol=1e-5)


def test_equal_images_agree_fully_where_they_lie_on_each_other() -> None:
    image = np.random.default_rng(2).normal(0, 0.1, (17, 19)).astype(np.float32)
    images = np.stack(
        [image, np.roll(image, 2, axis=1)]
    )  # the second is displaced by two columns: 4 m at half a column
    masks, first_hit_height = np.ones(images.shape, np.uint8), np.full(images.shape, LOW, np.float32)
    slopes = np.array([(0.0, 0.0), (0.0, 0.5)])
    volume = run_correlate(images, masks, slopes, first_hit_height, np.array([(0, 1)]), np.array([1.0, 3.0, 5.0, 7.0]))
    assert (volume.argmax(axis=2) == 2).all()
    np.testing.assert_allclose(volume[..., 2], 1.0, atol=1e-3)


def test_an_unseen_height_never_beats_what_is_seen() -> None:
    images, masks, slopes, first_hit_height = a_frame()
    first_hit_height[:] = 3.0  # nothing below 3 m is seen
    images[1:] = -images[:1]  # and what is seen above disagrees wherever it can
    volume = run_correlate(
        images, masks, slopes * 0, first_hit_height, np.array([(0, 1)]), np.array([0.0, 2.0, 4.0]), unseen=0.9
    )
    assert (volume[..., 0] <= volume[..., 2]).all()


def test_above_all_that_the_images_show_an_unseen_height_is_worth_less_than_below_it() -> None:
    images, masks, _, first_hit_height = a_frame(views=3)
    images[:], masks[:], first_hit_height[:] = 0, 1, LOW  # plain, so everything that is shown agrees
    masks[1:, :, 8:] = 0  # two images end in the fourth column of cells, their lines of sight lean by 3 cells
    heights, leaning = np.array([-5.0, 1.0, 7.0]), np.array([(0.0, 0.0), (0.0, 0.5), (0.0, 0.5)])
    pairs = np.array([(0, 1), (0, 2), (1, 2)])
    volume = run_correlate(images, masks, leaning, first_hit_height, pairs, heights)
    np.testing.assert_allclose(volume[:, :3], np.broadcast_to([1.0, 1.0, 0.18], (7, 3, 3)), rtol=1e-6)
    np.testing.assert_allclose(volume[:, 3:6], np.broadcast_to([1.0, 0.18, 0.18], (7, 3, 3)), rtol=1e-6)
    # leaning the other way, cells are shown above the ground alone, which stays as likely as any hidden place
    volume = run_correlate(images, masks, -leaning, first_hit_height, pairs, heights)
    np.testing.assert_allclose(volume[:, 3:6], np.broadcast_to([0.3, 0.3, 1.0], (7, 3, 3)), rtol=1e-6)
    # of two images, which have no third to ask, it is worth what a hidden one is
    volume = run_correlate(images[:2], masks[:2], leaning[:2], first_hit_height[:2], pairs[:1], heights)
    np.testing.assert_allclose(volume[:, 3:6], np.broadcast_to([1.0, 0.3, 0.3], (7, 3, 3)), rtol=1e-6)


def test_the_mean_look_is_that_of_the_plain_twin() -> None:
    images, masks, parallax, first_hit_height = a_frame(views=4)
    heights = np.array([-2.0, 0.5, 3.0])
    active = np.ones((1, 1, 3), bool)
    look = np.empty((7, 3, 9), np.float32)
    weights = np.array([1.0, 0.2, 0.6, 1.0], np.float32)
    arguments = (images, masks, weights, parallax, heights, 0.3, first_hit_height, 0.5)
    mean_look(*arguments, np.float32(0.1), MARGIN, active, look)
    want = reference.mean_look(*arguments, 0.1, MARGIN)
    assert want.std() > 0.04
    np.testing.assert_allclose(by_cell(look), want, atol=1e-5)
    # at heights that are not looked at, and where no image shows the place, there is nothing
    active[..., 1], masks[:, :, :9], masks[:, :, 9:] = False, 0, 1
    mean_look(images, masks, weights, np.zeros_like(parallax), *arguments[4:], np.float32(0.1), MARGIN, active, look)
    assert (look[:, 1] == 0).all()
    assert (look[:, :, : 9 - MARGIN] == 0).all()
    assert (look[:, ::2, 9 - MARGIN :] != 0).all()


def test_a_tower_hides_the_ground_behind_it() -> None:
    """A line of sight that leans by one cell a metre enters a tower of 10 m ten columns before its foot."""
    surface = np.zeros((5, 40), np.float32)
    surface[:, 20:24] = 10.0
    first_hit_height = np.empty((1, 5, 40), np.float32)
    # what stands at height z in column c is seen at frame column c + z
    first_hit_heights(surface, np.array([(0.0, 1.0)]), 0.0, 12.0, -2.0, first_hit_height)
    assert (first_hit_height[0, :, :20] == 0).all()
    assert (first_hit_height[0, :, 30:34] == 10).all()  # the roof
    assert (first_hit_height[0, :, 24:30] > 0).all()  # the wall, in front of hidden ground
    assert (first_hit_height[0, :, 35:] == 0).all()


def test_lines_of_sight_end_on_roof_and_ground() -> None:
    surface = np.zeros((3, 30), np.float32)
    surface[:, 10:15] = 8.0
    surface[:, 25:] = -np.inf
    rows, cols = np.meshgrid(np.arange(3.0), np.arange(30.0), indexing="ij")
    bottom = np.stack([rows, cols], axis=-1).astype(np.float32)
    top = bottom + np.float32([0, 5])  # leans five columns over 10 m
    depth, where = np.empty((3, 30), np.float32), np.empty((3, 30, 2), np.int64)
    descend(surface, bottom, top, 0.0, 10.0, depth, where)
    assert depth[1, 2] == 0.0
    assert tuple(where[1, 2]) == (1, 2)
    assert depth[1, 8] == 8.0  # at 8 m it is 4 columns further
    assert tuple(where[1, 8]) == (1, 12)
    assert np.isnan(depth[1, 28])


def test_a_point_in_the_sun_is_not_compared_with_one_in_shadow() -> None:
    image = np.random.default_rng(2).normal(0, 0.1, (17, 19)).astype(np.float32)
    images = np.stack([image, image])
    masks, first_hit_height = np.ones(images.shape, np.uint8), np.full(images.shape, LOW, np.float32)
    shadow_height = np.full((2, 7, 9), LOW, np.float32)
    shadow_height[1, :, :4] = 10.0  # the western half is in shadow in the second image, up to a height of 10 m
    heights = np.array([8.0, 12.0])
    volume = run_correlate(
        images, masks, np.zeros((2, 2)), first_hit_height, np.array([(0, 1)]), heights, shadow_height=shadow_height
    )
    assert volume[:, 4:].min() == pytest.approx(1.0, abs=1e-4)
    assert volume[:, :4, 1].min() == pytest.approx(1.0, abs=1e-4)
    assert volume[:, :4, 0] == pytest.approx(0.3)  # as a point that no pair sees


def test_two_images_of_one_shadow_agree_though_haze_makes_it_brighter_on_one_date() -> None:
    noise = np.random.default_rng(4).normal(0, 0.002, (2, 17, 19))
    images = (noise + np.array([-0.4, -0.25])[:, None, None]).astype(np.float32)
    masks, first_hit_height = np.ones(images.shape, np.uint8), np.full(images.shape, LOW, np.float32)
    shadow_height = np.full((2, 7, 9), 10.0, np.float32)
    heights = np.array([8.0, 12.0])  # in the shadow and in the sun above it

    def agreement(dark: Any) -> Any:
        case = (images, masks, np.zeros((2, 2)), first_hit_height, np.array([(0, 1)]), heights)
        return run_correlate(*case, shadow_height=shadow_height, dark=np.array(dark, np.float32), noise=0.001).mean(
            axis=(0, 1)
        )

    # nothing but noise: no structure is asked for below 0.03, and the 0.15 between the shadows are known
    assert agreement([-0.4, -0.25])[0] > 0.95
    assert agreement([-0.4, -0.25])[1] < 0.3
    assert agreement([LOW, LOW])[0] < 0.3


def test_a_wall_shades_what_lies_behind_it_up_to_the_suns_line() -> None:
    surface = np.zeros((5, 12), np.float32)
    surface[:, 8] = 6.0
    shadow = np.empty_like(surface)
    shadow_heights(surface, np.array([0.6, 0.0, 0.8]), 0.5, 6.0, -9.0, shadow)  # sun in the east, 4 m up for 3 m along
    # one cell further from the wall the line is 0.5 m * 4 / 3 lower
    assert shadow[2, 4:8].tolist() == pytest.approx([6 - 8 / 3, 6 - 2, 6 - 4 / 3, 6 - 2 / 3], abs=1e-5)
    assert shadow[2, 9:].max() < 0  # only the ground's own line, below the ground
    assert shadow[2, 8] < 0


def test_first_hits_are_those_of_the_plain_twin() -> None:
    rng = np.random.default_rng(5)
    slopes = np.array([[0.4, -0.7], [-1.2, 0.1], [0.0, 0.0]])
    # narrower than what is followed side by side, and wider
    for shape in ((14, 12), (4, TOGETHER + 9)):
        surface = rng.uniform(0, 6, shape).astype(np.float32)
        fast = np.empty((3, *shape), np.float32)
        first_hit_heights(surface, slopes, 2.0, 7.0, -1.0, fast)
        np.testing.assert_allclose(fast, reference.first_hit_heights(surface, slopes, 2.0, 7.0, -1.0), atol=1e-6)


def test_what_views_show_of_a_surface_is_the_nearest_pixel_if_nothing_above_hides_it() -> None:
    rng = np.random.default_rng(8)
    images = rng.uniform(0, 1, (2, 16, 18)).astype(np.float32)
    masks = (rng.uniform(0, 1, images.shape) < 0.8).astype(np.uint8)
    hits = rng.uniform(0, 6, images.shape).astype(np.float32)
    surface, parallax = rng.uniform(0, 6, (8, 10)).astype(np.float32), np.array([[0.4, -0.7], [-0.9, 0.3]])
    value, seen = np.empty((2, 8, 10), np.float32), np.empty((2, 8, 10), bool)
    look_at(images, masks, parallax, 2.0, 4, hits, surface, 1.5, value, seen)
    for v, row, col in np.ndindex(value.shape):
        z = surface[row, col]
        # the last cells' rays may leave the frame: its border stands for what lies beyond
        r = min(max(round(4 + row + parallax[v, 0] * (z - 2)), 0), 15)
        c = min(max(round(4 + col + parallax[v, 1] * (z - 2)), 0), 17)
        assert value[v, row, col] == images[v, r, c]
        assert seen[v, row, col] == (masks[v, r, c] == 1 and hits[v, r, c] <= z + 1.5)


@pytest.mark.parametrize("sun", [(0.6, 0.3, 0.5), (-0.1, -0.8, 0.4), (0.7, 0.0, 0.7)])
def test_shadow_heights_are_those_of_the_plain_twin(sun: Any) -> None:
    for shape in ((15, 11), (5, TOGETHER + 7)):
        surface = np.random.default_rng(6).uniform(0, 9, shape).astype(np.float32)
        fast = np.empty_like(surface)
        shadow_heights(surface, np.array(sun), 0.5, float(surface.max()), -20.0, fast)
        slow = reference.shadow_heights(surface, np.array(sun), 0.5)
        lower = slow < -20  # nobody asks there
        assert (fast[lower] < -20).all()
        np.testing.assert_allclose(fast[~lower], slow[~lower], atol=1e-5)


def test_planes_away_from_a_known_surface_are_left_out_and_the_others_are_as_before() -> None:
    rng = np.random.default_rng(5)
    rows, cols = TILE + 6, TILE_COLS + 5
    images = rng.normal(0, 0.1, (2, rows + 10, cols + 10)).astype(np.float32)
    masks, hit = np.ones(images.shape, np.uint8), np.full(images.shape, LOW, np.float32)
    case = (images, masks, np.array([(0.0, 0.0), (0.1, 0.3)]), hit, np.array([(0, 1)]), np.arange(6.0))
    surface = np.full((rows, cols), 1.0, np.float32)
    surface[:, -2:] = 4.0  # a roof in the last columns, which are in the second tile only
    active = active_planes(case[-1], surface, (rows, cols), reach=3, margin=1.0)
    np.testing.assert_array_equal(active[0], [[1, 1, 1, 0, 0, 0], [1, 1, 1, 1, 1, 1]])
    whole, part = run_correlate(*case), run_correlate(*case, active=active)
    np.testing.assert_array_equal(part[:, :TILE_COLS, :3], whole[:, :TILE_COLS, :3])
    np.testing.assert_array_equal(part[:, TILE_COLS:], whole[:, TILE_COLS:])
    assert (part[:, :TILE_COLS, 3:] == 0).all()
    assert (whole[:, :TILE_COLS, 3:] > 0).any()


def test_what_stands_beside_a_tile_may_reach_into_it() -> None:
    surface = np.zeros((TILE, 2 * TILE_COLS), np.float32)
    surface[:, TILE_COLS + 2 :] = 9.0
    heights = np.arange(-2.0, 12.0)
    near = active_planes(heights, surface, surface.shape, reach=5, margin=1.0)[0, 0]
    far = active_planes(heights, surface, surface.shape, reach=1, margin=1.0)[0, 0]
    # ground, roof, and nothing between the two
    assert heights[near].tolist() == [-1.0, 0.0, 1.0, 8.0, 9.0, 10.0]
    assert heights[far].tolist() == [-1.0, 0.0, 1.0]
    assert active_planes(heights, None, surface.shape, 5, 1.0).all()

"""A piece of a roof about which too few views agree stands with the roof around it; what is smeared beside does not."""

import numpy as np

from sattools.prior.visibility.torn import pieces_of_roofs

CELL = 0.5
ROOF_M = 30.0
ROOF = np.s_[20:60, 20:60]
BITE = np.s_[20:32, 20:30]  # of a corner: of what is around it the lower and the right side are roof, half of all


def tower() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A tower on level ground: heights as matched and as filled, the share of views that agree."""
    height = np.zeros((80, 80), np.float32)
    height[ROOF] = ROOF_M
    return height, height.copy(), np.full(height.shape, 0.9)


def fallen(where: tuple[slice, slice], share: float, level: float = ROOF_M) -> np.ndarray:
    """What stands of a tower whose views agree by that share about a place, which filling takes for ground."""
    height, lowered, shares = tower()
    height[where], lowered[where], shares[where] = level, 0.0, share
    return pieces_of_roofs(height, lowered, shares, CELL)


def test_a_corner_that_a_third_of_the_views_agree_about_stays() -> None:
    expected = np.zeros((80, 80), bool)
    expected[BITE] = True
    assert (fallen(BITE, 0.33) == expected).all()


def test_one_about_which_hardly_any_view_agrees_falls() -> None:
    """A roof that matching has smeared looks like that, too."""
    assert not fallen(BITE, 0.2).any()


def test_what_hangs_on_a_corner_of_the_roof_alone_falls() -> None:
    """Of what is around it 2 of 22 cells are roof along one side: less than a fifth."""
    assert not fallen(np.s_[58:70, 61:71], 0.4).any()


def test_a_piece_at_another_height_is_not_of_this_roof() -> None:
    assert fallen(BITE, 0.33, ROOF_M - 1).any()
    assert not fallen(BITE, 0.33, ROOF_M - 6).any()


def test_what_is_rough_is_no_piece_of_a_roof() -> None:
    """Heights from 1.9 m below the roof's to 1.9 m above it: a standard deviation of 1.1 m; of half of that 0.55."""
    for most, stays in ((1.9, False), (0.95, True)):
        height, lowered, share = tower()
        lowered[BITE], share[BITE] = 0.0, 0.33
        height[BITE] += np.linspace(-most, most, 12, dtype=np.float32)[:, None]
        assert pieces_of_roofs(height, lowered, share, CELL).any() == stays


def test_a_rim_of_one_cell_is_not_a_piece() -> None:
    assert not fallen(np.s_[20:60, 20:21], 0.4).any()


def test_a_step_of_less_than_five_metres_is_left_to_the_views() -> None:
    height, lowered, share = tower()
    lowered[BITE], share[BITE] = ROOF_M - 4, 0.4
    assert not pieces_of_roofs(height, lowered, share, CELL).any()


def test_wrong_heights_within_a_piece_stay_filled() -> None:
    height, lowered, share = tower()
    lowered[BITE], share[BITE] = 0.0, 0.33
    height[24:26, 24:26] = 60.0
    whole = pieces_of_roofs(height, lowered, share, CELL)
    assert not whole[24:26, 24:26].any()
    assert whole.sum() == 12 * 10 - 4


def test_a_terrace_of_which_pieces_alone_are_lowered_stays_though_nothing_of_it_stands() -> None:
    """Around a tower runs a terrace of 3 m; the views disagree about all of it, and filling takes a third of it."""
    height, lowered, share = tower()
    terrace = np.zeros(height.shape, bool)
    terrace[14:66, 14:66] = True
    terrace[ROOF] = False
    height[terrace], share[terrace] = 15.0, 0.3
    lowered[terrace] = 12.0  # by less than 5 m
    lowered[14:20, 30:48] = 0.0
    whole = pieces_of_roofs(height, lowered, share, CELL)
    assert whole[14:20, 30:48].all()
    assert whole.sum() == 6 * 18

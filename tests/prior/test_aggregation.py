"""The semi-global aggregation against its plain twin, and the height of least cost."""

import numpy as np
import pytest
from rendered import by_cell

from sattools.prior import reference
from sattools.prior.matching.penalties import Penalties, penalties
from sattools.prior.matching.sgm import aggregate, lowest, second_best_margin
from sattools.prior.options import PriorOptions


@pytest.mark.parametrize("shape", [(7, 9, 6), (18, 3, 4), (1, 40, 3)])
@pytest.mark.parametrize("weights", [(0.1, 0.35, 0.35, 1.0), (0.1, 0.5, 0.05, 0.3)])
def test_aggregation_is_that_of_the_plain_twin(
    shape: tuple[int, int, int], weights: tuple[float, float, float, float]
) -> None:
    score, look = np.random.default_rng(3).random((2, *shape)).astype(np.float32)
    total = np.empty_like(by_cell(score))
    aggregate(by_cell(score), by_cell(look), Penalties(*weights), total)
    want = reference.aggregate(score.astype(float), look.astype(float), *weights)
    np.testing.assert_allclose(by_cell(total), want, atol=1e-5)


def test_an_edge_of_any_contrast_leaves_costs_that_are_numbers() -> None:
    score, look = np.random.default_rng(3).random((2, 7, 5, 9)).astype(np.float32)
    look[:, :, :4] = 0.5  # nothing changes at all
    total, sharpest = np.empty_like(score), penalties(PriorOptions(edges=1e-30), 60)
    aggregate(score, look, sharpest, total)
    want = reference.aggregate(by_cell(score).astype(float), by_cell(look).astype(float), *sharpest)
    np.testing.assert_allclose(by_cell(total), want, atol=1e-5)


def test_aggregation_carries_the_ground_through_a_place_without_evidence() -> None:
    score = np.full((11, 11, 5), 0.2, np.float32)
    score[..., 3] = 0.9
    score[5, 5] = 0.2
    score = by_cell(score)
    total, height, index = np.empty_like(score), np.empty((11, 11), np.float32), np.empty((11, 11), np.int32)
    aggregate(score, np.zeros_like(score), Penalties(0.3, 1.5, 0.3, 0.1), total)
    lowest(total, np.arange(5.0) + 10, height, index)
    assert index[5, 5] == 3
    np.testing.assert_allclose(height, 13.0, atol=1e-5)  # neighbours are alike, the parabola is symmetric


def test_a_step_is_put_where_the_images_change_at_the_upper_height() -> None:
    """Between the sixth and the tenth of 16 columns ground (plane 0) and roof (plane 3) agree alike."""
    score, look = np.full((2, 12, 4, 16), 0.2, np.float32)
    score[:, 0, :10] = score[:, 3, 6:] = 0.9
    height, index = np.empty((12, 16), np.float32), np.empty((12, 16), np.int32)

    def roof_begins() -> np.ndarray:
        total = np.empty_like(score)
        aggregate(score, look, Penalties(0.2, 0.6, 0.1, 0.05), total)
        lowest(total, np.arange(4.0), height, index)
        return np.asarray((index == 3).argmax(axis=1))

    look[:, 3, 8:] = 0.6  # the roof's edge, as all views show it at its height
    assert (roof_begins() == 8).all()
    look[:, 3], look[:, 0, 8:] = 0.2, 0.6  # an edge on the ground, such as a shadow's, is none of the roof's
    look[:, 3, 7:] = 0.6
    assert (roof_begins() == 7).all()


def test_a_parabola_finds_the_height_between_two_planes() -> None:
    heights = np.array([0.0, 2.0, 4.0, 6.0])
    total = ((heights - 3.4) ** 2).astype(np.float32)[None, :, None].copy()
    height, index = np.empty((1, 1), np.float32), np.empty((1, 1), np.int32)
    lowest(total, heights, height, index)
    assert index[0, 0] == 2
    assert height[0, 0] == pytest.approx(3.4, abs=1e-5)


def test_the_rival_is_the_best_height_that_is_no_neighbour() -> None:
    total = np.array([[[5.0], [3.0], [1.0], [2.0], [4.0]]], np.float32)
    gap = np.empty((1, 1), np.float32)
    second_best_margin(total, np.array([[2]], np.int32), gap)
    assert gap[0, 0] == 3.0

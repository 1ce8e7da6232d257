"""Figures worked out by hand."""

import math
from typing import Any

import numpy as np
import pytest

from sattools.compare.heights import height_errors
from sattools.compare.holes import fill_holes
from sattools.compare.metrics import (
    image_average,
    image_errors,
    map_errors,
    nmad,
    psnr,
    ssim,
)
from sattools.errors import InputError

NAN = np.nan


def test_errors_of_four_cells() -> None:
    figures = height_errors(np.array([[1.0, 2.0], [3.0, 7.0]]), np.array([[1.0, 1.0], [1.0, 4.0]]))
    # differences 0, 1, 2, 3
    assert figures["mae"] == 1.5
    assert figures["rmse"] == pytest.approx(math.sqrt(3.5))
    assert figures["median"] == 1.5
    assert figures["nmad"] == pytest.approx(1.4826)  # |d - 1.5| = 1.5, 0.5, 0.5, 1.5
    assert figures["bias"] == 1.5
    assert figures["completeness"] == 1.0
    assert (figures["within_1m"], figures["within_2_5m"]) == (0.5, 0.75)
    assert figures["mae_filled"] == figures["mae"]


def test_median_is_of_the_absolute_difference() -> None:
    assert height_errors(np.array([[-1.0, 1.0, 1.0, -1.0]]), np.zeros((1, 4)))["median"] == 1.0


def test_a_hole_costs_completeness_within_shares_and_the_filled_error() -> None:
    reference = np.array([[0.0, 0.0, 0.0, 9.0]])
    predicted = np.array([[0.0, 0.0, 0.0, NAN]])
    figures = height_errors(predicted, reference)
    assert figures["mae"] == 0.0
    assert figures["completeness"] == 0.75
    assert figures["within_1m"] == 0.75
    assert figures["mae_filled"] == pytest.approx(9 / 4)  # filled with 0 from beside it
    assert (figures["cells"], figures["cells_predicted"]) == (4, 3)


def test_water_and_unknown_reference_cells_do_not_count() -> None:
    reference = np.array([[0.0, 0.0, NAN, 0.0]])
    classes = np.array([[2, 9, 2, 65]], dtype=np.uint8)
    figures = height_errors(np.array([[1.0, 50.0, 50.0, 3.0]]), reference, classes)
    assert figures["mae"] == 2.0  # cells 0 and 3; unlabelled ground (65) counts
    assert figures["cells"] == 2


def test_a_hole_on_water_costs_nothing() -> None:
    figures = height_errors(np.array([[1.0, NAN]]), np.zeros((1, 2)), np.array([[2, 9]]))
    assert figures["completeness"] == 1.0


def test_prediction_is_clipped_to_ten_metres_around_the_reference() -> None:
    figures = height_errors(np.array([[-500.0, 0.0, 5.0, 900.0]]), np.array([[0.0, 0.0, 5.0, 5.0]]))
    assert figures["mae"] == pytest.approx((10 + 0 + 0 + 10) / 4)


def test_water_does_not_widen_the_clipping() -> None:
    figures = height_errors(np.array([[900.0, 0.0]]), np.array([[0.0, 300.0]]), np.array([[2, 9]]))
    assert figures["mae"] == 10.0


def test_classes_are_scored_apart() -> None:
    reference = np.zeros((1, 6))
    predicted = np.array([[1.0, 3.0, 4.0, NAN, 0.5, 7.0]])
    classes = np.array([[2, 2, 5, 5, 6, 17]])
    by_class = height_errors(predicted, reference, classes)["classes"]
    assert set(by_class) == {"ground", "trees", "buildings"}
    assert (by_class["ground"]["mae"], by_class["ground"]["n"]) == (2.0, 2)
    assert (by_class["trees"]["mae"], by_class["trees"]["n"], by_class["trees"]["completeness"]) == (4.0, 1, 0.5)
    assert (by_class["buildings"]["mae"], by_class["buildings"]["n"]) == (0.5, 1)


def test_a_class_that_is_not_there_has_no_figures() -> None:
    trees = height_errors(np.zeros((1, 2)), np.zeros((1, 2)), np.array([[2, 2]]))["classes"]["trees"]
    assert trees["n"] == 0
    assert trees["mae"] is None
    assert trees["completeness"] is None


def test_nmad_is_the_standard_deviation_of_normal_noise_and_ignores_outliers() -> None:
    noise = np.random.default_rng(0).normal(3.0, 2.0, 100_000)
    noise[:5000] = 1e4
    assert nmad(noise) == pytest.approx(2.0, rel=0.08)  # 5 % outliers raise it by about 6 %


def test_what_images_have_measured_is_scored_on_its_own() -> None:
    predicted, measured = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[True, True], [False, False]])
    figures = height_errors(predicted, np.array([[1.0, 1.0], [1.0, 1.0]]), measured=measured)
    # differences 0, 1 where images have measured, 2, 3 elsewhere
    assert (figures["mae"], figures["cells_predicted"], figures["completeness"]) == (1.5, 4, 0.5)
    assert (figures["measured"]["mae"], figures["measured"]["n"]) == (0.5, 2)
    predicted[0, 1] = NAN  # claimed to be measured, but not there
    figures = height_errors(predicted, np.ones((2, 2)), measured=measured)
    assert (figures["measured"]["mae"], figures["measured"]["n"], figures["completeness"]) == (0.0, 1, 0.25)


def test_predictions_are_limited_to_ten_metres_beyond_the_whole_reference() -> None:
    reference = np.array([[0.0], [0.0], [0.0], [90.0]])
    figures = height_errors(np.array([[-500.0], [99.0], [250.0], [90.0]]), reference)
    assert figures["mae"] == (10 + 99 + 100 + 0) / 4


def test_holes_take_the_nearest_height() -> None:
    filled = fill_holes(np.array([[1.0, NAN, NAN, NAN, 8.0]]))
    np.testing.assert_array_equal(filled[0, [0, 1, 3, 4]], [1.0, 1.0, 8.0, 8.0])


@pytest.mark.parametrize(
    ("predicted", "reference", "message"),
    [
        (np.full((2, 2), NAN), np.zeros((2, 2)), "prediction"),
        (np.zeros((2, 2)), np.full((2, 2), NAN), "reference"),
    ],
)
def test_nothing_to_compare_is_an_error(predicted: Any, reference: Any, message: Any) -> None:
    with pytest.raises(InputError, match=message):
        height_errors(predicted, reference)


def test_class_map_of_another_size_is_an_error() -> None:
    with pytest.raises(InputError, match="class map"):
        height_errors(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((3, 3)))


def test_pixels_that_are_not_valid_do_not_count_in_images() -> None:
    reference = np.random.default_rng(0).random((3, 24, 30))
    image, valid = reference.copy(), np.ones((24, 30), bool)
    image[1, 3:5, 4:9], valid[3:5, 4:9] = 0.9, False
    image[:, 20, 20] = NAN
    figures = image_errors(image, reference, valid)
    assert (figures["psnr"], figures["ssim"]) == (math.inf, pytest.approx(1.0))
    assert image_errors(image, reference)["psnr"] < 40
    with pytest.raises(InputError, match="no valid pixel"):
        image_errors(image, reference, ~valid & (np.arange(30) == 20))


def test_parameter_map_figures() -> None:
    reference = np.array([0.2, 0.4, NAN, 0.6])
    figures = map_errors(np.array([0.1, 0.2, 0.9, 0.3]), reference)
    assert figures["rmse"] == pytest.approx(math.sqrt((0.01 + 0.04 + 0.09) / 3))
    assert figures["nrmse"] == pytest.approx(figures["rmse"] / 0.4)
    assert figures["correlation"] == pytest.approx(1.0)
    assert figures["nrmse_constant"] == pytest.approx(math.sqrt(0.08 / 3) / 0.4)
    assert figures["scale"] == pytest.approx(2.0)
    assert figures["nrmse_scaled"] == pytest.approx(0.0, abs=1e-12)
    assert figures["n"] == 3


def test_constant_parameter_map_scores_as_the_baseline_and_correlates_with_nothing() -> None:
    reference = np.array([0.2, 0.4, 0.6])
    figures = map_errors(np.full(3, 0.4), reference)
    assert figures["nrmse"] == pytest.approx(figures["nrmse_constant"])
    assert figures["correlation"] is None


def test_psnr_of_a_known_noise_and_of_equal_images() -> None:
    image = np.full((3, 20, 20), 0.5)
    assert psnr(image, image) == math.inf
    assert psnr(image + 0.1, image) == pytest.approx(20.0)
    valid = np.zeros((20, 20), bool)
    valid[:10] = True
    worse = image.copy()
    worse[:, 10:] = 0
    assert psnr(worse + 0.01, image, valid) == pytest.approx(40.0)


def test_ssim_is_that_of_scikit_image() -> None:
    from skimage.metrics import structural_similarity

    rng = np.random.default_rng(3)
    image = rng.random((2, 20, 30))
    other = image + rng.normal(0, 0.1, image.shape)
    valid = rng.random((20, 30)) > 0.3
    window = {"gaussian_weights": True, "use_sample_covariance": False, "full": True}
    _, expected = structural_similarity(image, other, channel_axis=0, data_range=1.5, **window)
    assert ssim(image, other, valid, peak=1.5) == pytest.approx(expected[:, valid].mean(), abs=1e-12)


def test_ssim_is_one_for_equal_images_and_falls_with_noise() -> None:
    rng = np.random.default_rng(0)
    image = rng.random((3, 40, 40))
    assert ssim(image, image) == pytest.approx(1.0)
    slight, strong = (ssim(image + rng.normal(0, s, image.shape), image) for s in (0.05, 0.3))
    assert 0.9 < slight < 1
    assert strong < 0.8


def test_avg_follows_its_formula_and_needs_lpips() -> None:
    assert image_average(20.0, 0.75, 0.2) == pytest.approx((0.01 + 0.5 + 0.2) / 3)
    assert image_average(20.0, 0.75, None) is None


def test_pixels_without_a_value_are_not_scored() -> None:
    image = np.full((1, 30, 30), 0.5)
    hole = image.copy()
    hole[:, 4:9, 4:9] = NAN
    figures = image_errors(hole, image)
    assert figures["psnr"] == math.inf
    assert figures["ssim"] == pytest.approx(1.0)
    assert figures["lpips"] is None


def test_errors_are_not_told_as_shares_of_a_mean_below_zero() -> None:
    figures = map_errors(np.array([0.2, 0.4, 0.6]), np.array([0.2, 0.4, -9999.0]))
    assert (figures["nrmse"], figures["nrmse_constant"], figures["nrmse_scaled"]) == (None, None, None)


@pytest.mark.parametrize("name", ["predicted", "classes", "filled", "measured"])
def test_heights_of_other_shapes_are_told(name: str) -> None:
    given = {"predicted": np.ones((3, 4)), name: np.ones((2, 4))}
    with pytest.raises(InputError, match=r"found shape \(2, 4\), expected \(3, 4\)"):
        height_errors(reference=np.zeros((3, 4)), **given)


def test_an_image_has_bands_rows_and_columns() -> None:
    with pytest.raises(InputError, match=r"found shape \(20, 30\), expected bands, rows and columns"):
        image_errors(np.ones((20, 30)), np.zeros((20, 30)))
    with pytest.raises(InputError, match=r"valid pixels: found shape \(30, 20\), expected \(20, 30\)"):
        image_errors(np.ones((3, 20, 30)), np.zeros((3, 20, 30)), np.ones((30, 20), bool))

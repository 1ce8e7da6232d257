"""Views that are less sharp than others count less."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rendered import RANGE, views_of
from scipy.ndimage import gaussian_filter

from sattools.prior import PriorOptions
from sattools.prior.matching.match import match
from sattools.prior.matching.weights import for_pixels, for_sharpness, view_shares
from sattools.prior.stage import prior

VIEWS = 12
SLOPES = [(0.6 * np.sin(t), 0.6 * np.cos(t)) for t in np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)]
PAIRS = np.array([(a, b) for a in range(VIEWS) for b in range(a + 1, VIEWS) if (b - a) % VIEWS in (1, 2, 3, 9, 10, 11)])


def streets() -> Any:
    """Rows of houses 6 to 10 m high along streets of 4 m."""
    height = np.zeros((64, 64))
    height[:, 8:24], height[:, 32:48], height[:, 56:] = 8.0, 6.0, 10.0
    return height


def error(frame: Any, height: Any, blurred: float) -> float:
    found = match(frame, PAIRS, RANGE, PriorOptions(blurred=blurred))
    return float(np.abs(found.height - height).mean())


def with_views(frame: Any, change: Any) -> Any:
    return replace(frame, images=np.stack([change(k, image) for k, image in enumerate(frame.images)]))


def test_alike_views_count_alike() -> None:
    assert match(views_of(streets(), SLOPES), PAIRS, RANGE, PriorOptions()).shares == (1.0,) * VIEWS


def test_blurred_views_count_less_and_the_surface_is_better() -> None:
    """Half of them by three cells; it was 1.57 m, is 0.74 m, and is 0.73 m where none is blurred."""
    height = streets()
    frame = with_views(views_of(height, SLOPES), lambda k, image: image if k % 2 else gaussian_filter(image, 3.0))
    shares = match(frame, PAIRS, RANGE, PriorOptions()).shares
    assert shares == pytest.approx((0.2, 1.0) * 6)
    assert error(frame, height, 0.2) < 0.7 * error(frame, height, 1.0)


def test_noise_is_not_sharpness() -> None:
    """Detail of 2.4 times what a blur leaves is enough: a clean view among noisy ones counts as they do."""
    assert for_sharpness(np.array([2.0, 3.6, 3.6, 3.6, 3.6])) == pytest.approx(1.0)
    assert for_sharpness(np.array([1.1, 2.0, 2.0, 2.0, 2.0]))[0] == pytest.approx((0.55 / 0.7) ** 8)


def test_the_sharper_half_is_the_measure() -> None:
    factors = for_sharpness(np.array([1.1] * 6 + [2.0] * 6))
    assert factors[:6] == pytest.approx((0.55 / 0.7) ** 8)
    assert factors[6:] == pytest.approx(1.0)


def test_pixels_up_to_twice_as_wide_count_as_much() -> None:
    factors = for_pixels([0.5, 0.5, 0.5, 0.5, 1.0, 1.1, 1.5, 2.0], 0.5)
    assert factors == pytest.approx([1, 1, 1, 1, 1, 1, (1 / 3 / 0.45) ** 8, (0.25 / 0.45) ** 8])


def test_pixels_are_no_coarser_than_cells() -> None:
    assert for_pixels([0.5, 0.5, 0.5, 0.5, 2.0], 2.0) == pytest.approx(1.0)


def test_coarse_pixels_count_less_however_sharp_they_look() -> None:
    frame = replace(views_of(streets(), SLOPES), pixels=(0.5,) * 11 + (2.0,))
    assert match(frame, PAIRS, RANGE, PriorOptions()).shares == (1.0,) * 11 + (0.2,)


@pytest.mark.parametrize(("views", "least"), [(2, 1.0), (4, 1.0), (6, 0.2**0.25), (8, 0.2**0.5), (12, 0.2), (40, 0.2)])
def test_few_views_are_all_needed(views: int, least: float) -> None:
    one_blurred = np.array([0.5] + [2.0] * (views - 1))
    assert view_shares(one_blurred, [], 0.5, 0.2) == pytest.approx([least] + [1.0] * (views - 1), abs=1e-3)


def test_views_that_show_nothing_are_no_reason_to_fail() -> None:
    assert np.isfinite(for_sharpness(np.zeros(5))).all()


def test_what_images_count_is_told(make_town: Any) -> None:
    scene = make_town()
    told = prior(scene, PriorOptions())
    assert told["prior"]["image_weights"] == {item.id: 1.0 for item in scene.train_items()}

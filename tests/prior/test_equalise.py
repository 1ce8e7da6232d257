"""Views are made equally sharp, and on one surface equally bright."""

from typing import Any

import numpy as np
import pytest
from rendered import RANGE, views_of
from scipy.ndimage import gaussian_filter

from sattools.prior.matching.equalise import brightened, equally_sharp, gains
from sattools.prior.matching.match import match
from sattools.prior.options import PriorOptions

SIZE = 160


@pytest.fixture(scope="module")
def scene() -> Any:
    """Patches of one brightness with texture, as sharp as a good sensor shows them, ``[H, W]`` float32."""
    rng = np.random.default_rng(3)
    patches = np.kron(rng.uniform(0.1, 0.9, (SIZE // 10, SIZE // 10)), np.ones((10, 10)))
    fine = gaussian_filter(rng.normal(0, 0.15, (SIZE, SIZE)), 0.6)
    return (patches + fine).astype(np.float32)


def everywhere(images: np.ndarray) -> np.ndarray:
    return np.ones(images.shape, np.uint8)


def test_a_blurred_view_gets_its_detail_back(scene: Any) -> None:
    """A third of what the blur has taken away, at least; what remains is beyond the middle of the spectrum."""
    blurred = gaussian_filter(scene, 0.7)
    restored = equally_sharp(blurred[None], everywhere(blurred[None]))[0][0]
    inner = (slice(8, -8), slice(8, -8))
    assert np.std((restored - scene)[inner]) < 0.67 * np.std((blurred - scene)[inner])


def test_views_of_different_sharpness_come_to_look_alike(scene: Any) -> None:
    views = np.stack([gaussian_filter(scene, sigma) for sigma in (0.5, 0.7, 0.9)])
    alike, _ = equally_sharp(views, everywhere(views))
    inner = (slice(8, -8), slice(8, -8))
    assert np.std((alike[0] - alike[2])[inner]) < 0.75 * np.std((views[0] - views[2])[inner])


def test_noise_is_not_taken_for_a_blurred_view() -> None:
    noise = np.random.default_rng(0).normal(0, 0.1, (1, 64, 64)).astype(np.float32)
    assert (equally_sharp(noise, everywhere(noise))[0] == noise).all()


def test_what_lies_beyond_an_image_makes_no_edge(scene: Any) -> None:
    """The values of invalid pixels have no effect on the others."""
    image = gaussian_filter(scene, 0.8)[None]
    valid = everywhere(image)
    valid[:, :, :40] = 0
    other = np.where(valid > 0, image, np.float32(9.0))
    here = valid > 0
    assert np.array_equal(equally_sharp(image, valid)[0][here], equally_sharp(other, valid)[0][here])
    plain = np.where(valid > 0, np.float32(0.3), np.float32(0.0))
    assert equally_sharp(plain, valid)[0][here] == pytest.approx(0.3, abs=1e-6)


def test_an_image_without_a_valid_pixel_stays_as_it_is() -> None:
    nothing = np.full((1, 8, 8), 0.2, np.float32)
    assert (equally_sharp(nothing, np.zeros(nothing.shape, np.uint8))[0] == nothing).all()


def test_gain_and_offset_of_every_view_are_found_among_what_has_changed() -> None:
    """A fifth of what each view shows is something else; 1 % of noise on 4000 places leaves less than 0.01."""
    rng = np.random.default_rng(1)
    truth = rng.uniform(-0.5, 0.5, 4000)
    gain, offset = np.array([1.2, 0.9, 1.0, 1 / 1.08]), np.array([0.05, -0.03, 0.0, -0.02])
    value = (truth - offset[:, None]) / gain[:, None] + rng.normal(0, 0.01, (4, 4000))
    for shown, first in zip(value, range(0, 4000, 1000), strict=True):
        shown[first : first + 800] = rng.uniform(-0.5, 0.5, 800)
    found, moved = gains(value.astype(np.float32), np.ones(value.shape, bool))
    assert found == pytest.approx(gain, abs=0.01)
    assert moved == pytest.approx(offset - offset.mean(), abs=0.01)


def test_in_the_mean_of_all_views_nothing_gets_brighter() -> None:
    rng = np.random.default_rng(2)
    value = rng.uniform(0.8, 1.2, (5, 1)) * rng.uniform(-0.5, 0.5, 1000) + rng.normal(0, 0.01, (5, 1000))
    gain, offset = gains(value.astype(np.float32), np.ones(value.shape, bool))
    assert float(np.log(gain).mean()) == pytest.approx(0.0, abs=1e-6)
    assert float(offset.mean()) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("places", [0, 1, 400])
def test_too_few_places_change_nothing(places: int) -> None:
    value = np.random.default_rng(4).normal(0, 1, (3, places)).astype(np.float32)
    gain, offset = gains(value, np.ones(value.shape, bool))
    assert (gain == 1).all()
    assert (offset == 0).all()


def test_views_that_show_nothing_but_one_brightness_change_nothing() -> None:
    gain, offset = gains(np.full((3, 1000), 0.2, np.float32), np.ones((3, 1000), bool))
    assert (gain == 1).all()
    assert (offset == 0).all()


def test_a_view_that_sees_too_little_stays_as_it_is() -> None:
    rng = np.random.default_rng(5)
    truth = rng.uniform(-0.5, 0.5, 2000)
    value = np.stack([truth, 1.1 * truth + 0.02, 3.0 * truth]).astype(np.float32)
    shown = np.ones(value.shape, bool)
    shown[2, 100:] = False
    gain, offset = gains(value, shown)
    assert gain[0] / gain[1] == pytest.approx(1.1, rel=0.01)
    assert gain[2] == pytest.approx(1.0, abs=0.05)
    assert offset[2] == pytest.approx(0.0, abs=0.02)


def test_a_house_is_found_in_views_of_different_brightness() -> None:
    """They agree about it as they do when all are equally bright (0.96 in the mean; without their gains 0.57)."""
    height = np.zeros((84, 60))
    height[20:42, 24:44] = 9.0
    frame = views_of(height, [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.4, -0.3), (0.3, -0.5)])
    pairs = np.array([(a, b) for a in range(5) for b in range(a + 1, 5)])
    dates = np.array([1.2, 0.85, 1.0, 1.1, 0.9], np.float32), np.array([0.05, 0.0, -0.05, 0.04, 0.0], np.float32)
    alike, apart = (match(views, pairs, RANGE, PriorOptions()) for views in (frame, brightened(frame, *dates)))
    assert apart.score.mean() > alike.score.mean() - 0.03
    assert np.abs(alike.height - apart.height)[24:38, 28:40].max() < 0.2

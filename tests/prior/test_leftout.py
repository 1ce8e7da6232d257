"""Views predicted from the others at a surface."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sattools.prior.frame import Frame
from sattools.prior.leftout import left_out_agreement

MARGIN = 8


def views(height: float) -> Frame:
    """Four images of a textured plane at `height` above the reference, each displaced by its slope."""
    texture = gaussian_filter(np.random.default_rng(1).random((96, 96)), 1.0).astype(np.float32)
    texture /= texture.std()
    slopes = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    images = [np.roll(texture, np.rint(s * height).astype(int), axis=(0, 1)) for s in slopes]
    return Frame(np.stack(images), np.ones((4, 96, 96), np.uint8), slopes, 0.0, 1.0, MARGIN, (None,) * 4)


def test_at_the_true_height_the_others_predict_every_view() -> None:
    frame = views(4.0)
    assert left_out_agreement(frame, np.full(frame.shape, 4.0, np.float32)) == pytest.approx([1.0] * 4, abs=1e-5)


def test_at_a_wrong_height_they_do_not() -> None:
    frame = views(4.0)
    # two to four cells off: the texture's correlation has gone after about three
    assert max(left_out_agreement(frame, np.zeros(frame.shape, np.float32))) < 0.4


def test_a_view_with_a_wrong_camera_stands_out() -> None:
    frame = views(4.0)
    frame.images[2] = np.roll(frame.images[2], 5, axis=1)
    found = left_out_agreement(frame, np.full(frame.shape, 4.0, np.float32))
    assert found.index(min(found)) == 2
    assert found[2] < 0.3 < 0.6 < min(found[0], found[1], found[3])


def test_a_view_that_shows_nothing_of_the_place_has_no_number() -> None:
    frame = views(4.0)
    frame.masks[1] = 0
    found = left_out_agreement(frame, np.full(frame.shape, 4.0, np.float32))
    assert found[1] is None
    assert None not in (found[0], found[2], found[3])

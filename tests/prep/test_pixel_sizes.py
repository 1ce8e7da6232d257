"""Images whose pixels differ in size: which of them cells are made for, and which blur the others."""

from typing import Any

import pytest

from sattools.prep.gate import check_pixel_sizes
from sattools.scene.grid import finer_pixel


def test_images_much_coarser_than_the_others_are_told_as_they_blur_the_surface() -> None:
    assert check_pixel_sizes([0.5, 0.52, 0.5, 0.5, 2.0, 2.1, 2.0, 2.0, 2.0, 2.0], [0.9] * 10) == [
        "6 of 10 images have pixels of 2 m, the others of 0.5 m: the coarse ones blur the surface, which is better "
        "without them"
    ]
    assert len(check_pixel_sizes([0.5, 0.5, 0.5, 0.5, 2.0], [1.0] * 5)) == 1
    assert check_pixel_sizes([0.5, 0.5, 0.5, 2.0, 2.0, 2.0], [1.0] * 6) == []  # three see too little between houses
    assert check_pixel_sizes([0.5, 0.5, 0.5, 0.5, 1.0, 1.0], [1.0] * 6) == []  # they help as much as they blur
    # one sensor from above, and 60 degrees from that, whose pixels are twice as wide and four times as long
    assert check_pixel_sizes([0.31, 0.31, 0.31, 0.32, *[0.95] * 7], [1.0, 1.0, 1.0, 0.99, *[0.5] * 7]) == []


@pytest.mark.parametrize(
    ("sizes", "pixel"),
    [
        ([0.5], 0.5),
        ([0.5, 2.0], 2.0),
        ([2.0, 0.5, 0.6], 2.0),
        ([2.0, 0.5, 0.6, 0.7], 0.7),
        ([*[2.0] * 9, 0.5, 0.6, 0.7], 0.7),
        ([*[2.0] * 10, 0.5, 0.6, 0.7], 2.0),
    ],
)
def test_cells_are_made_for_the_finest_quarter_of_the_images_and_three_at_least(sizes: Any, pixel: float) -> None:
    assert finer_pixel(sizes) == pixel

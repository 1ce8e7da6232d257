"""Images whose pixels differ in size: which of them cells are made for, and which blur the others."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sattools.prep import sweeps
from sattools.prep.gate import check_pixel_sizes, much_coarser
from sattools.prep.large import GrayImages
from sattools.scene.grid import finer_pixel


def test_images_much_coarser_than_the_others_are_told() -> None:
    assert check_pixel_sizes([0.5, 0.52, 0.5, 0.5, 2.0, 2.1, 2.0, 2.0, 2.0, 2.0], [0.9] * 10) == [
        "6 of 10 images have pixels of 2 m, the others of 0.5 m: the coarse ones count little in the matching, and may "
        "be left out"
    ]
    assert len(check_pixel_sizes([0.5, 0.5, 0.5, 0.5, 2.0], [1.0] * 5)) == 1
    assert check_pixel_sizes([0.5, 0.5, 0.5, 2.0, 2.0, 2.0], [1.0] * 6) == []  # three see too little between houses
    assert check_pixel_sizes([0.5, 0.5, 0.5, 0.5, 1.0, 1.0], [1.0] * 6) == []  # they help as much as they blur
    # one sensor from above, and 60 degrees from that, whose pixels are twice as wide and four times as long
    assert check_pixel_sizes([0.31, 0.31, 0.31, 0.32, *[0.95] * 7], [1.0, 1.0, 1.0, 0.99, *[0.5] * 7]) == []


def test_heights_of_towers_are_looked_for_without_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """They do not show the roofs, and outvote the images that do."""
    looked_at = []

    def estimate(heights: Any, grays: Any, cameras: Any, *rest: Any, **more: Any) -> Any:
        looked_at.append((cameras, [gray.shape for gray in grays]))
        return -10.0, 90.0

    class Camera(str):
        def reduced(self, _: Any) -> Any:
            return self

    monkeypatch.setattr(sweeps, "estimate_height_range", estimate)
    monkeypatch.setattr(sweeps, "pixels_on_ground", lambda *_: ([0.5, 0.5, 2.0, 0.5, 0.5, 0.5], [1.0] * 6))
    images = GrayImages([np.zeros((8, 8 + k), np.float32) for k in range(6)], [1] * 6)

    def of(weak: str) -> Any:
        views = [SimpleNamespace(weak=name in weak) for name in "abcdef"]
        cameras = [Camera(name) for name in "abcdef"]
        result: Any = SimpleNamespace(heights=lambda: np.array([0.0, 20.0]), rpcs=cameras, views=views)
        asked = (0.0, 0.0, 64.0, 64.0)
        return sweeps.height_range((None, None), result, images, "EPSG:32617", asked, lambda *_: None)

    assert of(weak="f") == (-10.0, 90.0)
    assert looked_at.pop() == (["a", "b", "d", "e"], [(8, 8), (8, 9), (8, 11), (8, 12)])
    of(weak="ef")  # too few would be left without the images whose cameras are not known
    assert looked_at.pop()[0] == ["a", "b", "d", "e", "f"]


def test_images_are_too_coarse_beside_four_others() -> None:
    assert much_coarser([0.5, 0.5, 2.0, 0.5, 0.5], [1.0] * 5).tolist() == [False, False, True, False, False]
    assert not much_coarser([0.5, 0.5, 2.0, 0.5], [1.0] * 4).any()  # three alone find fewer towers


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

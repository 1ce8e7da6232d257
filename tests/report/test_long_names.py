"""Pictures of the report with image names as long as vendors', and longer."""

import io
import warnings
from typing import Any

import numpy as np
import pytest

from sattools.report import figures

pytestmark = pytest.mark.drawn

NAMES = [f"IMG_PHR1A_P_20130515102112{k}_SEN_IPU_20170522_2146-" + 60 * "x" + f"-R1C{k}" for k in range(4)]


def extents(texts: Any) -> Any:
    return [text.get_window_extent() for text in texts if "IMG" in text.get_text()]


@pytest.mark.parametrize(
    "figure",
    [
        figures.residuals(NAMES, [0.130, 0.135, 0.14, 0.15], [0.131, 0.136, 0.142, 0.155]),
        figures.residual_vectors(dict.fromkeys(NAMES, np.array([[0.0, 0, 1, 1], [90, 90, 1, 0]]))),
        figures.footprints({name: [(0, 0), (0.1, 0), (0.1, 0.1)] for name in NAMES}, None),
        figures.histograms({name: np.arange(90.0) for name in NAMES}, "DN"),
    ],
    ids=["residuals", "vectors", "footprints", "histograms"],
)
def test_long_names_of_images_neither_cover_each_other_nor_the_figure(figure: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.savefig(io.BytesIO(), format="png", bbox_inches="tight")
    for axes in figure.axes:
        assert axes.get_window_extent().width > 90  # px of the 100 an inch has
    boxes = extents([axes.title for axes in figure.axes]) + extents(figure.axes[0].get_yticklabels())
    for k, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:k])

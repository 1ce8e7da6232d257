"""Does a surface explain an image that is left out? Each view predicted from the others at the heights found."""

from __future__ import annotations

import numpy as np

from sattools.prior.frame import Frame
from sattools.processors import side_by_side

AT_ONCE = 4  # views, of a few maps each
FEWEST_CELLS = 100  # below which a correlation says nothing


def left_out_agreement(frame: Frame, height: np.ndarray) -> list[float | None]:
    """Correlation of each view with the mean of all others where they show the surface.

    The view takes part in finding the surface, but not in its own prediction; occlusion is left out of account.
    A view with a wrong camera, clouds or another season stands out by a low number, a wrong surface lowers all.

    Args:
        frame: the views.
        height: ``[H, W]`` [m], on the grid inside the frame's margin.

    Returns:
        One number in [-1, 1] a view; None where fewer than 100 cells are shown by it and another one.
    """
    import cv2

    rows, cols = np.indices(height.shape, dtype=np.float32)
    dz = height - np.float32(frame.z_ref)
    shown = np.empty((len(frame.images), *height.shape), np.float32)
    seen = np.empty(shown.shape, bool)

    def show(view: int) -> None:
        r, c = (
            (at + frame.margin + slope * dz).astype(np.float32)
            for at, slope in zip((rows, cols), frame.parallax[view], strict=True)
        )
        image, mask = frame.images[view], frame.masks[view]
        shown[view] = cv2.remap(image, c, r, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen[view] = cv2.remap(mask, c, r, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0

    for _ in side_by_side(show, range(len(shown)), AT_ONCE):
        pass
    shown[~seen] = 0.0
    total, count = shown.sum(axis=0), seen.sum(axis=0)

    def correlation(view: int) -> float | None:
        own, both = shown[view], seen[view] & (count > 1)
        if both.sum() < FEWEST_CELLS:
            return None
        others = (total - own)[both] / (count[both] - 1)
        flat = min(own[both].std(), others.std()) < 1e-6
        return 0.0 if flat else float(np.corrcoef(own[both], others)[0, 1])

    return list(side_by_side(correlation, range(len(shown)), AT_ONCE))


__all__ = ["left_out_agreement"]

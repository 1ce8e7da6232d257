"""Does a surface explain an image that is left out? Each view predicted from the others at the heights found."""

from __future__ import annotations

import numpy as np

from sattools.prior.frame import Frame

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
    for k, (image, mask, per_metre) in enumerate(zip(frame.images, frame.masks, frame.parallax, strict=True)):
        r = (rows + frame.margin + per_metre[0] * dz).astype(np.float32)
        c = (cols + frame.margin + per_metre[1] * dz).astype(np.float32)
        shown[k] = cv2.remap(image, c, r, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen[k] = cv2.remap(mask, c, r, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0
    shown[~seen] = 0.0
    total, count = shown.sum(axis=0), seen.sum(axis=0)
    correlations: list[float | None] = []
    for own, valid in zip(shown, seen, strict=True):
        both = valid & (count > 1)
        if both.sum() < FEWEST_CELLS:
            correlations.append(None)
            continue
        others = (total - own)[both] / (count[both] - 1)
        flat = min(own[both].std(), others.std()) < 1e-6
        correlations.append(0.0 if flat else float(np.corrcoef(own[both], others)[0, 1]))
    return correlations


__all__ = ["left_out_agreement"]

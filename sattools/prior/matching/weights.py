"""How much each view and each pair of them counts.

A view counts less where it is blurred or has much wider pixels than the rest, a pair where it is narrow or what its
images show is not alike: their suns, seasons and hazes differ.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sattools.camera.view_direction import angle_deg
from sattools.prior.frame import Frame
from sattools.prior.matching.equalise import SHARP
from sattools.prior.options import PriorOptions
from sattools.prior.visibility.occlusion import Visibility, at_surface
from sattools.scene.grid import finer_pixel

SHARPNESS = 0.7  # of the sharper views': below it one counts less
FINENESS = 0.45  # width of fine pixels (or cells, if they are wider) over that of its own: the same
STEEP = 8  # power by which it falls below these
FEW, MANY = 4, 12  # views: of these few each is needed, of these many one counts as little as it may
ALIKE, WIDE = 3.0, 0.75  # powers of a pair's agreement, and of its intersection angle, by which it counts
LEAST = 0.1  # what a pair counts at least, of the one that counts most
WINDOW = 3  # cells of the windows whose agreement is measured
ENOUGH = 200  # of them tell how alike a pair is


def view_shares(sharpness: np.ndarray, pixels: Sequence[float], cell: float, least: float) -> tuple[float, ...]:
    """How much each view counts, for its sharpness and its pixels, but no less than the number of views affords.

    A blurred view agrees with itself at many heights, and at walls with the wrong ones.

    Args:
        sharpness: ``[V]``, from `equally_sharp`.
        pixels: edges of the images' pixels on the ground [m]; empty = unknown.
        cell: edge of a cell [m].
        least: what one of twelve views or more counts at least.
    """
    factors = np.minimum(for_sharpness(sharpness), for_pixels(pixels, cell) if pixels else 1.0)
    enough = min(max((len(factors) - FEW) / (MANY - FEW), 0.0), 1.0)
    return tuple(float(share) for share in np.clip(factors, least**enough, 1.0))


def for_sharpness(sharpness: np.ndarray) -> np.ndarray:
    """Factors ``[V]`` for detail that views lack, compared with the sharper half of them.

    Noise looks like detail: more than enough of it counts as enough.

    Args:
        sharpness: ``[V]``.
    """
    detail = np.minimum(sharpness, SHARP)
    return _fall(detail / max(float(np.percentile(detail, 75)), 1e-6), SHARPNESS)


def for_pixels(pixels: Sequence[float], cell: float) -> np.ndarray:
    """Factors ``[V]`` for pixels much wider than others are: between them is no detail, whatever interpolation makes.

    Args:
        pixels: edges of the images' pixels on the ground [m].
        cell: edge of a cell [m].
    """
    return _fall(max(finer_pixel(pixels), cell) / np.array(pixels), FINENESS)


def pair_shares(
    frame: Frame,
    visibility: Visibility,
    height: np.ndarray,
    sure: np.ndarray,
    pairs: np.ndarray,
    options: PriorOptions,
) -> tuple[float, ...]:
    """How much each pair counts, 1 = most: by how alike its images are, and its intersection angle.

    What images show of one surface differs by shading, season and haze, of trees most of all; a pair that is unlike
    where the height is known says little where it is not. And the wider its angle, the better a pair knows the height.

    Args:
        frame: the views, equally bright.
        visibility: what the surface hides and shades.
        height: ``[H, W]`` surface [m].
        sure: ``[H, W]`` bool, where the views agree about it.
        pairs: ``[P, 2]`` indices of the views.
        options: of the matching.
    """
    value, seen = at_surface(frame, visibility.first_hit_height, height, options.tolerance)
    alike = likeness(value, seen & sure & (height >= visibility.shadow_height), pairs, options)
    unknown = float(np.nanmedian(alike)) if np.isfinite(alike).any() else 1.0
    lines = [(*(parallax * frame.cell), 1.0) for parallax in frame.parallax]
    wide = np.array([angle_deg(lines[a], lines[b]) for a, b in pairs])
    share = wide**WIDE * np.where(np.isfinite(alike), alike, unknown) ** ALIKE
    return tuple(float(one) for one in np.maximum(share / max(float(share.max()), 1e-9), LEAST))


def likeness(value: np.ndarray, shown: np.ndarray, pairs: np.ndarray, options: PriorOptions) -> np.ndarray:
    """Mean agreement ``[P]`` of pairs of views on a surface, as `kernels.correlate` has it; NaN where little tells.

    Args:
        value: ``[V, H, W]`` float32 what the views show, mean near zero.
        shown: ``[V, H, W]`` bool where they show it in the sun.
        pairs: ``[P, 2]`` indices of the views.
        options: of the matching.
    """
    import cv2

    size = (WINDOW, WINDOW)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.blur(values, size, borderType=cv2.BORDER_REPLICATE))

    whole = [cv2.erode(one.astype(np.uint8), np.ones(size, np.uint8)) > 0 for one in shown]
    means = [mean(one) for one in value]
    variances = [np.maximum(mean(one * one) - middle * middle, 0) for one, middle in zip(value, means, strict=True)]
    floor = options.noise**2
    found = np.full(len(pairs), np.nan)
    for p, (a, b) in enumerate(pairs):
        both = whole[a] & whole[b]
        if np.count_nonzero(both) < ENOUGH:
            continue
        shared = np.maximum(2 * (mean(value[a] * value[b]) - means[a] * means[b]) + floor, 0)
        apart = (means[a] - means[b]) / options.brightness
        agreement = shared / ((variances[a] + variances[b] + floor) * (1 + apart * apart))
        found[p] = float(agreement[both].mean())
    return found


def _fall(share: np.ndarray, knee: float) -> np.ndarray:
    return np.asarray(np.minimum(share / knee, 1.0) ** STEEP)


__all__ = ["for_pixels", "for_sharpness", "likeness", "pair_shares", "view_shares"]

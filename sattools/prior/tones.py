"""Images as matching wants them: grey, with a tone curve, as bright as each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sattools.prior.frame import Frame
from sattools.views import RadiometricBalance, Source, View, match_colours

REFERENCE_CONTRAST = 0.8322  # from dark to bright (2 ... 98 %) in an 8-bit image of a city
LINEAR_TONE = 1 / 2.2  # exponent of the tone curve of linear images
WHITE = 98  # per cent of an image that are darker than what counts as white
MIDDLE = 0.5  # of white: as bright is the middle, at least, of images with a tone curve


def toned_views(sources: Sequence[Source], views: Sequence[View], tone: float | None) -> tuple[list[View], float]:
    """The views with a tone curve, band by band, and its exponent.

    What is added up or compared, bands and images, is so as it is seen: in the mean of linear bands the brightest
    one decides, and the spread of linear images is that of their brightest roofs.

    Args:
        sources: the images.
        views: what they show.
        tone: the exponent, where it is known; else see `tone_of`.
    """
    if not tone:
        tone = LINEAR_TONE
        if not all(source.linear for source in sources):
            images, masks = [view.target.mean(axis=-1) for view in views], [view.mask for view in views]
            tone = tone_of(np.stack(images), np.stack(masks))
    return [replace(view, target=toned(view.target, tone)) for view in views], tone


def tone_of(images: np.ndarray, masks: np.ndarray) -> float:
    """Exponent of the tone curve that images need to be matched which may have one.

    Linear radiance hides the texture of shadows in a sliver of its range. Images of 8 bits mostly bring a tone curve
    along, but they may be linear ones that a program has only scaled: these are dark. Theirs gets the middle half as
    bright as white.

    Args:
        images: ``[V, H, W]`` radiance.
        masks: ``[V, H, W]`` 1 = valid.
    """
    middle, white = _levels(images, masks, (50, WHITE))
    if not 0 < middle < MIDDLE * white:
        return 1.0
    return max(float(np.log(MIDDLE) / np.log(middle / white)), LINEAR_TONE)


def toned(images: np.ndarray, tone: float) -> np.ndarray:
    """The images (radiance) with a tone curve of that exponent."""
    return np.asarray(np.maximum(images, np.float32(0)) ** np.float32(tone)) if tone != 1 else images


def grey(views: Sequence[View], gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Mean of the views' bands as the first view shows them, ``[V, H, W]`` float32.

    Args:
        views: the images.
        gain: ``[V, C]``, see `match_colours`.
        offset: ``[V, C]``.
    """

    def one(view: View, own_gain: np.ndarray, own_offset: np.ndarray) -> np.ndarray:
        weight = (1 / (len(own_gain) * own_gain)).astype(np.float32)
        return view.target @ weight - np.float32(own_offset @ weight)

    return np.stack([one(view, a, b) for view, a, b in zip(views, gain, offset, strict=True)])


def with_contrast(images: np.ndarray, masks: np.ndarray, contrast: float | None = None) -> np.ndarray:
    """Grey images scaled to a usual contrast, so that thresholds mean the same for every sensor.

    Args:
        images: ``[V, H, W]`` brightness.
        masks: ``[V, H, W]`` 1 = valid.
        contrast: of all images, where it is known; else that of these.
    """
    scale = REFERENCE_CONTRAST / (contrast or _contrast_of(images, masks))
    return np.multiply(images, np.float32(scale), dtype=np.float32)


def _contrast_of(images: np.ndarray, masks: np.ndarray) -> float:
    """From dark to bright (2 ... 98 %) where the mask is 1."""
    low, high = _levels(images, masks, (2, WHITE))
    return max(high - low, 1e-6)


def _levels(images: np.ndarray, masks: np.ndarray, shares: tuple[float, float]) -> tuple[float, float]:
    """Percentiles where the mask is 1."""
    some, valid = images.ravel()[::7], masks.ravel()[::7] > 0
    low, high = np.percentile(some[valid], shares)
    return float(low), float(high)


def common_balance(frame: Frame, views: Sequence[View]) -> list[RadiometricBalance]:
    """How each view becomes grey as the others are, from all that they show; for parts of an area to agree on.

    Args:
        frame: of the views, which tells their tone.
        views: with that tone curve.
    """
    gain, offset = match_colours(views)
    contrast = _contrast_of(grey(views, gain, offset), np.stack([view.mask for view in views]))
    tone = frame.tone
    return [RadiometricBalance(a.tolist(), b.tolist(), contrast, tone) for a, b in zip(gain, offset, strict=True)]


__all__ = ["LINEAR_TONE", "common_balance", "grey", "tone_of", "toned", "toned_views", "with_contrast"]

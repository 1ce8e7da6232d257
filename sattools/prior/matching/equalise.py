"""Views made comparable: as sharp as each other, and on one surface as bright as each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sattools.prior.frame import Frame
from sattools.prior.visibility.occlusion import Visibility, at_surface
from sattools.processors import side_by_side

SHARP = 2.4  # standard deviation of detail, in units of what a blur by one cell leaves of it, that views are brought to
MOST = 1.5  # times the detail that is added, at most
AT_ONCE = 4  # views, of a few maps each
ENOUGH = 20_000  # cells that tell gain and offset
FEWEST = 500  # cells without which they are left as they are
ROUNDS = 3  # of a consensus of all views, and of every view's gain and offset to it
LINES = 4  # of these, each without what the one before does not explain
OUTLYING = 2.5  # standard deviations from which on a cell shows something else: what grew, was parked or built


def equally_sharp(images: np.ndarray, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The views ``[V, H, W]`` float32 with as much detail added as brings them to one sharpness; none is blurred.

    Optics, haze, resampling and a slanted line of sight take fine detail from images, from each a share of its own.
    Steps and what is small are seen by that detail. Where it is plenty, or noise, which looks like it, a view stays
    as it is.

    Args:
        images: ``[V, H, W]`` float32.
        masks: ``[V, H, W]`` 1 = valid.

    Returns:
        The views, and how sharp each was ``[V]``: the standard deviation of its detail, in units of what a blur by one
        cell leaves of it.
    """
    result, sharpness = np.empty_like(images), np.zeros(len(images))

    def sharpen(view: int) -> None:
        result[view], sharpness[view] = _sharpened(images[view], masks[view] > 0)

    for _ in side_by_side(sharpen, range(len(images)), AT_ONCE):
        pass
    return result, sharpness


def _sharpened(image: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, float]:
    """One of them."""
    import cv2

    def blurred(values: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.GaussianBlur(values, (0, 0), 1.0, borderType=cv2.BORDER_REFLECT))

    weight = blurred(valid.astype(np.float32))

    def detail(values: np.ndarray) -> np.ndarray:
        """What a blur by one cell takes away, from valid pixels alone."""
        return np.where(valid, values - blurred(values) / np.maximum(weight, np.float32(1e-6)), np.float32(0))

    fine = detail(np.where(valid, image, np.float32(0)))
    finer = detail(fine)
    finest = detail(finer)
    there = fine[valid], finer[valid], finest[valid]
    amount, left = _detail_wanted(*there), float(np.std(there[0] - there[1])) if valid.any() else 0.0
    return np.asarray(image + np.float32(amount) * fine), float(np.std(there[0])) / left if left > 0 else SHARP


def _detail_wanted(fine: np.ndarray, finer: np.ndarray, finest: np.ndarray) -> float:
    """How often to add ``fine`` to an image whose detail it is, ``finer`` being the detail of that, and so on.

    With the amount a, detail is fine + a finer, and a blur leaves (fine - finer) + a (finer - finest) of it.
    """
    if not len(fine):
        return 0.0

    def excess(a: np.ndarray, b: np.ndarray, left_a: np.ndarray, left_b: np.ndarray) -> float:
        return float(np.mean(a * b, dtype=np.float64) - SHARP**2 * np.mean(left_a * left_b, dtype=np.float64))

    left, left_finer = fine - finer, finer - finest
    constant = excess(fine, fine, left, left)
    linear, square = 2 * excess(fine, finer, left, left_finer), excess(finer, finer, left_finer, left_finer)
    if constant >= 0:  # sharp enough
        return 0.0
    amounts = [root.real for root in np.roots([square, linear, constant]) if abs(root.imag) < 1e-9 and root.real > 0]
    return min(*amounts, MOST) if amounts else MOST


def equally_bright(
    frame: Frame, visibility: Visibility, height: np.ndarray, sure: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset per view ``[V]`` float32 with which all show lit ground and roofs equally bright.

    Brightness over whole images says how much shadow, facade and haze each holds; on one surface it says how bright
    each shows it.

    Args:
        frame: the views.
        visibility: what the surface hides and shades.
        height: ``[H, W]`` surface [m].
        sure: ``[H, W]`` bool, where the views agree about it.
        tolerance: depth below the visible surface that still counts as seen [m].
    """
    value, seen = at_surface(frame, visibility.first_hit_height, height, tolerance)
    lit = seen & (height >= visibility.shadow_height) & sure
    several = np.flatnonzero(lit.sum(axis=0) >= 2)
    cells = several[:: max(1, len(several) // ENOUGH)]
    return gains(*(maps.reshape(len(maps), -1)[:, cells] for maps in (value, lit)))


def gains(value: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset per view ``[V]`` float32 that bring all to one brightness; in the mean they change nothing.

    Args:
        value: ``[V, N]`` float32 what every view shows of N places.
        shown: ``[V, N]`` bool where it does; each place by two views or more.
    """
    own = np.where(shown, value, np.nan).astype(np.float64)
    gain, offset = np.ones(len(own)), np.zeros(len(own))
    if not own.shape[1]:
        return gain.astype(np.float32), offset.astype(np.float32)
    for _ in range(ROUNDS):
        common = np.nanmedian(gain[:, None] * own + offset[:, None], axis=0)
        for v, there in enumerate(shown):
            if there.sum() >= FEWEST:
                gain[v], offset[v] = _line(own[v, there], common[there])
        mean = np.exp(np.log(gain).mean())
        gain, offset = gain / mean, (offset - offset.mean()) / mean
    return gain.astype(np.float32), offset.astype(np.float32)


def _line(own: np.ndarray, common: np.ndarray) -> tuple[float, float]:
    """Gain and offset from what a view shows to what all do; the gain is that of two measurements, both with errors."""
    good = np.ones(len(own), bool)
    gain, offset = 1.0, 0.0
    for _ in range(LINES):
        x, y = own[good], common[good]
        if x.std() <= 0 or y.std() <= 0:
            return 1.0, 0.0
        gain = float(y.std() / x.std())
        offset = float(y.mean() - gain * x.mean())
        off = np.abs(gain * own + offset - common)
        good = off <= OUTLYING * 1.4826 * max(float(np.median(off)), 1e-6)
    return gain, offset


def brightened(frame: Frame, gain: np.ndarray, offset: np.ndarray) -> Frame:
    """The frame with each view's gain and offset ``[V]``."""
    return replace(frame, images=frame.images * gain[:, None, None] + offset[:, None, None])


__all__ = ["SHARP", "brightened", "equally_bright", "equally_sharp", "gains"]

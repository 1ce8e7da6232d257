"""How much each view counts: less where it is blurred, or has much wider pixels than the rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sattools.prior.matching.equalise import SHARP
from sattools.scene.grid import finer_pixel

SHARPNESS = 0.7  # of the sharper views': below it one counts less
FINENESS = 0.45  # width of fine pixels (or cells, if they are wider) over that of its own: the same
STEEP = 8  # power by which it falls below these
FEW, MANY = 4, 12  # views: of these few each is needed, of these many one counts as little as it may


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


def _fall(share: np.ndarray, knee: float) -> np.ndarray:
    return np.asarray(np.minimum(share / knee, 1.0) ** STEEP)


__all__ = ["for_pixels", "for_sharpness", "view_shares"]

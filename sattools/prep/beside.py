"""Whether a multispectral image lies where the panchromatic one of its acquisition does."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sattools.camera.rpc import RPC
from sattools.prep.images import SourceImage
from sattools.prep.pixels import read_gray

_PIECE_PX = 256  # edge of the piece of the multispectral image that is looked at
_LEAST_PX = 32
_NEAR_PX = 1.5  # which the two sensors may be apart
_ALIKE = 0.5  # correlation where the two lie one on the other


def _displacement(colours: NDArray[np.float32], pan: NDArray[np.float32]) -> tuple[float, float]:
    """By how many pixels (column, row) what ``pan`` shows lies elsewhere in ``colours``; (0, 0) where they are unlike.

    Args:
        colours: ``[H, W]`` grey, NaN where unknown.
        pan: ``[H, W]`` what it should show by the two cameras, likewise.
    """
    pair = [np.where(np.isfinite(v), v - np.nanmean(v), 0.0).astype(np.float32) for v in (pan, colours)]
    window = cv2.createHanningWindow(pan.shape[::-1], cv2.CV_32F)
    (col, row), _ = cv2.phaseCorrelate(pair[0], pair[1], window)
    moved = cv2.warpAffine(pan, np.array([[1, 0, col], [0, 1, row]]), pan.shape[::-1], borderValue=float("nan"))
    known = np.isfinite(moved) & np.isfinite(pan) & np.isfinite(colours)
    if known.mean() < 0.1 or np.hypot(col, row) <= _NEAR_PX:
        return 0.0, 0.0
    there, here = (np.corrcoef(shown[known], colours[known])[0, 1] for shown in (moved, pan))
    return (float(col), float(row)) if there > max(_ALIKE, here) else (0.0, 0.0)


def beside(colour: SourceImage, rpc: RPC, pan: SourceImage, camera: RPC, height: float) -> list[str]:
    """A line where the middle of a multispectral image's window shows what lies elsewhere in the panchromatic one.

    Both fly on one satellite and see the ground from one direction, so any height will do.

    Args:
        colour: the multispectral image with its window.
        rpc: its camera.
        pan: the panchromatic image with its window.
        camera: its camera.
        height: of the ground, about [m above the ellipsoid].
    """
    col0, row0, width, height_px = colour.window
    w, h = min(width, _PIECE_PX), min(height_px, _PIECE_PX)
    piece = (col0 + (width - w) // 2, row0 + (height_px - h) // 2, w, h)
    row, col = np.mgrid[piece[1] : piece[1] + h, piece[0] : piece[0] + w].astype(np.float64)
    at = np.array(camera.projection(*rpc.localization(col, row, height), height))
    if min(w, h) < _LEAST_PX or not np.isfinite(at).all():
        return []
    factor = max(1, round(float(np.ptp(at, axis=(1, 2)).max()) / max(w, h)))
    left, top, wide, high = pan.window
    start = np.maximum(np.floor(at.min(axis=(1, 2))).astype(int) - factor, (left, top))
    end = np.minimum(np.ceil(at.max(axis=(1, 2))).astype(int) + factor, (left + wide, top + high))
    if (end - start < factor).any():
        return []
    cut = (int(start[0]), int(start[1]), int(end[0] - start[0]), int(end[1] - start[1]))
    seen = read_gray(replace(pan, window=cut), factor, whole=False)
    there = ((at - start[:, None, None] - (factor - 1) / 2) / factor).astype(np.float32)
    shown = np.asarray(cv2.remap(seen, there[0], there[1], cv2.INTER_LINEAR, borderValue=float("nan")), np.float32)
    own = read_gray(replace(colour, window=piece), whole=False)
    if not (np.isfinite(shown).any() and np.isfinite(own).any()):
        return []
    length = float(np.hypot(*_displacement(own, shown)))
    if length == 0:
        return []
    return [
        f"{pan.id}: its colours lie {length:.0f} of their pixels beside it: is the RPC of {colour.path} that of this "
        "part of the image?"
    ]


__all__ = ["beside"]

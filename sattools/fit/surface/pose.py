"""Refinement of one shift per view during the fit (what bundle adjustment left over)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def image_shift(rendered: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Least-squares (column, row) shift d with rendered(x + d) = target(x) (Lucas & Kanade 1981).

    Args:
        rendered: ``[H, W, C]``.
        target: ``[H, W, C]``.
        weight: ``[H, W]``, 0 where a pixel does not count.

    Returns:
        ``[2]`` in cells; zero when the rendered image has no structure.
    """
    gy, gx = np.gradient(rendered, axis=(0, 1))
    w = weight[..., None]
    residual = target - rendered
    a = np.array([[(w * gx * gx).sum(), (w * gx * gy).sum()], [(w * gx * gy).sum(), (w * gy * gy).sum()]], np.float64)
    b = np.array([(w * gx * residual).sum(), (w * gy * residual).sum()], np.float64)
    if np.linalg.det(a) <= 1e-9 * max(np.trace(a), 1e-12) ** 2:
        return np.zeros(2)
    return np.linalg.solve(a, b)


def remove_gauge(shifts: np.ndarray, slopes: Sequence[tuple[float, float]]) -> np.ndarray:
    """Shifts ``[V, 2]`` [m] less what a common shift and a common change of height would explain.

    A surface moved by (dx, dy, dz) is seen by view j moved by (dx, dy) - slope_j * dz: the images cannot tell, so the
    views must not follow.
    """
    count = len(slopes)
    design = np.zeros((2 * count, 3))
    design[0::2, 0] = 1
    design[1::2, 1] = 1
    design[:, 2] = -np.asarray(slopes, np.float64).ravel()
    solution, *_ = np.linalg.lstsq(design, shifts.ravel(), rcond=None)
    return (shifts.ravel() - design @ solution).reshape(-1, 2)


__all__ = ["image_shift", "remove_gauge"]

"""Matching of feature descriptors between two views whose geometry is roughly known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Matches = NDArray[np.intp]

RATIO = 0.65  # of squared distances to the best and to the second best (0.8 of distances: Lowe 2004, section 7.1)
MAX_DISTANCE2 = 0.45  # squared distance of unit descriptors that is no match any more


def frame(run: Array) -> tuple[Array, Array, float]:
    """Unit vectors along and across the run of height, and the metres of run per metre of height."""
    length = float(np.hypot(*run))
    along = run / length if length > 1e-6 else np.array([1.0, 0.0])
    return along, np.array([-along[1], along[0]]), length


def free_matches(
    ground_a: Array,
    descriptor_a: NDArray[np.float32],
    ground_b: Array,
    descriptor_b: NDArray[np.float32],
    run: Array,
    *,
    half_height: float,
    half_bias: float,
) -> Matches:
    """Mutual best matches `[m, 2]` among all features whose distance agrees with the height range and camera errors.

    Args:
        ground_a: ``[n, 2]`` places of the features of view a [m].
        descriptor_a: ``[n, 128]`` of unit length.
        ground_b: ``[m, 2]`` of view b [m].
        descriptor_b: ``[m, 128]`` of unit length.
        run: displacement of b against a per metre of height [m/m].
        half_height: half of the height range [m].
        half_bias: largest error of the cameras [m].
    """
    if len(ground_a) < 2 or len(ground_b) < 2:
        return np.empty((0, 2), np.intp)
    along, across, length = frame(run)
    far = _apart(ground_a @ along, ground_b @ along, half_height * length + half_bias)
    far |= _apart(ground_a @ across, ground_b @ across, half_bias)
    # of unit vectors: the nearer, the larger their product
    product = descriptor_a @ descriptor_b.T
    np.copyto(product, np.float32(-1), where=far)
    index = np.arange(len(ground_a))
    best_b = product.argmax(1)
    best = product[index, best_b]
    mutual = best == product.max(0)[best_b]
    product[index, best_b] = -1
    nearest, next_best = (np.maximum(2 - 2 * p, 1e-4) for p in (best, product.max(1)))
    good = mutual & (nearest < RATIO * next_best) & (nearest < MAX_DISTANCE2)
    return np.stack([index[good], best_b[good]], 1)


def corridor_matches(
    ground_a: Array,
    descriptor_a: NDArray[np.float32],
    ground_b: Array,
    descriptor_b: NDArray[np.float32],
    run: Array,
    *,
    half_height: float,
    half_width: float,
) -> tuple[Matches, NDArray[np.float32]]:
    """Mutual best matches `[m, 2]` inside narrow corridors, and their squared descriptor distances.

    Args:
        ground_a: ``[n, 2]`` places of the features of view a [m].
        descriptor_a: ``[n, 128]`` of unit length.
        ground_b: ``[m, 2]`` of view b [m].
        descriptor_b: ``[m, 128]`` of unit length.
        run: displacement of b against a per metre of height [m/m].
        half_height: half of the height range [m].
        half_width: half width of the corridor [m].
    """
    from scipy.spatial import cKDTree

    none = np.empty((0, 2), np.intp), np.empty(0, np.float32)
    if len(ground_a) == 0 or len(ground_b) == 0:
        return none
    along, across, length = frame(run)
    # Scaled so that the corridor is a square of half width 1: a Chebyshev ball of the tree.
    scale = np.stack([along / (half_height * length + half_width), across / half_width], 1)
    near = cKDTree(ground_a @ scale).sparse_distance_matrix(
        cKDTree(ground_b @ scale), 1.0, p=np.inf, output_type="coo_matrix"
    )
    a, b = near.row.astype(np.intp), near.col.astype(np.intp)
    if a.size == 0:
        return none
    order = np.lexsort((b, a))
    a, b = a[order], b[order]
    distance = np.empty(a.size, np.float32)
    for start in range(0, a.size, 1 << 15):
        part = slice(start, start + (1 << 15))
        distance[part] = 2.0 - 2.0 * np.einsum("nk,nk->n", descriptor_a[a[part]], descriptor_b[b[part]])
    best_for_a, ratio_a = _best(a, distance, len(ground_a))
    best_for_b, ratio_b = _best(b, distance, len(ground_b))
    index = np.arange(a.size)
    good = (best_for_a[a] == index) & (best_for_b[b] == index) & (distance < MAX_DISTANCE2)
    good &= (ratio_a[a] < RATIO) & (ratio_b[b] < RATIO)
    return np.stack([a[good], b[good]], 1), distance[good]


def vote(ground_a: Array, ground_b: Array, run: Array, pixel_m: float) -> tuple[Array, Array, float]:
    """Shift of view b against view a as most matches see it.

    Returns (unit vectors `[k, 2]`, shifts `[k]` in metres along them, weight): across the run only, or along both axes
    for lines of sight so parallel that height hardly moves anything; nothing without a clear majority.

    Args:
        ground_a: ``[m, 2]`` places of the matches in view a [m].
        ground_b: ``[m, 2]`` in view b [m].
        run: displacement of b against a per metre of height [m/m].
        pixel_m: edge of a pixel [m].
    """
    none = np.empty((0, 2)), np.empty(0), 0.0
    along, across, length = frame(run)
    axes = np.array([across]) if length > 0.03 else np.array([along, across])
    if len(ground_a) < 8:
        return none
    amounts = []
    support = np.ones(len(ground_a), bool)
    for axis in axes:
        values = (ground_b - ground_a) @ axis
        centre = _mode(values, 1.5 * pixel_m)
        near = np.abs(values - centre) < 2.0 * pixel_m
        amounts.append(float(np.median(values[near])))
        support &= near
    # Chance agreement: false matches spread over the window would put few into the peak.
    if support.sum() < max(8, 0.1 * len(ground_a)):
        return none
    return axes, np.array(amounts), float(support.sum())


def _mode(values: Array, width: float) -> float:
    """Centre of the interval of +-width that holds most values."""
    ordered = np.sort(values)
    count = np.searchsorted(ordered, ordered + width, "right") - np.searchsorted(ordered, ordered - width, "left")
    best = np.flatnonzero(count == count.max())
    return float(ordered[best[len(best) // 2]])


def _apart(a: Array, b: Array, limit: float) -> NDArray[np.bool_]:
    """Which of ``[n]`` and ``[m]`` numbers differ by more than a limit, ``[n, m]``."""
    centre = a.mean()
    difference = (a - centre).astype(np.float32)[:, None] - (b - centre).astype(np.float32)[None]
    np.abs(difference, out=difference)
    return difference > np.float32(limit)


def _best(owner: Matches, distance: NDArray[np.float32], count: int) -> tuple[Matches, NDArray[np.float32]]:
    """For each owner the entry of least distance (-1 if none) and the ratio of the least to the second least."""
    order = np.lexsort((distance, owner))
    ranked = owner[order]
    first = np.flatnonzero(np.r_[True, ranked[1:] != ranked[:-1]])
    best = np.full(count, -1, np.intp)
    best[ranked[first]] = order[first]
    ratio = np.zeros(count, np.float32)
    second = first + 1
    has = second < len(order)
    has[has] = ranked[second[has]] == ranked[first[has]]
    nearest, next_best = (np.maximum(distance[order[k[has]]], 1e-4) for k in (first, second))  # 0 / 0: ambiguous
    ratio[ranked[first[has]]] = nearest / next_best
    return best, ratio


__all__ = ["Matches", "corridor_matches", "frame", "free_matches", "vote"]

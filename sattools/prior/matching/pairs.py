"""Which images to correlate with which."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from sattools.camera.view_direction import SMALLEST_ANGLE, angle_deg

ANGLE_WEIGHT = 0.5  # degrees of sun direction that one degree off the ideal intersection angle is worth
FEWEST_PAIRS = 3  # below this, pairs outside the wanted angles are better than none
NARROWEST = 4.0  # degrees between near-vertical views that look into courtyards, where wider pairs cannot
NARROW_SHARE = 6  # so many pairs for each of those
UNKNOWN_SUN = 30.0  # degrees assumed between two suns if one is unknown: about that of images of different seasons


def choose_pairs(
    slopes: Sequence[tuple[float, float]],
    suns: Sequence[tuple[float, float, float] | None],
    count: int,
    limits: tuple[float, float] = (12.0, 40.0),
    ideal: float = 25.0,
) -> np.ndarray:
    """The pairs of views most likely to look alike and yet to determine height.

    A pair's cost is the angle between its suns (shadows and shading differ with it) plus half the distance of its
    intersection angle from the ideal one. To the pairs with an angle within the limits come a few narrower ones: the
    floor of a courtyard is seen from nearly above or not at all. Where too few pairs have an angle within the limits,
    the nearest others are taken as well, so that two or three views always give something.

    Args:
        slopes: (east, north) displacement per metre of height of each view.
        suns: unit vectors to the sun; None = unknown.
        count: largest number of pairs with an angle within the limits.
        limits: smallest and largest intersection angle [degrees].
        ideal: preferred intersection angle [degrees].

    Returns:
        ``[P, 2]`` int64 indices, best first; empty if no two views differ by a degree.
    """
    candidates, narrow = [], []
    for a, b in itertools.combinations(range(len(slopes)), 2):
        angle = angle_deg((*slopes[a], 1.0), (*slopes[b], 1.0))
        if angle < SMALLEST_ANGLE:
            continue
        sun_a, sun_b = suns[a], suns[b]
        apart = UNKNOWN_SUN if sun_a is None or sun_b is None else angle_deg(sun_a, sun_b)
        if NARROWEST <= angle < limits[0]:
            narrow.append((apart + ANGLE_WEIGHT * abs(angle - ideal), a, b))
        outside = max(limits[0] - angle, angle - limits[1], 0.0)
        candidates.append((outside, apart + ANGLE_WEIGHT * abs(angle - ideal), a, b))
    inside = sorted((cost, a, b) for outside, cost, a, b in candidates if outside == 0)
    chosen = [(a, b) for _, a, b in inside[:count]]
    if len(chosen) < min(FEWEST_PAIRS, count):
        others = sorted(entry for entry in candidates if entry[0] > 0)
        chosen += [(a, b) for _, _, a, b in others[: min(FEWEST_PAIRS, count) - len(chosen)]]
    else:
        chosen += [(a, b) for _, a, b in sorted(narrow)[: len(chosen) // NARROW_SHARE]]
    return np.array(chosen, np.int64).reshape(-1, 2)


__all__ = ["angle_deg", "choose_pairs"]

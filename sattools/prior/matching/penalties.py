"""What it costs a surface to change its height from one cell to the next."""

from __future__ import annotations

import math
from typing import NamedTuple

from sattools.prior.options import PriorOptions

MANY_PAIRS = 60.0  # pairs from which on the penalty of a height jump is the one that is given
MOST = 4.0  # factor of it where there are few
MANY_FOR_ONE_PLANE = 30.0  # the same for a change by one plane
MOST_FOR_ONE_PLANE = 1.5
HILLS_FOR_ONE_PLANE = 0.5  # factor of it on hills, however many pairs: heights change from cell to cell there
PLAIN = 1.4  # factor of the penalty of a jump where the images show nothing that changes at the upper height
EDGE = 0.4  # the same where they show an edge there
LEAST_CONTRAST = 1e-6  # of the images that tells an edge: its inverse's square must be a number in single precision


class Penalties(NamedTuple):
    """What it costs a path to change its height, as agreements.

    Attributes:
        small: for a change by one plane.
        plain: for any larger change where the images show nothing that changes.
        edge: for one where they change by much more than ``contrast``.
        contrast: change of brightness at which it is halfway between the two.
    """

    small: float
    plain: float
    edge: float
    contrast: float


def penalties(options: PriorOptions, pairs: int, hills: float = 0.0) -> Penalties:
    """What height changes cost a path of the aggregation.

    Args:
        options: see `PriorOptions`.
        pairs: number of pairs.
        hills: whether the ground rises and falls, 0 to 1.
    """
    in_town = scarcity(pairs, MANY_FOR_ONE_PLANE, MOST_FOR_ONE_PLANE)
    small = options.small_jump * (in_town + hills * (HILLS_FOR_ONE_PLANE - in_town))
    large = options.large_jump * scarcity(pairs)
    if not options.edges:
        return Penalties(small, large, large, 1.0)
    return Penalties(small, PLAIN * large, EDGE * large, max(options.edges, LEAST_CONTRAST))


def scarcity(pairs: int, many: float = MANY_PAIRS, most: float = MOST) -> float:
    """Factor of a penalty: agreement is an average, and so the noisier the fewer pairs there are.

    Args:
        pairs: number of pairs.
        many: that from which on the factor is 1.
        most: largest factor.
    """
    return min(max(math.sqrt(many / max(pairs, 1)), 1.0), most)


__all__ = ["Penalties", "penalties", "scarcity"]

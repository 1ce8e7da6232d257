"""What it costs a surface to change its height from one cell to the next."""

from __future__ import annotations

import math
from typing import NamedTuple

from sattools.prior.options import PriorOptions

MANY_PAIRS = 60  # pairs for which the penalty of a height jump is meant
PLAIN = 1.4  # factor of that penalty where the images show nothing that changes at the upper height
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


def penalties(options: PriorOptions, pairs: int) -> Penalties:
    """What height changes cost a path of the aggregation.

    Args:
        options: see `PriorOptions`.
        pairs: number of pairs.
    """
    large = options.large_jump * scarcity(pairs)
    if not options.edges:
        return Penalties(options.small_jump, large, large, 1.0)
    return Penalties(options.small_jump, PLAIN * large, EDGE * large, max(options.edges, LEAST_CONTRAST))


def scarcity(pairs: int) -> float:
    """Factor of the penalty for height jumps: agreement is an average, and so the noisier the fewer pairs there are."""
    return min(max(math.sqrt(MANY_PAIRS / max(pairs, 1)), 1.0), 4.0)


__all__ = ["Penalties", "penalties", "scarcity"]

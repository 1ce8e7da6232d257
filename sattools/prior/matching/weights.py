"""How much each view counts: less where it is blurred, or shows other ground than the rest (snow, a flood)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sattools.prior.matching.equalise import SHARP
from sattools.prior.matching.sweep import MatchTask, agreement
from sattools.prior.visibility.occlusion import Visibility

SHARPNESS = 0.7  # of the sharper views': below it one counts less
LIKENESS = 0.8  # of the middle view's: the same
STEEP = 8  # power by which it falls below these
FEW, MANY = 4, 12  # views: of these few each is needed, of these many one counts as little as `unlike` says
FEWEST = 500  # cells of a pair without which it says nothing
PULL = 0.1  # of every view towards the mean, beside one pair's pull


def for_sharpness(sharpness: np.ndarray) -> np.ndarray:
    """Factors ``[V]`` for detail that views lack, from what `equally_sharp` says of it.

    A blurred view agrees with itself at many heights, and at walls it agrees with the wrong ones. The views are
    compared with the sharper half of them. Noise looks like detail: more than enough of it counts as enough.

    Args:
        sharpness: ``[V]``.
    """
    detail = np.minimum(sharpness, SHARP)
    return _fall(detail / max(float(np.percentile(detail, 75)), 1e-6), SHARPNESS)


def for_likeness(task: MatchTask, visibility: Visibility, height: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """Factors ``[V]`` for views that agree less than the others do, on a surface that is known roughly.

    The mean agreement of a pair is taken for the product of two numbers, one for each of its views.

    Args:
        task: of a rough pass, as bright as each other.
        visibility: what the surface hides and shades.
        height: ``[H, W]`` surface [m].
        sure: ``[H, W]`` bool, where the views agree about it.
    """
    views, base = len(task.frame.images), np.pad(height.astype(np.float32), task.options.window, mode="edge")
    of, logs = [], []
    for pair in task.pairs:
        agreeing = agreement(*_pair_alone(task, visibility, pair), np.zeros(1), base)[:, 0][sure]
        agreeing = agreeing[agreeing > 0]  # elsewhere one of them is hidden, or in other light
        if len(agreeing) >= FEWEST:
            of.append(np.isin(np.arange(views), pair))
            logs.append(float(np.log(agreeing.mean(dtype=np.float64))))
    if not logs:
        return np.ones(views)
    middle = np.mean(logs) / 2
    equations = np.vstack([np.array(of, np.float64), PULL * np.eye(views)])
    likeness = np.linalg.lstsq(equations, np.append(logs, np.full(views, PULL * middle)), rcond=None)[0]
    return _fall(np.exp(likeness - np.median(likeness)), LIKENESS)


def _pair_alone(task: MatchTask, visibility: Visibility, pair: np.ndarray) -> tuple[MatchTask, Visibility]:
    """A task of two of its views, which agree by what both surely show."""
    frame = task.frame
    two = replace(
        frame,
        images=frame.images[pair],
        masks=frame.masks[pair],
        parallax=frame.parallax[pair],
        suns=tuple(frame.suns[view] for view in pair),
        shares=(),
    )
    inside = Visibility(visibility.first_hit_height[pair], visibility.shadow_height[pair], visibility.dark[pair])
    return replace(task, frame=two, pairs=np.array([(0, 1)]), robust=False), inside


def shares_of(factors: np.ndarray, least: float) -> tuple[float, ...]:
    """How much each view counts: its factor, but no less than their number affords.

    Args:
        factors: ``[V]`` in [0, 1].
        least: what one of twelve views or more counts at least.
    """
    enough = min(max((len(factors) - FEW) / (MANY - FEW), 0.0), 1.0)
    return tuple(float(share) for share in np.clip(factors, least**enough, 1.0))


def _fall(share: np.ndarray, knee: float) -> np.ndarray:
    return np.asarray(np.minimum(share / knee, 1.0) ** STEEP)


__all__ = ["for_likeness", "for_sharpness", "shares_of"]

"""What every pair of images has in common: the angle between their lines of sight, tie points, residuals."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from sattools.camera.adjust import Adjustment
from sattools.camera.rpc import RPC
from sattools.prep.images import SourceImage
from sattools.prep.times import same_moment
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.views import line_of_sight

SHOWN = 100  # residuals of an image that its report keeps
_SAME_SIGHT_DEG = 0.05  # between lines of sight: satellites that pass again do not come that close
_MOST = 0.5  # of an image's tie points, which it shares with another one of its acquisition
IN_HISTORY = 40  # pairs of a scene that its history keeps: those with the most tie points


def pair_table(result: Adjustment, grid: Grid, heights: tuple[float, float]) -> list[JsonObject]:
    """One entry per pair of images with common tie points, those with the most first.

    Args:
        result: corrected cameras and their tie points.
        grid: ground grid.
        heights: lowest and highest [m].

    Returns:
        ``images`` (two names), ``angle_deg`` between the lines of sight, ``tie_points``, and the median residuals
        ``before_px`` and ``after_px`` of these in both images.
    """
    sights = np.array([_sight(rpc, grid, heights) for rpc in result.rpcs])
    tracks = result.tracks
    seen = np.zeros((len(result.rpcs), tracks.n_points), bool)
    seen[tracks.view, tracks.point] = True
    before, after = result.before_px, np.hypot(result.residuals[:, 0], result.residuals[:, 1])
    table: list[JsonObject] = []
    for a, b in combinations(range(len(result.rpcs)), 2):
        common = seen[a] & seen[b]
        if not common.any():
            continue
        own = common[tracks.point] & np.isin(tracks.view, (a, b))
        angle = np.degrees(np.arccos(np.clip(sights[a] @ sights[b], -1.0, 1.0)))
        table.append(
            {
                "images": [result.views[a].name, result.views[b].name],
                "angle_deg": round(float(angle), 2),
                "tie_points": int(common.sum()),
                "before_px": round(float(np.median(before[own])), 3),
                "after_px": round(float(np.median(after[own])), 3),
            }
        )
    return sorted(table, key=lambda row: -row["tie_points"])


def repeated(pairs: Sequence[JsonObject], result: Adjustment, sources: Sequence[SourceImage]) -> list[str]:
    """A line for each pair of images that are one acquisition, as two products of it: it counts twice in matching.

    Neighbouring parts of one that share a strip are none.

    Args:
        pairs: table of the pairs, see `pair_table`.
        result: corrected cameras and their tie points.
        sources: the images.
    """
    times = {source.id: source.metadata.time for source in sources}
    points = {view.name: view.tie_points for view in result.views}
    found = []
    for row in pairs:
        first, second = row["images"]
        if row["angle_deg"] >= _SAME_SIGHT_DEG or row["tie_points"] < _MOST * min(points[first], points[second]):
            continue
        same, unknown = same_moment(times[first], times[second]), times[first] is times[second] is None
        if same or unknown:
            found.append(
                f"{first} and {second} look from one direction{' at one time' if same else ''}: one acquisition, which "
                "counts twice? Leave one of them out"
            )
    return found


def residual_vectors(result: Adjustment) -> list[list[list[float]]]:
    """Of every image up to `SHOWN` of its residuals after the adjustment: column, row, and the residual's two [px]."""
    tracks = result.tracks
    found = []
    for view in range(len(result.rpcs)):
        own = np.flatnonzero(tracks.view == view)
        own = own[:: max(1, -(-own.size // SHOWN))]
        rows = np.hstack([tracks.pixel[own], result.residuals[own]])
        found.append(np.round(rows, 2).tolist())
    return found


def _sight(rpc: RPC, grid: Grid, heights: tuple[float, float]) -> Sequence[float]:
    low, high = heights
    direction, _ = line_of_sight(rpc, grid, (low + high) / 2, (low, max(high, low + 1.0)))
    return direction.unit()


__all__ = ["IN_HISTORY", "pair_table", "repeated", "residual_vectors"]

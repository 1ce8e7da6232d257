"""Tracks: one ground point and its pixels in several images, joined from pairwise matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Tracks:
    """Observations of ground points: `view[k]` sees point `point[k]` at `pixel[k]` (col, row).

    Points are numbered from 0 without gaps, observations are sorted by point and then by view.
    """

    point: Index  # [n]
    view: Index  # [n]
    pixel: Array  # [n, 2]

    @property
    def n_points(self) -> int:
        """Number of ground points."""
        return int(self.point[-1]) + 1 if self.point.size else 0

    def sizes(self) -> Index:
        """Number of views of each point."""
        return np.bincount(self.point, minlength=self.n_points)

    def kept(self, observation: NDArray[np.bool_]) -> tuple[Tracks, Index]:
        """Only the chosen observations, and of them only points that two views or more have.

        Returns (tracks, old number of each point).
        """
        left = np.bincount(self.point[observation], minlength=self.n_points)
        stay = observation & (left[self.point] >= 2)
        old, point = np.unique(self.point[stay], return_inverse=True)
        return Tracks(point.astype(np.intp), self.view[stay], self.pixel[stay]), old.astype(np.intp)


def build_tracks(pixels: Sequence[Array], matches: Sequence[tuple[int, int, Index, NDArray[np.float32]]]) -> Tracks:
    """Join matches (view a, view b, `[m, 2]` feature numbers, distances) into tracks by union-find.

    Best matches are joined first; a join that would put two features of one view into a track is refused.

    Args:
        pixels: ``[n, 2]`` places of the features of each view [px].
        matches: see above.
    """
    offsets = np.concatenate([[0], np.cumsum([len(p) for p in pixels])]).astype(np.intp)
    owner = np.repeat(np.arange(len(pixels)), [len(p) for p in pixels])
    pieces = [(offsets[a] + m[:, 0], offsets[b] + m[:, 1], s) for a, b, m, s in matches if len(m)]
    if not pieces:
        empty = np.empty(0, np.intp)
        return Tracks(empty, empty, np.empty((0, 2)))
    left, right, score = (np.concatenate(part) for part in zip(*pieces, strict=True))
    order = np.lexsort((right, left, score))

    parent = list(range(int(offsets[-1])))
    members: dict[int, set[int]] = {}

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for i, j in zip(left[order].tolist(), right[order].tolist(), strict=True):
        ri, rj = root(i), root(j)
        if ri == rj:
            continue
        vi = members.get(ri) or {int(owner[i])}
        vj = members.get(rj) or {int(owner[j])}
        if vi & vj:
            continue
        low, high = min(ri, rj), max(ri, rj)
        parent[high] = low
        members[low] = vi | vj
        members.pop(high, None)

    used = np.unique(np.concatenate([left, right]))
    label = np.array([root(i) for i in used.tolist()])
    _, label = np.unique(label, return_inverse=True)
    view = owner[used]
    all_pixels = np.concatenate(list(pixels))
    order = np.lexsort((view, label))
    tracks = Tracks(label[order].astype(np.intp), view[order].astype(np.intp), all_pixels[used[order]])
    return tracks.kept(np.ones(len(used), bool))[0]


__all__ = ["Tracks", "build_tracks"]

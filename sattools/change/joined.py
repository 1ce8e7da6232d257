"""Connected cells that are found strip by strip, put together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Sums:
    """Change of some cells.

    Attributes:
        area_m2: their area.
        mean_m, std_m: mean change, and the standard deviation of that mean.
        volume_m3, volume_std_m3: sum of the change over the area.
    """

    area_m2: float
    mean_m: float
    std_m: float
    volume_m3: float
    volume_std_m3: float


def sums_of(count: int, total: float, square: float, cell_area: float, correlation: float) -> Sums:
    """Area, mean change and volume of so many cells.

    Args:
        count: of the cells.
        total: sum of their changes [m].
        square: sum of their variances [m2].
        cell_area: of a cell, on the ground [m2].
        correlation: distance over which errors go together [m].
    """
    if not count:
        return Sums(0.0, math.nan, math.nan, 0.0, 0.0)
    area = count * cell_area
    independent = max(1.0, area / max(correlation**2, cell_area))
    mean, std = total / count, math.sqrt(square / count / independent)
    return Sums(area, mean, std, mean * area, std * area)


class Joined:
    """Parts of regions, numbered from 1 as they are found, and which of them belong together."""

    def __init__(self) -> None:
        self._parent = [0]
        self._sums = np.zeros((1, 3))  # cells, changes [m], variances [m2]
        self._boxes = [(0, 0, 0, 0)]
        self._names: dict[int, int] = {}

    @property
    def count(self) -> int:
        """Number of parts."""
        return len(self._parent) - 1

    def add(self, numbered: np.ndarray, count: int, difference: np.ndarray, sigma: np.ndarray) -> None:
        """Count some rows with so many new parts.

        Args:
            numbered: ``[h, W]`` numbers of the parts; 0 = none.
            count: of them.
            difference: ``[h, W]`` changes [m].
            sigma: ``[h, W]`` their standard deviations [m].
        """
        before = self.count
        self._parent += range(before + 1, before + count + 1)
        self._boxes += [(0, 0, 0, 0)] * count
        inside = numbered > 0
        own = numbered[inside] - before - 1
        values = np.ones(len(own)), difference[inside].astype(np.float64), sigma[inside].astype(np.float64) ** 2
        sums = [np.bincount(own, weights=weights, minlength=count) for weights in values]
        self._sums = np.concatenate([self._sums, np.stack(sums, axis=1)])

    def stretch(self, number: int, first_row: int, box: tuple[slice, slice]) -> None:
        """Say where a part lies.

        Args:
            number: of the part.
            first_row: of the whole, from which rows are counted.
            box: rows and columns.
        """
        rows, cols = box
        self._boxes[number] = (first_row + rows.start, first_row + rows.stop, cols.start, cols.stop)

    def join(self, above: np.ndarray, below: np.ndarray) -> None:
        """Put parts together that touch, at corners too, across two neighbouring rows of numbers ``[W]``."""
        for shift in (-1, 0, 1):
            moved = np.roll(above, shift)
            if shift:
                moved[0 if shift > 0 else -1] = 0
            touching = (moved > 0) & (below > 0)
            for one, other in set(zip(moved[touching].tolist(), below[touching].tolist(), strict=True)):
                self._unite(one, other)

    def _unite(self, one: int, other: int) -> None:
        first, second = sorted((self._root(one), self._root(other)))
        if first == second:
            return
        self._parent[second] = first
        self._sums[first] += self._sums[second]
        pair = self._boxes[first], self._boxes[second]
        self._boxes[first] = (
            min(box[0] for box in pair), max(box[1] for box in pair),
            min(box[2] for box in pair), max(box[3] for box in pair),
        )  # fmt: skip

    def _root(self, number: int) -> int:
        while self._parent[number] != number:
            self._parent[number] = self._parent[self._parent[number]]
            number = self._parent[number]
        return number

    def regions(self) -> list[int]:
        """Numbers of the regions: of each the first of its parts."""
        return [number for number in range(1, self.count + 1) if self._parent[number] == number]

    def roots(self) -> np.ndarray:
        """The region's number ``[N + 1]`` of every part; 0 of 0."""
        return np.array([self._root(number) for number in range(self.count + 1)], np.int32)

    def sums(self, number: int, cell_area: float, correlation: float) -> Sums:
        """Area, mean change and volume of a region.

        Args:
            number: of the region.
            cell_area: of a cell, on the ground [m2].
            correlation: distance over which errors go together [m].
        """
        cells, total, square = self._sums[number].tolist()
        return sums_of(round(cells), total, square, cell_area, correlation)

    def box(self, number: int) -> tuple[int, int, int, int]:
        """Rows and columns (first, last + 1 each) that a region lies in."""
        return self._boxes[number]

    def name(self, number: int, label: int) -> None:
        """Give a region its label."""
        self._names[number] = label

    def names(self) -> np.ndarray:
        """Label ``[N + 1]`` of every part; 0 of those without."""
        return np.array([self._names.get(root, 0) for root in self.roots().tolist()], np.int32)


__all__ = ["Joined", "Sums", "sums_of"]

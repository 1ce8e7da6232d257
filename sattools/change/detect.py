"""Regions of changed height between two surfaces, with volumes and significance: pure functions on arrays."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from sattools.change.options import ChangeOptions

LEAST_SIGMA_M = 0.05
GAP_M2 = 50.0  # gaps between walls in which matching fails are not larger


@dataclass(frozen=True)
class HeightChange:
    """What two surfaces say together.

    Attributes:
        difference: ``[H, W]`` later minus earlier [m]; NaN = unknown.
        sigma: ``[H, W]`` its standard deviation [m].
        cell_size: edge of a cell [m].
        correlation: distance over which errors go together [m].
        confidence: ``[H, W]`` of the less sure date's matching, 0 to 1; None = unknown.
    """

    difference: np.ndarray
    sigma: np.ndarray
    cell_size: float
    correlation: float
    confidence: np.ndarray | None = None

    @property
    def area_m2(self) -> float:
        """Area where both surfaces are known."""
        return float(np.isfinite(self.difference).sum()) * self.cell_size**2


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


@dataclass(frozen=True, kw_only=True)
class Region(Sums):
    """A connected region whose height has changed.

    Attributes:
        label: its number in the map of regions.
        p_value: probability of such a region somewhere in the area if nothing has changed.
    """

    label: int
    p_value: float


def cell_sigma(difference: np.ndarray, std: np.ndarray | None) -> np.ndarray:
    """Standard deviation of the height difference of every cell.

    The scatter of all cells about their median (most of an area has not changed), and where the surfaces state their
    own uncertainty, that as well.

    Args:
        difference: ``[H, W]`` later minus earlier [m]; NaN = unknown.
        std: ``[H, W]`` of both surfaces together [m], NaN = unknown; or None.

    Returns:
        ``[H, W]`` [m].
    """
    known = difference[np.isfinite(difference)]
    scatter = 1.4826 * float(np.median(np.abs(known - np.median(known)))) if known.size else math.nan
    scatter = max(scatter, LEAST_SIGMA_M)
    own = np.zeros_like(difference) if std is None else np.nan_to_num(std)
    return np.hypot(own, scatter)


def find_regions(heights: HeightChange, options: ChangeOptions) -> tuple[np.ndarray, list[Region]]:
    """Regions that have risen or sunk, largest volume first.

    A cell counts where its change is larger than ``min_height`` and twice its standard deviation. What is narrower than
    two rims is dropped, as a wall that two surfaces place a cell apart is no change. Of a region's cells only one per
    square of the correlation length is independent, and as many places for a region as fit into the area are looked
    at (Bonferroni). That is about noise; where matching failed altogether, in narrow shaded gaps above all, the
    surface's own deviation knows nothing of it, but its confidence does.

    Args:
        heights: the change.
        options: see `ChangeOptions`.

    Returns:
        ``[H, W]`` int32 labels, 0 = no region, and the regions.
    """
    from scipy.ndimage import binary_opening, label

    change = np.nan_to_num(heights.difference)
    labels = np.zeros(change.shape, np.int32)
    regions: list[Region] = []
    for sign in (1, -1):
        cells = (sign * change > options.min_height) & (sign * change > 2 * heights.sigma)
        opened = binary_opening(cells, _disk(options.rim / heights.cell_size))
        numbered, count = label(opened, np.ones((3, 3), bool))
        for number in range(1, count + 1):
            where = numbered == number
            region = region_of(where, heights, options, len(regions) + 1)
            if region is not None:
                labels[where] = region.label
                regions.append(region)
    return labels, sorted(regions, key=lambda r: -abs(r.volume_m3))


def region_of(where: np.ndarray, heights: HeightChange, options: ChangeOptions, label: int) -> Region | None:
    """The region of some cells, or None where it is too small, not significant or not sure.

    Args:
        where: ``[H, W]`` bool.
        heights: the change.
        options: see `ChangeOptions`.
        label: its number.
    """
    found = sums(where, heights)
    if found.area_m2 < options.min_area or abs(found.mean_m) < options.min_height:
        return None
    if heights.confidence is not None:
        sure = float(np.median(np.nan_to_num(heights.confidence[where])))
        # places where matching failed are small: the larger a region is, the less its confidence has to say
        if sure < options.min_confidence * min(1.0, GAP_M2 / found.area_m2):
            return None
    places = max(1.0, heights.area_m2 / found.area_m2)
    p_value = min(1.0, math.erfc(abs(found.mean_m) / found.std_m / math.sqrt(2)) * places)
    return None if p_value > 1 - options.confidence else Region(label=label, p_value=p_value, **asdict(found))


def sums(where: np.ndarray, heights: HeightChange) -> Sums:
    """Area, mean change and volume of some cells.

    Args:
        where: ``[H, W]`` bool; cells without a height do not count.
        heights: the change.
    """
    where = where & np.isfinite(heights.difference)
    count = int(where.sum())
    if not count:
        return Sums(0.0, math.nan, math.nan, 0.0, 0.0)
    area = count * heights.cell_size**2
    independent = max(1.0, area / max(heights.correlation, heights.cell_size) ** 2)
    mean = float(heights.difference[where].mean(dtype=np.float64))
    std = float(np.sqrt((heights.sigma[where].astype(np.float64) ** 2).mean() / independent))
    return Sums(area, mean, std, mean * area, std * area)


def _disk(radius: float) -> np.ndarray:
    reach = max(0, math.floor(radius))
    rows, cols = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(np.hypot(rows, cols) <= max(radius, 0.5))


__all__ = ["HeightChange", "Region", "Sums", "cell_sigma", "find_regions", "region_of", "sums"]

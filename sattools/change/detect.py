"""Regions of changed height between two surfaces, with volumes and significance.

Functions of maps that are read by rows (`sattools.scene.stored`), arrays among them; no I/O.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np

from sattools.change.joined import Joined, Sums, sums_of
from sattools.change.options import ChangeOptions
from sattools.compare.tally import ROUNDS, Median, Tally
from sattools.scene.stored import map_like, pieces

LEAST_SIGMA_M = 0.05
GAP_M2 = 50.0  # gaps between walls in which matching fails are not larger


@dataclass(frozen=True)
class HeightChange:
    """What two surfaces say together.

    Attributes:
        difference: ``[H, W]`` later minus earlier [m]; NaN = unknown.
        sigma: ``[H, W]`` its standard deviation [m].
        cell_size: edge of a cell on the map [m]. Widths of regions are measured by it: whole cells that a map's scale
            makes a little larger or smaller are to count alike.
        correlation: distance over which errors go together [m].
        confidence: ``[H, W]`` of the less sure date's matching, 0 to 1; None = unknown.
        ground_area: square metres on the ground of one of the map (`sattools.camera.ground.ground_area`).
    """

    difference: np.ndarray
    sigma: np.ndarray
    cell_size: float
    correlation: float
    confidence: np.ndarray | None = None
    ground_area: float = 1.0

    @property
    def cell_area(self) -> float:
        """Area of a cell on the ground [m2]."""
        return self.cell_size**2 * self.ground_area

    @property
    def area_m2(self) -> float:
        """Area where both surfaces are known."""
        known = sum(int(np.isfinite(self.difference[rows]).sum()) for rows in pieces(self.shape))
        return float(known) * self.cell_area

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.difference.shape[0], self.difference.shape[1]


@dataclass(frozen=True, kw_only=True)
class Region(Sums):
    """A connected region whose height has changed.

    Attributes:
        label: its number in the map of regions.
        p_value: probability of such a region somewhere in the area if nothing has changed.
        box: rows and columns (first, last + 1) that it lies in.
    """

    label: int
    p_value: float
    box: tuple[int, int, int, int] = (0, 0, 0, 0)


def cell_sigma(difference: np.ndarray, std: np.ndarray | None, noise: float | None = None) -> np.ndarray:
    """Standard deviation of the height difference of every cell.

    The scatter of all cells about their median (most of an area has not changed), and where the surfaces state their
    own uncertainty, that as well.

    Args:
        difference: ``[H, W]`` later minus earlier [m]; NaN = unknown.
        std: ``[H, W]`` of both surfaces together [m], NaN = unknown; or None.
        noise: in place of the scatter [m]; None = that.

    Returns:
        ``[H, W]`` [m].
    """
    shape = (difference.shape[0], difference.shape[1])
    scatter = max(scatter_of(difference) if noise is None else noise, LEAST_SIGMA_M)
    sigma = map_like(difference, shape, np.float32)
    for rows in pieces(shape):
        own = np.zeros_like(difference[rows]) if std is None else np.nan_to_num(std[rows])
        sigma[rows] = np.hypot(own, scatter)
    return sigma


def scatter_of(difference: np.ndarray) -> float:
    """1.4826 times the median absolute deviation from the median of what is known of a map [m]; NaN of nothing.

    Args:
        difference: ``[H, W]`` [m]; NaN = unknown.
    """
    tally = Tally()
    for round_ in range(ROUNDS):
        for rows in pieces((difference.shape[0], difference.shape[1])):
            part = np.asarray(difference[rows], np.float32)
            tally.add(round_, part[np.isfinite(part)])
    found = tally.figures()["nmad"]
    return math.nan if found is None else float(found)


def nearby_scatter(difference: np.ndarray, cells: int) -> float:
    """Standard deviation of what is known of a map, by its differences between cells side by side [m]; NaN of nothing.

    Wide changes are none of it, however much of the area they are: their edges are few.

    Args:
        difference: ``[H, W]`` [m]; NaN = unknown.
        cells: how far apart they are, eastwards.
    """
    median = Median()
    for show in (median.first, median.again):
        for rows in pieces((difference.shape[0], difference.shape[1])):
            part = np.asarray(difference[rows], np.float32)
            apart = np.abs(part[:, cells:] - part[:, :-cells])
            show(apart[np.isfinite(apart)])
    return 1.4826 / math.sqrt(2) * median.value()


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
    labels = map_like(heights.difference, heights.shape, np.int32)
    found = Joined()
    for sign in (1, -1):
        _label(heights, options, sign, labels, found)
    known = heights.area_m2
    regions: list[Region] = []
    sure = _confidence(heights, options, labels, found)
    for number in found.regions():
        region = _region(
            found.sums(number, heights.cell_area, heights.correlation),
            options,
            (len(regions) + 1, sure.get(number), known),
        )
        if region is not None:
            regions.append(replace(region, box=found.box(number)))
            found.name(number, region.label)
    names = found.names()
    for rows in pieces(heights.shape):
        labels[rows] = names[labels[rows]]
    return labels, sorted(regions, key=lambda r: -abs(r.volume_m3))


def _label(heights: HeightChange, options: ChangeOptions, sign: int, labels: np.ndarray, found: Joined) -> None:
    """Number the connected cells that have risen (1) or sunk (-1), strip by strip."""
    from scipy.ndimage import find_objects, label

    radius = options.rim / heights.cell_size
    halo = 3 * math.floor(radius) + 2  # what an opening looks at is no wider
    above = np.zeros(heights.shape[1], np.int32)
    for rows in pieces(heights.shape):
        first, last = max(0, rows.start - halo), min(heights.shape[0], rows.stop + halo)
        own = slice(rows.start - first, rows.stop - first)
        change = sign * np.nan_to_num(heights.difference[first:last])
        cells = (change > options.min_height) & (change > 2 * heights.sigma[first:last])
        opened = _with_corners(opening(cells, radius), cells, radius)[own]
        numbered, count = label(opened, np.ones((3, 3), bool))
        numbered = np.where(opened, numbered + found.count, 0).astype(np.int32)
        difference, sigma = heights.difference[rows], heights.sigma[rows]
        found.add(numbered, count, difference, sigma)
        for number, box in enumerate(find_objects(numbered - np.where(opened, found.count - count, 0)), start=1):
            if box is not None:
                found.stretch(found.count - count + number, rows.start, box)
        found.join(above, numbered[0])
        above = numbered[-1]
        labels[rows] = np.where(opened, numbered, labels[rows])


def _confidence(heights: HeightChange, options: ChangeOptions, labels: np.ndarray, found: Joined) -> dict[int, float]:
    """Median confidence of every region that is large and changed enough, by its number; empty if it is not known."""
    if heights.confidence is None:
        return {}
    wanted = {
        n for n in found.regions() if _large_enough(found.sums(n, heights.cell_area, heights.correlation), options)
    }
    root = found.roots()
    values: dict[int, list[np.ndarray]] = {number: [] for number in wanted}
    for rows in pieces(heights.shape):
        numbers, known = root[labels[rows]], np.nan_to_num(heights.confidence[rows])
        for number in wanted & set(np.unique(numbers).tolist()):
            values[number].append(known[numbers == number])
    return {number: float(np.median(np.concatenate(parts))) for number, parts in values.items()}


def _large_enough(found: Sums, options: ChangeOptions) -> bool:
    return found.area_m2 >= options.min_area and abs(found.mean_m) >= options.min_height


def _region(found: Sums, options: ChangeOptions, about: tuple[int, float | None, float]) -> Region | None:
    """The region of some cells, or None where it is too small, not significant or not sure.

    ``about``: its label, its median confidence, the area where both surfaces are known [m2].
    """
    label, sure, known = about
    if not _large_enough(found, options):
        return None
    # places where matching failed are small: the larger a region is, the less its confidence has to say
    if sure is not None and sure < options.min_confidence * min(1.0, GAP_M2 / found.area_m2):
        return None
    places = max(1.0, known / found.area_m2)
    p_value = min(1.0, math.erfc(abs(found.mean_m) / found.std_m / math.sqrt(2)) * places)
    return None if p_value > 1 - options.confidence else Region(label=label, p_value=p_value, **asdict(found))


def sums(where: np.ndarray, heights: HeightChange, part: tuple[slice, slice] = (slice(None), slice(None))) -> Sums:
    """Area, mean change and volume of some cells.

    Args:
        where: ``[h, w]`` bool; cells without a height do not count.
        heights: the change.
        part: rows and columns that ``where`` is about.
    """
    difference = heights.difference[part[0], part[1]]
    where = where & np.isfinite(difference)
    square = heights.sigma[part[0], part[1]][where].astype(np.float64) ** 2
    return sums_of(
        int(where.sum()),
        float(difference[where].sum(dtype=np.float64)),
        float(square.sum()),
        heights.cell_area,
        heights.correlation,
    )


def opening(cells: np.ndarray, radius: float) -> np.ndarray:
    """Cells ``[H, W]`` bool that disks of a radius [cells] cover which lie within the given ones.

    By distances, which take the same time and memory for every radius; those of half a cell or less are cells.
    """
    from scipy.ndimage import distance_transform_edt

    if radius < 1 or not cells.any():
        return cells
    # beyond the border there is nothing
    kept = distance_transform_edt(np.pad(cells, 1))[1:-1, 1:-1] > radius
    if not kept.any():
        return kept
    return np.asarray(distance_transform_edt(~kept) <= radius)


def _with_corners(opened: np.ndarray, cells: np.ndarray, radius: float) -> np.ndarray:
    """What an opening has left, and the right angles into which its disk does not reach.

    Args:
        opened: ``[H, W]`` bool, see `opening`.
        cells: ``[H, W]`` bool of which it is.
        radius: of the disk [cells].
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt

    if not opened.any():
        return opened
    # from a right angle to its disk, and half a diagonal of a cell
    reach = (math.sqrt(2) - 1) * radius + math.sqrt(0.5)
    near = cells & (distance_transform_edt(~opened) <= reach)
    # not across what has not changed, to a wall beside it
    return np.asarray(opened | binary_dilation(opened, np.ones((3, 3)), iterations=math.ceil(reach), mask=near))


__all__ = [
    "LEAST_SIGMA_M",
    "HeightChange",
    "Region",
    "Sums",
    "cell_sigma",
    "find_regions",
    "nearby_scatter",
    "opening",
    "scatter_of",
    "sums",
]

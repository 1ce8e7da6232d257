"""The range of heights in a scene, found from the images alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sattools.camera.ground import ground_sample_distance, metres_per_degree, to_geographic
from sattools.camera.planes import Array, Bounds, GroundPlanes, blurred
from sattools.camera.rpc import RPC
from sattools.errors import InputError
from sattools.processors import side_by_side
from sattools.progress import Progress, silent

PATCH = {7: 50, 12: 35}  # cells, by views that show a place: smaller patches agree by chance; between them a line
SMALL_PATCH = 10  # cells from which on a patch is looked at more closely, and how many of them are, at most
MOST_LOOKS = 6
CLOSER, FINER = 2.0, 0.8  # how many times as fine cells are then; no finer than pixels, and at least so much finer
SEEN_CLOSER = 50  # of these have to agree: by chance up to 22, of roofs 110 and more
AROUND = 6.0  # cells to all sides of it
PAIR_PATCH = 110.0  # of two images: by chance up to 100 (66 pairs)
PAIR_ROOFS_M = 20.0  # above what two images tell: neither tie points nor patches so large show most towers then
COHERENT = 0.2  # share of the cells, below which three images agree about too little to show every tower:
ROOFS_M = 40.0  # above the tie points, at least, are looked at then, whatever patches tell
NEIGHBOURS, CONFIRM = 8, 2  # tie points around one, and how many of them have to lie about as high
NEAR_M, STEEPEST = 2.0, 0.4  # what counts as about as high: so many metres, or so many of every metre to the neighbour
TAIL = 0.005  # share of tie points beyond either end that may be false
MARGIN, LEAST_MARGIN_M = 0.2, 6.0  # of the range between the ends, added at both
MAX_CELLS, MAX_PLANES = 40_000, 96  # of the coarse plane sweep
TOWERS_M = 150.0  # height above the tie points to which roofs are looked for, at least


def tie_point_range(heights: Array) -> tuple[float, float]:
    """Robust lowest and highest of tie point heights [m], without margin. Raises InputError without any."""
    heights = heights[np.isfinite(heights)]
    if heights.size == 0:
        raise InputError("height range: found no tie points, expected images that overlap")
    low, high = np.quantile(heights, [TAIL, 1.0 - TAIL])
    return float(low), float(high)


def in_company(points: Array) -> NDArray[np.bool_]:
    """Which tie points ``[n]`` have neighbours that lie about as high.

    Two views cannot contradict a false match along the line of sight, which lies at any height of those searched. Its
    neighbours lie somewhere else; those of a true one stand on the same ground or roof.

    Args:
        points: ``[n, 3]`` longitude, latitude [degrees] and height [m].
    """
    from scipy.spatial import cKDTree

    if len(points) <= CONFIRM:
        return np.zeros(len(points), bool)
    lon, lat, heights = points.T
    east, north = metres_per_degree(float(np.median(lat)))
    places = np.stack([((lon - lon[0] + 180) % 360 - 180) * east, lat * north], axis=1)
    apart, near = (found[:, 1:] for found in cKDTree(places).query(places, min(NEIGHBOURS + 1, len(places))))
    alike = np.abs(heights[near] - heights[:, None]) < np.maximum(NEAR_M, STEEPEST * apart)
    return np.asarray(alike.sum(axis=1) >= CONFIRM)


def estimate_height_range(
    heights: Array,
    grays: Sequence[NDArray[np.float32]],
    rpcs: Sequence[RPC],
    crs: str,
    bounds: Bounds,
    *,
    progress: Progress = silent,
) -> tuple[float, float]:
    """Heights (lowest, highest, m above the ellipsoid) between which the surface lies, without any ground truth.

    Tie points give the bulk. They seldom lie on the few highest roofs, so a coarse plane sweep (correlation of all
    views on the ground, height by height) over twice the range above, or as high as towers stand, and half below looks
    for patches beyond it that agree about their height. Small ones, which may be chance or the top of a stepped tower,
    are looked at on finer cells.

    Args:
        heights: of tie points `[n]` [m].
        grays: images `[H, W]`, NaN = no data. rpcs: their corrected cameras.
        bounds: (west, south, east, north) in `crs` [m].
        rpcs: corrected cameras.
        crs: projected ground CRS [m].
        progress: told the share done and what is being done.
    """
    low, high = tie_point_range(heights)
    span = max(high - low, 2.0 * LEAST_MARGIN_M)
    search = (low - 0.5 * span, high + max(2.0 * span, TOWERS_M))
    planes = np.linspace(*search, min(MAX_PLANES, max(24, int((search[1] - search[0]) / 2.0))))
    swept = sweep_patches(grays, rpcs, crs, bounds, planes, progress=progress)
    least = PAIR_PATCH if len(rpcs) == 2 else least_patch(swept.views)
    low, top = extend_range(low, high, planes, swept.patches, least)
    if len(rpcs) > 2:  # two images agree by chance about patches of any size
        top = small_roofs(top, swept, least, grays, rpcs, crs)
    margin = max(MARGIN * (top - low), LEAST_MARGIN_M)
    return low - margin, top + margin + unseen_roofs(len(rpcs), top - high, swept.coherent)


def unseen_roofs(images: int, found: float, coherent: float) -> float:
    """Metres above what the images tell in which roofs may stand that few of them do not show.

    Three images of towers, and those of hills, agree about 1 to 16 % of the ground; where they agree about more
    (friendly cities, JAX_068 and city_214 in three images: 25 to 35 %), the sweep has found what stands there.

    Args:
        images: how many.
        found: metres above the tie points that the sweep has found roofs in.
        coherent: see `Swept`.
    """
    if images == 2:
        return PAIR_ROOFS_M
    return max(0.0, ROOFS_M - found) if images == 3 and coherent < COHERENT else 0.0


def least_patch(views: float) -> float:
    """Cells that a patch needs to be no chance, where so many views show a place.

    Windows of 5 x 5 cells make patches of chance, of up to 47 cells with three views, 40 with seven and 28 with twelve
    (14 simulated downtowns and JAX_068); the roof of a tower may have 40.
    """
    return float(np.interp(views, list(PATCH), list(PATCH.values())))


def extend_range(low: float, high: float, planes: Array, patches: NDArray[Any], least: float) -> tuple[float, float]:
    """Widen [low, high] to the planes outside it on which a patch lies that is too large for chance.

    One roof that agrees counts, however few cells it has beside the whole area; cells that agree by chance are as many
    on every plane, but lie apart from each other.

    Args:
        low: lowest height so far [m].
        high: highest height so far [m].
        planes: ``[D]`` heights [m].
        patches: ``[D]`` cells of the largest patch on each.
        least: cells from which on a patch counts.
    """
    outside = (planes < low) | (planes > high)
    supported = planes[outside & (patches >= least)]
    if supported.size == 0:
        return low, high
    return min(low, float(supported.min())), max(high, float(supported.max()))


def small_roofs(
    top: float,
    swept: Swept,
    least: float,
    grays: Sequence[NDArray[np.float32]],
    rpcs: Sequence[RPC],
    crs: str,
) -> float:
    """The highest plane on which images show a roof, of those whose patch alone tells nothing; else `top`.

    On finer cells a roof has more of them, and what agrees by chance does no longer.

    Args:
        top: highest plane so far [m].
        swept: what the images showed on every plane.
        least: cells from which on a patch counts, see `extend_range`.
        grays: grey images ``[H, W]``; NaN = no data.
        rpcs: their cameras.
        crs: projected ground CRS [m].
    """
    planes = swept.planes
    small = np.flatnonzero((planes > top) & (swept.patches >= SMALL_PATCH) & (swept.patches < least))
    largest = small[np.argsort(-swept.patches[small], kind="stable")][:MOST_LOOKS]
    for k in sorted(largest, reverse=True):
        x, y, half = swept.places[k]
        lon, lat = (float(v[0]) for v in to_geographic(crs, np.array([x]), np.array([y])))
        pixel = float(np.median([ground_sample_distance(rpc, lon, lat, float(planes[k])) for rpc in rpcs]))
        cell = max(swept.cell / CLOSER, pixel)
        if cell > FINER * swept.cell:
            continue
        half += AROUND * swept.cell
        closer = sweep_patches(
            grays, rpcs, crs, (x - half, y - half, x + half, y + half), planes, int((2 * half / cell) ** 2)
        )
        if closer.patches[max(0, k - 2) : k + 3].max() >= SEEN_CLOSER:
            return float(planes[k])
    return top


class Swept(NamedTuple):
    """What a plane sweep has seen.

    Attributes:
        patches: ``[D]`` ground cells of the largest patch whose best correlation lies on each plane or beside it.
        views: that show a place there, the median of all places.
        coherent: share of the places about whose height images agree, as their neighbours do.
        places: ``[D, 3]`` easting and northing of the middle of these patches, and half their width [m]; NaN = none.
        cell: edge of a cell [m].
        planes: ``[D]`` their heights [m].
    """

    patches: NDArray[np.int64]
    views: float
    coherent: float
    places: Array
    cell: float
    planes: Array


def sweep_patches(
    grays: Sequence[NDArray[np.float32]],
    rpcs: Sequence[RPC],
    crs: str,
    bounds: Bounds,
    planes: Array,
    max_cells: int = MAX_CELLS,
    *,
    progress: Progress = silent,
) -> Swept:
    """Ask every plane where on it the images agree.

    The score of a cell at a height is the mean zero-mean normalised correlation of all pairs of views in a window of
    5 x 5 cells, which costs one pass over the views: (|sum z|^2 - sum |z|^2) / (n (n - 1)).

    Args:
        grays: grey images ``[H, W]``; NaN = no data.
        rpcs: their cameras.
        crs: projected ground CRS [m].
        bounds: (west, south, east, north) [m].
        planes: ``[D]`` heights [m].
        max_cells: number of ground cells, at most.
        progress: told the share done and what is being done.
    """
    import cv2

    west, south, east, north = bounds
    cell = float(np.sqrt((east - west) * (north - south) / max_cells))
    ground = GroundPlanes.of(rpcs, crs, bounds, cell, planes)
    height, width = ground.shape
    smoothed = [
        _standard(g, blurred(g, r, crs, bounds, float(planes[0]), cell)) for g, r in zip(grays, rpcs, strict=True)
    ]

    window = np.ones((5, 5), np.uint8)
    best, shown = np.full((height, width), -1.0), np.zeros((height, width))
    winner = np.full((height, width), -1, np.int32)

    def agreement(k: int) -> tuple[Array, Array]:
        total, own, views = (np.zeros((height, width)) for _ in range(3))
        for view, gray in enumerate(smoothed):
            value = ground.shown(gray, view, k)
            seen = np.isfinite(value)
            value[~seen] = 0.0
            mean = cv2.blur(value, (5, 5))
            variance = cv2.blur(value * value, (5, 5)) - mean * mean
            good = (cv2.erode(seen.view(np.uint8), window) > 0) & (variance > 1e-6)
            # Mean and deviation are those around each cell, not of the window they are summed over: nearly the same
            # where they vary slowly, and one filter for all views instead of one per pair.
            z_v = np.where(good, (value - mean) / np.sqrt(np.maximum(variance, 1e-6)), 0.0)
            views += good
            total += z_v
            own += z_v * z_v
        pairs = cv2.blur(total * total, (5, 5)) - cv2.blur(own, (5, 5))
        return np.where(views >= 2, pairs / np.maximum(views * (views - 1), 1), -1.0), views

    for k, (score, views) in enumerate(side_by_side(agreement, range(len(planes)))):
        progress(k / len(planes), "height range")
        better = score > best
        best[better], winner[better], shown[better] = score[better], k, views[better]
    seen = shown[winner >= 0]
    views_there = float(np.median(seen)) if seen.size else 0.0
    good = _agreeing(winner, best, len(planes), by_chance(shown))
    patches, inside = _largest_patches(winner, good, len(planes))
    places = np.array([west, north, 0.0]) + cell * inside * [1, -1, 1]
    return Swept(patches, views_there, float(good.sum() / max(seen.size, 1)), places, cell, planes)


def by_chance(views: Array) -> Array:
    """Mean correlation that unrelated views reach by chance on the best of all planes.

    A correlation over 25 cells scatters by 1/5, its mean over the pairs by less; the best of all planes reaches some
    three deviations. On planes far off fewer views show a place than all.

    Args:
        views: number of views that show each place.
    """
    pairs = np.maximum(views * (views - 1) / 2, 1.0)
    return np.maximum(0.2, 0.2 * 3.5 / np.sqrt(pairs))


def _agreeing(winner: NDArray[np.int32], score: Array, n: int, least: Array) -> NDArray[np.bool_]:
    """Cells with a score over `least` that agree with their neighbours: 6 of 8 have their winner within two planes."""
    padded = np.pad(winner, 1, constant_values=-100)
    height, width = winner.shape
    agree = np.zeros(winner.shape, int)
    for dr in (0, 1, 2):
        for dc in (0, 1, 2):
            if (dr, dc) != (1, 1):
                agree += np.abs(padded[dr : dr + height, dc : dc + width] - winner) <= 2
    # A winner at either end of the search may have its true maximum outside.
    return np.asarray((agree >= 6) & (score > least) & (winner > 0) & (winner < n - 1))


def _largest_patches(winner: NDArray[np.int32], good: NDArray[np.bool_], n: int) -> tuple[NDArray[np.int64], Array]:
    """Cells of the largest patch per plane, of those that are `good`, and where it lies (column, row, half its width).

    It lies within one of its plane, and not mostly on one of the next: a roof would lie on three.
    """
    import cv2

    patches, places = np.zeros(n, np.int64), np.full((n, 3), np.nan)
    for k in range(n):
        near = good & (np.abs(winner - k) <= 1)
        _, label = cv2.connectedComponents(near.view(np.uint8), connectivity=4)
        cells, above = np.bincount(label[near]), np.bincount(label[near], winner[near] - k)
        cells[2 * np.abs(above) > cells] = 0
        patches[k] = cells.max(initial=0)
        if patches[k]:
            rows, cols = np.nonzero(label == int(np.argmax(cells)))
            places[k] = cols.mean() + 0.5, rows.mean() + 0.5, (max(np.ptp(cols), np.ptp(rows)) + 1) / 2
    return patches, places


def _standard(gray: NDArray[np.float32], smooth: NDArray[np.float32]) -> NDArray[np.float32]:
    """A smoothed image scaled to unit spread of the image."""
    known = gray[np.isfinite(gray)]
    mean, spread = (float(known.mean()), float(np.std(known))) if known.size else (0.0, 1.0)
    return np.asarray((smooth - np.float32(mean)) / np.float32(max(spread, 1e-6)))


__all__ = [
    "Swept",
    "by_chance",
    "estimate_height_range",
    "extend_range",
    "in_company",
    "least_patch",
    "small_roofs",
    "sweep_patches",
    "tie_point_range",
    "unseen_roofs",
]

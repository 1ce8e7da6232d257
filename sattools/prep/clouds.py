"""Clouds: large places in an image that are brighter than what the others show there, at whatever height they look.

Two things tell a cloud from bright ground: it is not there on another date, and no height makes it what the others
show. Tie points, which lie on the ground, say how bright the ground is in one image where it is so in another; a coarse
look at the ground on horizontal planes then finds, for every place of an image, the height at which it differs least
from the darker ones of the images that show it. What is large, and brighter than nearly all of the ground by as much as
that is brighter than usual ground, is a cloud (or glare on water, which is as useless). Of two images the brighter is
taken to be clouded: what differs so much at all heights cannot be matched, whatever it is. Thin clouds and shadows of
clouds show the ground, which matching copes with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sattools.camera.planes import Bounds, GroundPlanes, blurred
from sattools.camera.rpc import RPC
from sattools.camera.tracks import Tracks

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Gray = NDArray[np.float32]
ODD_ONE = 3  # images that show a place, of which one may be odd; of two the brighter is
_CANDIDATES = 200  # pairs of tie points that lines are drawn through
# what counts as a cloud; brightness in units of what the brightest tenth of the ground has above usual ground
BRIGHTER = 1.0  # than the others, and than usual ground
EDGE = 0.4  # the same at the edge of a cloud
WIDTH_M = 12.0  # it is nowhere narrower
AREA_M2 = 1500.0  # of one, or a quarter of the area: a roof that shines in one image is smaller
ANOTHER_M2 = 300.0  # of the others beside it
PATCH_M = 6.0  # heights are tried with what lies around: single pixels find their like at one of many
MARGIN_M = 5.0  # around it: it thins out
CELL_M, MAX_CELLS, MAX_PLANES = 2.0, 60_000, 48  # of the look at the ground
DARKER = 0.4  # share of the images at a place that are darker than what it is taken to be: clouds are bright
OBSERVATIONS = 20  # tie points of an image, below which nothing is known of it


@dataclass(frozen=True)
class Clouds:
    """Those of one image.

    Attributes:
        places: ``[h, w]`` bool, blocks of pixels that hold some.
        step: pixels along the edge of a block.
        share: of what the image shows of the area.
    """

    places: Mask
    step: int
    share: float


@dataclass(frozen=True)
class _Look:
    """What is found in the images at a common brightness.

    ``excess``: per image, coarse pixels ``[h, w]`` by which it is brighter than the others at the best height, inf
    where no other shows the place. ``bright``: the same pixels' own brightness. ``usual``, ``scale``: that
    of half of the ground, and by how much that of a tenth is above. ``step``: pixels along the edge of a coarse one,
    ``metres``: that edge on the ground.
    """

    excess: list[Gray]
    bright: list[Gray]
    usual: float
    scale: float
    step: list[int]
    metres: list[float]


def find_clouds(
    grays: Sequence[Gray],
    cameras: Sequence[RPC],
    tracks: Tracks,
    crs: str,
    bounds: Bounds,
    heights: tuple[float, float],
) -> list[Clouds | None]:
    """Where clouds hide the ground, image by image.

    Args:
        grays: images ``[H, W]``; NaN = no data.
        cameras: their corrected cameras.
        tracks: tie points in their pixels.
        crs: projected ground CRS [m].
        bounds: (west, south, east, north) of the area that matters [m].
        heights: lowest and highest of the surface [m].

    Returns:
        One an image; None = no cloud.
    """
    west, south, east, north = bounds
    area = (east - west) * (north - south)
    cell = max(CELL_M, float(np.sqrt(area / MAX_CELLS)))
    planes = min(MAX_PLANES, max(2, int(np.ceil((heights[1] - heights[0]) / (2.0 * cell)))))
    ground = GroundPlanes.of(cameras, crs, bounds, cell, np.linspace(*heights, planes))
    values = _values(grays, tracks)
    found: list[Clouds | None] = [None] * len(grays)
    for _ in range(2):  # tie points on clouds spoil what they say of the ground
        gain, offset = common_brightness(tracks, values, len(grays))
        # smoothed anew in each turn: beside what is made of them they would be all images once more
        images = [blurred(g, r, crs, bounds, heights[0], 2.0 * cell) for g, r in zip(grays, cameras, strict=True)]
        for image, times, level in zip(images, gain, offset, strict=True):
            image[:] = image * times + level
        look = _look(images, ground, cell)
        del images
        if look is None:
            break
        for view in np.flatnonzero(np.isfinite(gain)).tolist():  # of the others nothing is known but what was found
            found[view] = _clouds(look, view, min(AREA_M2, area / 4.0))
        for view, clouds in enumerate(found):
            if clouds is not None:
                _forget(values, tracks, view, clouds)
        if not any(found):
            break
    return found


def common_brightness(tracks: Tracks, values: Array, views: int) -> tuple[Array, Array]:
    """Gain and offset ``[V]`` that make images equally bright at the tie points which they share; NaN = unknown.

    Straight lines to the median of all images at every point, over and over; points that do not obey count less.

    Args:
        tracks: tie points.
        values: ``[n]`` what the images show at them; NaN = nothing.
        views: number of images.
    """
    gain, offset = np.full(views, np.nan), np.full(views, np.nan)
    of = [np.flatnonzero((tracks.view == view) & np.isfinite(values)) for view in range(views)]
    for view, known in enumerate(of):
        if known.size >= OBSERVATIONS:
            middle = np.median(values[known])
            spread = max(1.4826 * float(np.median(np.abs(values[known] - middle))), 1e-6)
            gain[view], offset[view] = 1.0 / spread, -middle / spread
    if not np.isfinite(gain).any():
        return gain, offset
    first = gain.copy()
    for turn in range(8):
        common = _median_of_points(tracks, values * gain[tracks.view] + offset[tracks.view])
        for view in np.flatnonzero(np.isfinite(gain)).tolist():
            x, y = values[of[view]], common[tracks.point[of[view]]]
            start = _line_of_most(x, y) if turn < 2 else (float(gain[view]), float(offset[view]))
            slope, level = _robust_line(x, y, *start)
            if slope > 0.2 * first[view]:
                gain[view], offset[view] = slope, level
        drift = float(np.nanmedian(gain / first))
        gain, offset = gain / drift, offset / drift
    return gain, offset


def _median_of_points(tracks: Tracks, values: Array) -> Array:
    """Median of the values ``[n]`` of each point; NaN where it has none."""
    order = np.lexsort((values, tracks.point))  # NaN last
    sizes = np.bincount(tracks.point[np.isfinite(values)], minlength=tracks.n_points)
    start = np.searchsorted(tracks.point[order], np.arange(tracks.n_points))
    ranked = values[order]
    last = ranked.size - 1
    low, high = (ranked[np.minimum(start + np.maximum(k, 0), last)] for k in ((sizes - 1) // 2, sizes // 2))
    return np.where(sizes > 0, 0.5 * (low + high), np.nan)


def _line_of_most(x: Array, y: Array) -> tuple[float, float]:
    """Slope and level of the rising line through two of the points that half of all points are nearest to.

    Points on clouds may be nearly as many as those on the ground, and all on one side.
    """
    a, b = np.random.default_rng(0).integers(0, x.size, (2, _CANDIDATES))
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = (y[b] - y[a]) / (x[b] - x[a])
    levels = y[a] - slopes * x[a]
    rising = np.isfinite(slopes) & (slopes > 0.0)
    if not rising.any():
        return 0.0, float(np.median(y))
    slopes, levels = slopes[rising], levels[rising]
    best = int(np.median(np.abs(y - slopes[:, None] * x - levels[:, None]), axis=1).argmin())
    return float(slopes[best]), float(levels[best])


def _robust_line(x: Array, y: Array, slope: float, level: float) -> tuple[float, float]:
    """Slope and level of y over x near a line by Cauchy's weights."""
    for _ in range(5):
        error = y - slope * x - level
        scale = 2.0 * 1.4826 * float(np.median(np.abs(error))) + 1e-9
        weight = 1.0 / (1.0 + (error / scale) ** 2)
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        slope = float((weight * (x - mean_x) * (y - mean_y)).sum() / max((weight * (x - mean_x) ** 2).sum(), 1e-12))
        level = float(mean_y - slope * mean_x)
    return slope, level


def _values(grays: Sequence[Gray], tracks: Tracks) -> Array:
    """What the images show at the tie points ``[n]``, somewhat smoothed; NaN = nothing."""
    import cv2

    found = np.full(tracks.view.size, np.nan)
    for view, gray in enumerate(grays):
        of = np.flatnonzero(tracks.view == view)
        col, row = np.rint(tracks.pixel[of]).astype(int).T
        inside = (col >= 0) & (row >= 0) & (col < gray.shape[1]) & (row < gray.shape[0])
        smooth = cv2.GaussianBlur(gray, (0, 0), 1.0)  # NaN beside what is not known
        found[of[inside]] = smooth[row[inside], col[inside]]
    return found


def _forget(values: Array, tracks: Tracks, view: int, clouds: Clouds) -> None:
    """Leave out what an image shows at tie points on its clouds."""
    of = np.flatnonzero(tracks.view == view)
    col, row = (np.clip(np.rint(tracks.pixel[of]).T, 0, None) // clouds.step).astype(int)
    rows, cols = clouds.places.shape
    values[of[clouds.places[np.minimum(row, rows - 1), np.minimum(col, cols - 1)]]] = np.nan


def _look(images: Sequence[Gray], ground: GroundPlanes, cell: float) -> _Look | None:
    """By how much images are brighter than the others, at the height where they differ least; None = nothing known."""
    import cv2

    edges = [_pixels_of_a_cell(ground, view) for view in range(len(images))]
    steps = [max(1, round(edge)) for edge in edges]
    shapes = [(max(1, s.shape[0] // f), max(1, s.shape[1] // f)) for s, f in zip(images, steps, strict=True)]
    excess = [np.full(shape, np.inf, np.float32) for shape in shapes]
    levels = []
    for k in range(len(ground.heights)):
        shown = np.stack([ground.shown(image, view, k) for view, image in enumerate(images)])
        count = np.isfinite(shown).sum(axis=0)
        # of three or more images two are darker, so that two are left wherever clouds are masked
        rank = np.where(count < ODD_ONE, 0, np.clip((DARKER * (count - 1)).astype(int), 1, len(images) - 1))
        others = np.take_along_axis(np.sort(shown, axis=0), rank[None], axis=0)[0]  # NaN last
        levels.append(others[count >= 2])
        difference = np.where(np.isfinite(shown) & (count >= 2), shown - others, np.float32(np.nan))
        difference = np.stack([_mean_around(d, PATCH_M / cell) for d in difference])
        for view, step in enumerate(steps):
            blocks = np.array([[step, 0, (step - 1) / 2], [0, step, (step - 1) / 2], [0, 0, 1.0]])
            to_cells = cv2.invertAffineTransform(ground.to_image(view, k)) @ blocks
            there = cv2.warpAffine(
                difference[view], to_cells, shapes[view][::-1],
                flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP, borderValue=np.inf,
            )  # fmt: skip
            excess[view] = np.where(np.abs(there) < np.abs(excess[view]), there, excess[view])
    level = levels[len(levels) // 2]
    if not level.size:
        return None
    usual, high = np.quantile(level, [0.5, 0.9])
    metres = [cell * step / edge for step, edge in zip(steps, edges, strict=True)]
    both = zip(images, shapes, strict=True)
    bright = [np.asarray(cv2.resize(s, shape[::-1], interpolation=cv2.INTER_AREA), np.float32) for s, shape in both]
    return _Look(excess, bright, float(usual), max(float(high - usual), 1e-6), steps, metres)


def _mean_around(difference: Gray, width: float) -> Gray:
    """Mean of what is known ``[h, w]`` within a square; inf where that is less than half of it."""
    import cv2

    size = (max(1, round(width)),) * 2
    known = np.isfinite(difference)
    share = cv2.blur(known.astype(np.float32), size)
    total = cv2.blur(np.where(known, difference, np.float32(0.0)), size)
    enough = known & (share >= 0.5)
    return np.where(enough, total / np.maximum(share, 0.5), np.float32(np.inf))


def _pixels_of_a_cell(ground: GroundPlanes, view: int) -> float:
    """Pixels of an image along the edge of a cell."""
    (a, b, _), (c, d, _) = ground.to_image(view, 0)
    edge = float(np.sqrt(abs(a * d - b * c)))
    return edge if np.isfinite(edge) and edge > 0.0 else 1.0


def _clouds(look: _Look, view: int, least_m2: float) -> Clouds | None:
    """What clouds cover of an image; None = no cloud."""
    import cv2

    pixel = look.metres[view]

    def disc(radius_m: float) -> NDArray[np.uint8]:
        size = 2 * max(1, round(radius_m / pixel)) + 1
        return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)

    def brighter(by: float) -> NDArray[np.uint8]:
        excess, bright = look.excess[view], look.bright[view]
        found = np.isfinite(excess) & (excess > by * look.scale) & (bright > look.usual + by * look.scale)
        return found.astype(np.uint8)

    cores = cv2.morphologyEx(brighter(BRIGHTER), cv2.MORPH_OPEN, disc(WIDTH_M / 2.0))
    _, label, figures, _ = cv2.connectedComponentsWithStats(cores, connectivity=4)
    areas = figures[:, cv2.CC_STAT_AREA] * pixel**2
    areas[0] = 0.0  # which is all the rest
    if areas.max() < least_m2:
        return None
    core = (areas >= min(ANOTHER_M2, least_m2))[label]
    wide = cv2.morphologyEx(brighter(EDGE), cv2.MORPH_OPEN, disc(pixel)) | core.astype(np.uint8)
    _, label = cv2.connectedComponents(wide, connectivity=4)
    wanted = np.isin(label, np.unique(label[core]))
    places = np.asarray(cv2.dilate(wanted.astype(np.uint8), disc(MARGIN_M)) > 0)
    return Clouds(places, look.step[view], float(places[np.isfinite(look.excess[view])].mean()))


__all__ = ["Clouds", "common_brightness", "find_clouds"]

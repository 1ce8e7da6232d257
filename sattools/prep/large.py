"""Whole satellite scenes: never an image in memory, but all of them coarsely, and windows of the ground sharply.

The coarse images, means of blocks of pixels, tell the cameras' errors to a few pixels and the range of heights. With
these, squares of the ground that are spread over what the images have in common are small windows in every image, and
their tie points are as good as those of a crop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon, box

from sattools.camera import RPC
from sattools.camera.adjust import Adjustment, adjust
from sattools.camera.ground import crop_window, ground_sample_distance
from sattools.camera.tiepoints import TiePointImage, TiePointOptions, find_tie_points
from sattools.camera.tracks import Tracks
from sattools.errors import InputError
from sattools.prep.images import SourceImage, at_once, block_factor
from sattools.prep.layout import Bounds, common_bounds, data_edge, ground_polygon
from sattools.prep.pixels import read_gray
from sattools.prep.places import SearchHeights
from sattools.processors import side_by_side
from sattools.progress import Progress, subprogress
from sattools.radiometry.holes import MANY_FOR_FEATURES, without_holes

WINDOWS = 12  # squares of the ground
WINDOW_PX = 1500  # edge of one, at most
WINDOWS_SHARE = 0.5  # of an image that they cover at most: more would cost as much as the whole image
WINDOW_FEATURES = 2000  # per image and square
_CANDIDATES = 7  # squares along an axis from which they are chosen
_LEAST_PX = 200
_LEAST_KNOWN = 0.3  # of a window's pixels
_HEIGHT_MARGIN_M = 30.0


@dataclass(frozen=True)
class GrayImages:
    """The images as `prep` looks at them as a whole.

    Attributes:
        grays: ``[h, w]`` float32 per image, means of ``factors`` x ``factors`` pixels; NaN = no data.
        factors: 1 where an image is read as it is.
    """

    grays: list[NDArray[np.float32]]
    factors: list[int]

    @property
    def reduced(self) -> bool:
        """Whether any image is not seen as it is."""
        return max(self.factors) > 1

    def without_holes(self) -> GrayImages:
        """The images with their single missing pixels from their neighbours, where there are many."""
        return replace(self, grays=[without_holes(gray, MANY_FOR_FEATURES) for gray in self.grays])

    def cameras(self, rpcs: Sequence[RPC]) -> list[RPC]:
        """Cameras of the grey images from those of the images."""
        return [rpc.reduced(factor) for rpc, factor in zip(rpcs, self.factors, strict=True)]

    def edges(self) -> list[NDArray[np.float64] | None]:
        """Outlines of the data, in pixels of the images' windows (see `data_edge`)."""
        found = [data_edge(gray) for gray in self.grays]
        return [None if e is None else (e + 0.5) * f - 0.5 for e, f in zip(found, self.factors, strict=True)]


def read_grays(sources: Sequence[SourceImage], progress: Progress) -> GrayImages:
    """All images, as they are where they are small enough together, else reduced.

    Raises:
        InputError: an image that cannot be read, or that shows nothing.
    """
    sizes = [(s.window[3], s.window[2]) for s in sources]
    factors = [block_factor(size, sizes) for size in sizes]
    grays: list[NDArray[np.float32]] = []
    both = zip(sources, factors, strict=True)
    for source, gray in zip(sources, side_by_side(lambda one: read_gray(*one), both, at_once(sources)), strict=True):
        progress(len(grays) / len(sources), f"reading {source.id}")
        grays.append(gray)
    return GrayImages(grays, factors)


def tie_points_by_windows(
    sources: Sequence[SourceImage], images: GrayImages, crs: str, heights: SearchHeights, progress: Progress
) -> Tracks:
    """Tie points of reduced images, found sharply in windows; pixels are those of the sources' windows.

    Args:
        sources: the images.
        images: the same, reduced.
        crs: projected ground CRS [m].
        heights: at which the ground is looked for.
        progress: told the share done and what is being done.

    Raises:
        InputError: images that have nothing in common.
    """
    cameras = [s.rpc.cropped(s.window[0], s.window[1]) for s in sources]
    coarse = _coarse(sources, images, cameras, crs, heights, subprogress(progress, 0.0, 0.3))
    shifted = [
        rpc.shifted(factor * view.shift_px[0], factor * view.shift_px[1])
        for rpc, factor, view in zip(cameras, images.factors, coarse.views, strict=True)
    ]
    known = coarse.heights()
    low, high = np.quantile(known, [0.01, 0.99]) if known.size else (heights.middle, heights.middle)
    margin = max(_HEIGHT_MARGIN_M, 0.25 * float(high - low))
    search = _Search(sources, images.factors, shifted, crs, (float(low) - margin, float(high) + margin))
    squares = ground_squares(sources, shifted, crs, search.middle)
    pieces: list[Tracks] = []
    for k, square in enumerate(squares):
        here = subprogress(progress, 0.3 + 0.7 * k / len(squares), 0.3 + 0.7 * (k + 1) / len(squares))
        pieces.append(search.tie_points(square, here))
    return joined(pieces)


def ground_squares(sources: Sequence[SourceImage], cameras: Sequence[RPC], crs: str, height: float) -> list[Bounds]:
    """Squares (west, south, east, north) [m] spread over what two images or more show, at most `WINDOWS`.

    The first lies nearest to the middle of those that most images show; each further one is farthest from all before,
    where as many images show it.

    Args:
        sources: the images.
        cameras: of their windows.
        crs: projected ground CRS [m].
        height: at which the images' outlines are taken [m].
    """
    both = list(zip(sources, cameras, strict=True))
    polygons = [ground_polygon(rpc, (0, 0, s.window[2], s.window[3]), height, crs) for s, rpc in both]
    bounds = common_bounds(polygons, share=0.0)
    if bounds is None:
        raise InputError("images: found no ground that two of them show, expected images that overlap")
    west, south, east, north = bounds
    pixels = float(np.median([s.window[2] * s.window[3] for s in sources]))
    edge_px = min(WINDOW_PX, math.sqrt(WINDOWS_SHARE * pixels / WINDOWS))
    edge = edge_px * float(np.median([_pixel_m(s, rpc, height) for s, rpc in both]))
    t = (np.arange(_CANDIDATES) + 0.5) / _CANDIDATES
    centres = [(west + u * (east - west), south + v * (north - south)) for v in t for u in t]
    squares = [box(x - edge / 2, y - edge / 2, x + edge / 2, y + edge / 2) for x, y in centres]
    seen = np.array([_views_of(square, polygons) for square in squares])
    middle = np.array([(west + east) / 2, (south + north) / 2])
    place = np.array(centres)
    chosen: list[int] = []
    apart = -np.hypot(*(place - middle).T) / max(east - west, north - south)
    while len(chosen) < WINDOWS:
        score = np.where(seen >= 2, apart * seen / seen.max(), -np.inf)
        score[chosen] = -np.inf
        best = int(np.argmax(score))
        if not np.isfinite(score[best]):
            break
        chosen.append(best)
        distance = np.hypot(*(place - place[best]).T)
        apart = distance if len(chosen) == 1 else np.minimum(apart, distance)
    return [tuple(float(v) for v in squares[k].bounds) for k in chosen]  # type: ignore[misc]


def joined(pieces: Sequence[Tracks]) -> Tracks:
    """Tracks of several places as one."""
    points, first = [], 0
    for piece in pieces:
        points.append(piece.point + first)
        first += piece.n_points
    if not points:
        return Tracks(np.empty(0, np.intp), np.empty(0, np.intp), np.empty((0, 2)))
    return Tracks(
        np.concatenate(points), np.concatenate([p.view for p in pieces]), np.concatenate([p.pixel for p in pieces])
    )


def _coarse(
    sources: Sequence[SourceImage],
    images: GrayImages,
    cameras: Sequence[RPC],
    crs: str,
    heights: SearchHeights,
    progress: Progress,
) -> Adjustment:
    """What the reduced images say of cameras and heights."""
    reduced = images.cameras(cameras)
    views = [TiePointImage(s.id, g, c) for s, g, c in zip(sources, images.grays, reduced, strict=True)]
    seek = TiePointOptions(max_height_m=heights.half)
    tracks = find_tie_points(views, crs, seek, subprogress(progress, 0.0, 0.7), z_ref=heights.middle)
    sizes = [(g.shape[0], g.shape[1]) for g in images.grays]
    names = [s.id for s in sources]
    return adjust(reduced, names, sizes, tracks, "shift", subprogress(progress, 0.7, 1.0))


@dataclass(frozen=True)
class _Search:
    """What is known before the sharp look: cameras to a few pixels, heights (lowest, highest) [m]."""

    sources: Sequence[SourceImage]
    factors: Sequence[int]
    cameras: Sequence[RPC]
    crs: str
    heights: tuple[float, float]

    @property
    def middle(self) -> float:
        """Of the heights [m]."""
        return 0.5 * (self.heights[0] + self.heights[1])

    def tie_points(self, square: Bounds, progress: Progress) -> Tracks:
        """Those within a square of the ground, in pixels of the sources' windows."""
        views, numbers, corners = [], [], []
        for k, (source, rpc) in enumerate(zip(self.sources, self.cameras, strict=True)):
            size = (source.window[3], source.window[2])
            margin = 16 + 4 * self.factors[k]
            col, row, width, height = crop_window(rpc, self.crs, square, self.heights, size, margin)
            if min(width, height) < _LEAST_PX:
                continue
            part = replace(source, window=(source.window[0] + col, source.window[1] + row, width, height), notes=[])
            gray = without_holes(read_gray(part, whole=False), MANY_FOR_FEATURES)
            if np.isfinite(gray).mean() < _LEAST_KNOWN:
                continue
            views.append(TiePointImage(source.id, gray, rpc.cropped(col, row)))
            numbers.append(k)
            corners.append((col, row))
        if len(views) < 2:
            return joined([])
        options = TiePointOptions(
            max_features=WINDOW_FEATURES,
            coarse_features=WINDOW_FEATURES,
            max_bias_px=float(4 * max(self.factors)),
            max_image_px=4 * WINDOW_PX**2,
            max_height_m=self.heights[1] - self.heights[0],
        )
        tracks = find_tie_points(views, self.crs, options, progress, z_ref=self.middle)
        pixel = tracks.pixel + np.array(corners, float)[tracks.view]
        return Tracks(tracks.point, np.array(numbers, np.intp)[tracks.view], pixel)


def _views_of(square: Polygon, polygons: Sequence[Polygon]) -> int:
    """Images that show most of a square."""
    return sum(polygon.intersection(square).area > 0.6 * square.area for polygon in polygons if not polygon.is_empty)


def _pixel_m(source: SourceImage, rpc: RPC, height: float) -> float:
    lon, lat = rpc.localization((source.window[2] - 1) / 2, (source.window[3] - 1) / 2, height)
    size = ground_sample_distance(rpc, lon, lat, height)
    if not math.isfinite(size):
        raise InputError(f"{source.path}: found an RPC that does not reach the image's pixels, expected its own")
    return size


__all__ = ["GrayImages", "ground_squares", "joined", "read_grays", "tie_points_by_windows"]

"""Tie points between satellite images of different dates: local features, matched where the cameras allow it.

Each image is resampled to north-up ground axes (an affine map per image), so that rotation and scale hardly differ
between views and descriptors need not be invariant to them; contrast is normalised in a window, which takes most of the
season and haze away. A feature's position is then its pixel, put on the ground at a reference height. The same point
seen by two views at height z lies (z_ref - z)(t_b - t_a) apart, t being the horizontal run of a view's line of sight
per metre of height: along that direction the search covers the height range, across it only the cameras' errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sattools.camera.bundle import robust_gauge
from sattools.camera.ground import localize, project
from sattools.camera.matching import Matches, corridor_matches, free_matches, vote
from sattools.camera.rpc import RPC
from sattools.camera.tracks import Tracks, build_tracks
from sattools.errors import InputError
from sattools.processors import side_by_side
from sattools.progress import Progress, silent, subprogress

Array = NDArray[np.float64]
AT_ONCE = 8  # pairs, of up to 100 MB each
# OpenCV doubles the image about its corner and halves positions about its first pixel's centre: all come out that far
# right and down (`enable_precise_upscale` would find other features). In metres it is more, the larger the pixels
SIFT_BIAS_PX = 0.25
# of the best determined shift, below which views do not determine one: those of one pass, whose heights all show along
# one direction, tell shifts along it by their small differences, a few centimetres of which would be kilometres
_DETERMINED = 1e-3
CORRIDOR_PX = 3.0  # half width across the line of sight once the coarse errors are known
CONTRAST_WINDOW_PX = 12.0
CELLS = 16  # along either axis of an image, over which features are spread
MAX_PAIRS, COARSE_PAIRS = 200, 40  # the coarse search needs several neighbours per view, not all


@dataclass(frozen=True)
class TiePointOptions:
    """How tie points are sought. Pixels are those of the images at their own resolution."""

    max_features: int = 2500  # per image, spread evenly; 4000 move no camera by more than 0.05 px
    coarse_features: int = 1500  # strongest ones, for the search without knowing the cameras' errors
    max_bias_px: float = 120.0  # largest error of a camera that the coarse search allows
    max_height_m: float = 600.0  # half of the height range of the coarse search
    max_image_px: int = 6_000_000  # larger images are matched at a lower resolution


@dataclass(frozen=True)
class TiePointImage:
    """What tie points need of an image: grey values `[H, W]` (NaN = no data) and its camera."""

    name: str
    gray: NDArray[np.float32]
    rpc: RPC


@dataclass
class Features:
    """Features of one view: pixels `[n, 2]` (col, row), descriptors `[n, 128]` of unit length, strongest first."""

    pixel: Array
    descriptor: NDArray[np.float32]
    ground: Array = field(default_factory=lambda: np.empty((0, 2)))  # [n, 2] at the reference height
    tangent: Array = field(default_factory=lambda: np.zeros(2))  # d(x, y)/dz of the view's lines of sight

    def place(self, rpc: RPC, crs: str, z_ref: float) -> None:
        """Put the features on the ground at a height.

        Args:
            rpc: the camera.
            crs: projected ground CRS [m].
            z_ref: reference height [m].
        """
        dz = 50.0
        low = np.stack(localize(rpc, crs, self.pixel[:, 0], self.pixel[:, 1], z_ref), -1)
        high = np.stack(localize(rpc, crs, self.pixel[:, 0], self.pixel[:, 1], z_ref + dz), -1)
        self.ground = low
        self.tangent = np.median((high - low) / dz, axis=0) if len(low) else np.zeros(2)


def normalised_contrast(gray: NDArray[np.float32], sigma: float) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Grey values less their local mean over their local deviation, as 8 bit, and a mask."""
    import cv2

    valid = np.isfinite(gray)
    whole = bool(valid.all())
    filled = gray if whole else np.where(valid, gray, 0.0).astype(np.float32)
    # what a window holds of the image; all of it where nothing is missing
    safe = 1.0 if whole else np.maximum(cv2.GaussianBlur(valid.astype(np.float32), (0, 0), sigma), 1e-3)
    mean = cv2.GaussianBlur(filled, (0, 0), sigma) / safe
    variance = cv2.GaussianBlur(filled * filled, (0, 0), sigma) / safe - mean * mean
    # Flat areas must stay flat: noise is not amplified below 2 % of the image's own spread.
    spread = float(np.std(filled[valid])) if valid.any() else 1.0
    floor = max((0.02 * spread) ** 2, 1e-12)
    scaled = 128.0 + 48.0 * (filled - mean) / np.sqrt(np.maximum(variance, floor))
    return np.asarray(np.where(valid, np.clip(scaled, 0, 255), 128), np.uint8), valid


def _extract_features(view: TiePointImage, crs: str, z_ref: float, options: TiePointOptions) -> Features:
    """Upright SIFT features of an image resampled to north-up axes; positions are pixels of the image itself.

    Args:
        view: the image.
        crs: projected ground CRS [m].
        z_ref: reference height [m].
        options: see `TiePointOptions`.
    """
    import cv2

    image, valid = normalised_contrast(view.gray, CONTRAST_WINDOW_PX)
    height, width = image.shape
    to_image, out_width, out_height = _north_up(view.rpc, crs, width, height, z_ref, options.max_image_px)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    shrink = float(np.sqrt(abs(np.linalg.det(to_image[:, :2]))))
    if shrink > 1.2:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.5 * shrink), np.uint8)
    upright = cv2.warpAffine(image, to_image, (out_width, out_height), flags=flags, borderValue=128)
    usable = cv2.warpAffine(valid.astype(np.uint8), to_image, (out_width, out_height), flags=flags, borderValue=0)
    usable = cv2.erode(usable, np.ones((17, 17), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)

    sift = cv2.SIFT.create(contrastThreshold=0.015, edgeThreshold=12, enable_precise_upscale=False)
    keypoints = list(sift.detect(upright, usable))
    if not keypoints:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float32))
    position = np.array([k.pt for k in keypoints])
    response = np.array([k.response for k in keypoints])
    chosen = spread_evenly(position, response, options.max_features)
    seen: set[tuple[float, float, float]] = set()
    kept = []
    for index in chosen:
        k = keypoints[index]
        key = (k.pt[0], k.pt[1], k.size)  # SIFT returns a point once per dominant orientation
        if key not in seen:
            seen.add(key)
            kept.append(cv2.KeyPoint(k.pt[0], k.pt[1], k.size, 0.0, k.response, k.octave))
    described, descriptor = sift.compute(upright, kept)
    pt = np.array([k.pt for k in described]) - SIFT_BIAS_PX
    pixel = pt @ to_image[:, :2].T + to_image[:, 2]
    # Hellinger distance discriminates better than Euclidean (Arandjelovic and Zisserman 2012, "RootSIFT").
    root = np.sqrt(descriptor / np.maximum(descriptor.sum(1, keepdims=True), 1e-6)).astype(np.float32)
    return Features(pixel, root)


def spread_evenly(position: Array, strength: Array, count: int) -> NDArray[np.intp]:
    """Indices of about `count` points, the strongest of each cell of a `CELLS`² grid first; strongest first overall.

    Args:
        position: ``[n, 2]`` [px].
        strength: ``[n]`` the larger, the better.
        count: number of points wanted.
    """
    order = np.argsort(-strength, kind="stable")
    low, high = position.min(0), position.max(0)
    cell = np.minimum(((position - low) / np.maximum(high - low, 1e-9) * CELLS).astype(int), CELLS - 1)
    label = (cell[:, 0] * CELLS + cell[:, 1])[order]
    by_cell = np.argsort(label, kind="stable")
    sizes = np.bincount(label, minlength=CELLS * CELLS)
    first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    rank = np.empty(len(order), int)
    rank[by_cell] = np.arange(len(order)) - first[label[by_cell]]
    # A cell's surplus fills up what empty cells leave: the rank within the cell decides, then the strength.
    best = np.argsort(rank, kind="stable")[:count]
    return order[np.sort(best)]


def choose_pairs(tangents: Array, max_pairs: int) -> list[tuple[int, int]]:
    """Pairs of views to match: all, or where too many those whose slopes ``[V, 2]`` [m/m] differ least."""
    n = len(tangents)
    pairs = [(a, b) for a in range(n) for b in range(a + 1, n)]
    if len(pairs) <= max_pairs:
        return pairs
    distance = {p: float(np.hypot(*(tangents[p[0]] - tangents[p[1]]))) for p in pairs}
    per_view = max(2, 2 * max_pairs // n)
    wanted: set[tuple[int, int]] = {(a, a + 1) for a in range(n - 1)}
    for a in range(n):
        near = sorted((p for p in pairs if a in p), key=lambda p: (distance[p], p))
        wanted.update(near[:per_view])
    return sorted(wanted)


def find_tie_points(
    views: Sequence[TiePointImage],
    crs: str,
    options: TiePointOptions | None = None,
    progress: Progress = silent,
    *,
    z_ref: float | None = None,
) -> Tracks:
    """Tie points of overlapping images.

    Args:
        views: images with their cameras. crs: projected ground CRS [m].
        crs: projected ground CRS [m].
        options: see `TiePointOptions`; None = the defaults.
        progress: told the share done and what is being done.
        z_ref: height around which the ground is looked for [m]; None = the middle of the cameras' own ranges.

    Returns: tracks; each is one ground point seen in two or more images.
    Raises: InputError when fewer than two views are given.
    """
    options = options or TiePointOptions()
    if len(views) < 2:
        raise InputError(f"tie points: found {len(views)} image, expected at least 2")
    if z_ref is None:
        z_ref = float(np.median([v.rpc.alt_offset for v in views]))

    def found_in(view: TiePointImage) -> Features:
        features = _extract_features(view, crs, z_ref, options)
        features.place(view.rpc, crs, z_ref)
        return features

    features = []
    # all at a time need no more memory than one of the largest
    largest = min(max(view.gray.size for view in views), options.max_image_px)
    for found in side_by_side(found_in, views, max(1, options.max_image_px // max(largest, 1))):
        features.append(found)
        progress(0.5 * len(features) / len(views), f"features of {views[len(features) - 1].name}")
    tangents = np.array([f.tangent for f in features])
    pairs = choose_pairs(tangents, MAX_PAIRS)
    pixel_m = np.array([_pixel_size(v, crs, z_ref) for v in views])
    coarse = choose_pairs(tangents, COARSE_PAIRS)
    bias, along = _coarse(features, coarse, pixel_m, options, subprogress(progress, 0.5, 0.75))
    low, high = _height_window(z_ref - along, z_ref, options)

    # Fine: all features, narrow corridors.
    z_mid = 0.5 * (low + high)
    for f, view in zip(features, views, strict=True):
        f.place(view.rpc, crs, z_mid)

    def in_corridors(pair: tuple[int, int]) -> tuple[Matches, NDArray[np.float32]]:
        (a, b), (fa, fb) = pair, (features[k] for k in pair)
        return corridor_matches(
            fa.ground - bias[a],
            fa.descriptor,
            fb.ground - bias[b],
            fb.descriptor,
            fb.tangent - fa.tangent,
            half_height=0.5 * (high - low),
            half_width=CORRIDOR_PX * max(pixel_m[a], pixel_m[b]),
        )

    matches = []
    for (a, b), matched in zip(pairs, side_by_side(in_corridors, pairs, AT_ONCE), strict=True):
        matches.append((a, b, *matched))
        progress(0.75 + 0.25 * len(matches) / len(pairs), "fine matching")
    progress(1.0, "tie points")
    return build_tracks([f.pixel for f in features], matches)


def _coarse(
    features: Sequence[Features],
    pairs: Sequence[tuple[int, int]],
    pixel_m: Array,
    options: TiePointOptions,
    progress: Progress,
) -> tuple[Array, Array]:
    """Strong features, whole height range, large camera errors.

    Returns:
        Each view's error across the direction of height ``[n, 2]`` [m], and how far below the reference height matches
        lie ``[m]`` [m].
    """
    shifts, seen = [], []
    most = options.coarse_features

    def anywhere(pair: tuple[int, int]) -> Matches:
        (a, b), (fa, fb) = pair, (features[k] for k in pair)
        return free_matches(
            fa.ground[:most],
            fa.descriptor[:most],
            fb.ground[:most],
            fb.descriptor[:most],
            fb.tangent - fa.tangent,
            half_height=options.max_height_m,
            half_bias=2 * options.max_bias_px * max(pixel_m[a], pixel_m[b]),
        )

    for (a, b), matched in zip(pairs, side_by_side(anywhere, pairs, AT_ONCE), strict=True):
        fa, fb = features[a], features[b]
        seen.append(matched)
        progress(len(seen) / len(pairs), "coarse matching")
        shifts.append(vote(fa.ground[matched[:, 0]], fb.ground[matched[:, 1]], fb.tangent - fa.tangent, pixel_m[a]))
    bias = coarse_bias(pairs, shifts, np.array([f.tangent for f in features]))
    depths = []
    for (a, b), matched in zip(pairs, seen, strict=True):
        fa, fb = features[a], features[b]
        run = fb.tangent - fa.tangent
        length = float(np.hypot(*run))
        if length < 0.05 or len(matched) == 0:
            continue
        apart = (fb.ground[matched[:, 1]] - bias[b]) - (fa.ground[matched[:, 0]] - bias[a])
        along, across = apart @ run / length, apart @ np.array([-run[1], run[0]]) / length
        good = np.abs(across) < CORRIDOR_PX * pixel_m[a]
        depths.append(along[good] / length)
    return bias, np.concatenate(depths) if depths else np.empty(0)


def coarse_bias(
    pairs: Sequence[tuple[int, int]], shifts: Sequence[tuple[Array, Array, float]], tangents: Array
) -> Array:
    """Ground shift `[n, 2]` of each view from the shifts of pairs, each known in one or two directions.

    Least absolute deviations by reweighting. Common shifts and those that mean another height cannot be seen; among all
    equal solutions the one with the smallest corrections (robustly) is taken.

    Args:
        pairs: indices of two views each.
        shifts: per pair, axes ``[k, 2]``, shifts along them ``[k]`` [m] and a weight, see `vote`.
        tangents: ``[n, 2]`` displacement per metre of height of each view [m/m].
    """
    n = len(tangents)
    rows, values, weights = [], [], []
    for (a, b), (axes, amounts, weight) in zip(pairs, shifts, strict=True):
        for axis, amount in zip(axes, amounts, strict=True):
            row = np.zeros(2 * n)
            row[2 * b : 2 * b + 2], row[2 * a : 2 * a + 2] = axis, -axis
            rows.append(row)
            values.append(amount)
            weights.append(weight)
    if not rows:
        return np.zeros((n, 2))
    design, target, base = np.array(rows), np.array(values), np.sqrt(np.array(weights))
    w = base.copy()
    solution = np.zeros(2 * n)
    for _ in range(30):
        solution = np.linalg.lstsq(design * w[:, None], target * w, rcond=_DETERMINED)[0]
        residual = np.abs(design @ solution - target)
        w = base / np.sqrt(np.maximum(residual, 0.1))
    bias = solution.reshape(n, 2)
    # A common shift moves all alike; a common height h moves view v by h times its tangent.
    movement = np.concatenate([np.tile(np.eye(2), (n, 1, 1)), tangents[:, :, None]], axis=2)
    return bias - movement @ robust_gauge(bias, movement)


def _height_window(heights: Array, z_ref: float, options: TiePointOptions) -> tuple[float, float]:
    """Height range of the fine search: the bulk of the coarse heights, widened."""
    if heights.size < 20:
        return z_ref - options.max_height_m, z_ref + options.max_height_m
    low, high = np.percentile(heights, [5, 95])
    margin = max(0.5 * (high - low), 20.0)
    return float(low - margin), float(high + margin)


def _pixel_size(view: TiePointImage, crs: str, z: float) -> float:
    row, col = (np.array(view.gray.shape) - 1) / 2
    x, y = localize(view.rpc, crs, [col, col + 1, col], [row, row, row + 1], z)
    return float(np.sqrt(abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]))))


def _north_up(rpc: RPC, crs: str, width: int, height: int, z: float, max_px: int) -> tuple[Array, int, int]:
    """Affine map `[2, 3]` from a north-up raster to the image, and the raster's size."""
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)
    x, y = localize(rpc, crs, corners[:, 0], corners[:, 1], z)
    west, east, south, north = x.min(), x.max(), y.min(), y.max()
    area = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
    cell = float(np.sqrt(area / (width * height)))
    cell = max(cell, float(np.sqrt((east - west) * (north - south) / max_px)))
    n_cols, n_rows = int((east - west) / cell) + 1, int((north - south) / cell) + 1
    gc, gr = (g.ravel() for g in np.meshgrid(np.linspace(0, n_cols, 9), np.linspace(0, n_rows, 9)))
    col, row = project(rpc, crs, west + gc * cell, north - gr * cell, z)
    design = np.stack([gc, gr, np.ones_like(gc)], 1)
    solution = np.linalg.lstsq(design, np.stack([col, row], 1), rcond=None)[0]
    return solution.T.astype(np.float64), n_cols, n_rows


__all__ = ["Features", "TiePointImage", "TiePointOptions", "coarse_bias", "find_tie_points"]

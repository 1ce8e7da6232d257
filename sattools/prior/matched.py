"""Images of an area, brought to one brightness and matched."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sattools.camera.ground import ground_sample_distance, to_geographic
from sattools.prior.confidence import match_confidence
from sattools.prior.frame import Frame
from sattools.prior.leftout import left_out_agreement
from sattools.prior.matching.match import Match, margin_for, match
from sattools.prior.matching.pairs import choose_pairs
from sattools.prior.neighbours import STEP_M, means_of_cells, relief
from sattools.prior.options import PriorOptions
from sattools.progress import Progress, silent
from sattools.scene import Grid
from sattools.scene.regrid import nearest_cells, resize_map
from sattools.views import (
    GROUND_SHARE,
    RadiometricBalance,
    Source,
    View,
    check_seen,
    line_of_sight,
    match_colours,
    views_on,
)

REFERENCE_CONTRAST = 0.8322  # from dark to bright (2 ... 98 %) in an 8-bit image of a city
LINEAR_TONE = 1 / 2.2  # exponent of the tone curve of linear images
WHITE = 98  # per cent of an image that are darker than what counts as white
MIDDLE = 0.5  # of white: as bright is the middle, at least, of images with a tone curve


@dataclass(frozen=True)
class Matched:
    """What matching an area has found.

    Attributes:
        height: ``[H, W]`` [m]; a height without two consistent views is a guess, for the fit to judge.
        confidence: ``[H, W]`` in [0, 1].
        pairs: ids of the images that were correlated.
        agreement: how every image agrees with the others, by id; None = unknown.
        seen_by_two, consistent_in_two: shares of the cells, without those around the area.
        bent: the image whose lines of sight are the least parallel, and by how much [m].
        shares: how much every image counted, by id.
    """

    height: np.ndarray
    confidence: np.ndarray
    pairs: list[tuple[str, str]]
    agreement: dict[str, float | None]
    seen_by_two: float
    consistent_in_two: float
    bent: tuple[str, float]
    shares: dict[str, float]


def match_area(
    sources: list[Source],
    grid: Grid,
    z_range: tuple[float, float],
    options: PriorOptions,
    progress: Progress = silent,
    *,
    of: Grid | None = None,
) -> Matched | None:
    """`match_sources`, and how sure it is.

    Args:
        sources: the images.
        grid: of the result.
        z_range: lowest and highest height [m].
        options: of the matching.
        progress: share done.
        of: the part of the grid that shares are of; None = all of it.
    """
    found = match_sources(sources, grid, z_range, options, progress)
    if found is None:
        return None
    matched, views, pairs, agreement = found
    worst = max(views, key=lambda view: view.parallel_ray_error_m)
    inside = grid.window(of or grid)
    return Matched(
        matched.height,
        match_confidence(matched),
        [(views[a].id, views[b].id) for a, b in pairs],
        {view.id: value for view, value in zip(views, agreement, strict=True)},
        float((matched.views[inside] >= 2).mean()),
        float((matched.consistent_views[inside] >= 2).mean()),
        (worst.id, worst.parallel_ray_error_m),
        {view.id: share for view, share in zip(views, matched.shares, strict=True)},
    )


def match_sources(
    sources: list[Source],
    grid: Grid,
    z_range: tuple[float, float],
    options: PriorOptions,
    progress: Progress = silent,
) -> tuple[Match, list[View], np.ndarray, list[float | None]] | None:
    """Match images on cells finer than a grid's, and take the means over its cells.

    Args:
        sources: the images.
        grid: of the result.
        z_range: lowest and highest height [m].
        options: of the matching.
        progress: share done.

    Returns:
        What was found on the grid, the views, the pairs ``[P, 2]`` of their indices that were correlated, and how every
        view agrees with the others; None where no two of them look from different directions.
    """
    fine = grid.resized(grid.cell_size * options.detail)
    frame, views = make_frame(sources, fine, z_range, options.window)
    limits = (options.min_angle, options.max_angle)
    pairs = choose_pairs([v.slope for v in views], [v.sun for v in views], options.pairs, limits, options.ideal_angle)
    if not len(pairs):
        return None
    matched = match(frame, pairs, z_range, options, progress, finer=1 / options.detail)
    agreement = left_out_agreement(frame, matched.height)
    maps = {name: crop(array, fine.shape) for name, array in vars(matched).items() if isinstance(array, np.ndarray)}
    resized: dict[str, Any] = {
        name: nearest_cells(array, fine, grid) if array.dtype == np.uint8 else resize_map(array, fine, grid)
        for name, array in maps.items()
    }
    resized["height"] = means_of_cells(maps["height"], fine, grid, matched.blur, STEP_M * relief(fine.cell_size))
    return replace(matched, **resized), views, pairs, agreement


def crop(array: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The upper left part of that shape [cells] (a frame may have a row or column more than the grid)."""
    return array[: shape[0], : shape[1]]


def gamma_encode(
    images: np.ndarray, masks: np.ndarray, linear: bool, contrast: float | None = None, tone: float | None = None
) -> np.ndarray:
    """Grey images with a tone curve, scaled to a usual contrast, so that thresholds mean the same for every sensor.

    Args:
        images: ``[V, H, W]`` radiance.
        masks: ``[V, H, W]`` 1 = valid.
        linear: whether they are linear radiance.
        contrast: of all images, with their tone curve, where it is known; else that of these.
        tone: the curve's exponent, where it is known; else see `tone_of`.
    """
    curve = toned(images, tone or tone_of(images, masks, linear))
    scale = REFERENCE_CONTRAST / (contrast or contrast_of(curve, masks))
    return np.multiply(curve, np.float32(scale), dtype=np.float32)


def tone_of(images: np.ndarray, masks: np.ndarray, linear: bool) -> float:
    """Exponent of the tone curve that images need to be matched.

    Linear radiance hides the texture of shadows in a sliver of its range. Images of 8 bits mostly bring a tone curve
    along, but they may be linear ones that a program has only scaled: these are dark. Theirs gets the middle half as
    bright as white.

    Args:
        images: ``[V, H, W]`` radiance.
        masks: ``[V, H, W]`` 1 = valid.
        linear: whether they are linear radiance for sure.
    """
    if linear:
        return LINEAR_TONE
    middle, white = _levels(images, masks, (50, WHITE))
    if not 0 < middle < MIDDLE * white:
        return 1.0
    return max(float(np.log(MIDDLE) / np.log(middle / white)), LINEAR_TONE)


def toned(images: np.ndarray, tone: float) -> np.ndarray:
    """The images (radiance) with a tone curve of that exponent."""
    return np.asarray(np.maximum(images, 0.0) ** np.float32(tone)) if tone != 1 else images


def contrast_of(images: np.ndarray, masks: np.ndarray) -> float:
    """From dark to bright (2 ... 98 %) of the radiance where the mask is 1."""
    low, high = _levels(images, masks, (2, WHITE))
    return max(high - low, 1e-6)


def _levels(images: np.ndarray, masks: np.ndarray, shares: tuple[float, float]) -> tuple[float, float]:
    """Percentiles of the radiance where the mask is 1."""
    some, valid = images.ravel()[::7], masks.ravel()[::7] > 0
    low, high = np.percentile(some[valid], shares)
    return float(low), float(high)


def common_balance(sources: list[Source], views: list[View], tone: float | None = None) -> list[RadiometricBalance]:
    """How each view becomes grey as the others are, from all that they show; for parts of an area to agree on.

    Args:
        sources: the images.
        views: what they show.
        tone: exponent of their tone curve, where it is known; else see `tone_of`.
    """
    gain, offset = match_colours(views)
    grey = np.stack([_grey(v, a, b) for v, a, b in zip(views, gain, offset, strict=True)])
    masks = np.stack([view.mask for view in views])
    tone = tone or tone_of(grey, masks, all(s.linear for s in sources))
    contrast = contrast_of(toned(grey, tone), masks)
    return [RadiometricBalance(a.tolist(), b.tolist(), contrast, tone) for a, b in zip(gain, offset, strict=True)]


def _grey(view: View, gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Mean of a view's bands as the first view shows them, ``[H, W]`` float32."""
    weight = (1 / (len(gain) * gain)).astype(np.float32)
    return view.target @ weight - np.float32(offset @ weight)


def matching_height(z_range: tuple[float, float]) -> float:
    """Height at which the images are laid over the grid to be matched [m].

    Args:
        z_range: lowest and highest height [m].
    """
    return z_range[0] + GROUND_SHARE * (z_range[1] - z_range[0])


def make_frame(
    sources: list[Source], grid: Grid, z_range: tuple[float, float], window: int
) -> tuple[Frame, list[View]]:
    """Resample all images to the grid and a margin around it, so that high and low points at its border are seen too.

    Rows and columns are made even, as matching halves them.

    Args:
        sources: the images.
        grid: ground grid.
        z_range: lowest and highest height [m].
        window: half width of the matching window [cells].
    """
    z_ref = matching_height(z_range)
    cell = grid.cell_size
    directions = [line_of_sight(s.rpc, grid, z_ref, z_range)[0] for s in sources]
    for source, direction in zip(sources, directions, strict=True):
        check_seen(source.id, np.isfinite(direction))  # a camera of another place has no line of sight here
    margin = margin_for(np.array([direction.parallax(cell) for direction in directions]), z_ref, z_range, window)
    wide = Grid(
        grid.crs,
        grid.left - margin * cell,
        grid.top + margin * cell,
        cell,
        grid.width + grid.width % 2 + 2 * margin,
        grid.height + grid.height % 2 + 2 * margin,
    )
    views = views_on([source.complete() for source in sources], wide, z_ref, z_range)
    parallax = np.array([view.slope.parallax(cell) for view in views])
    balances = [s.balance for s in sources if s.balance]
    if len(balances) == len(sources):
        gain, offset = (
            np.array([t.gain for t in balances], np.float32),
            np.array([t.offset for t in balances], np.float32),
        )
    else:
        gain, offset = match_colours(views)
    images = np.stack([_grey(v, a, b) for v, a, b in zip(views, gain, offset, strict=True)])
    masks = np.stack([view.mask for view in views])
    inside = slice(margin, -margin or None)
    for view, mask in zip(views, masks, strict=True):
        check_seen(view.id, mask[inside, inside])
    known = (balances[0].contrast, balances[0].tone) if balances else (None, None)
    images = gamma_encode(images, masks, all(s.linear for s in sources), *known)
    west, south, east, north = grid.bounds
    lon, lat = to_geographic(grid.crs, (west + east) / 2, (south + north) / 2)
    pixels = tuple(ground_sample_distance(source.rpc, lon, lat, z_ref) for source in sources)
    return Frame(images, masks, parallax, z_ref, cell, margin, tuple(v.sun for v in views), pixels), views


__all__ = [
    "Matched", "common_balance", "crop", "gamma_encode", "make_frame", "match_area", "match_sources", "matching_height",
]  # fmt: skip

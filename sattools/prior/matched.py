"""Images of an area, brought to one brightness and matched."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sattools.camera.ground import ground_sample_distance, middle_lon_lat
from sattools.prior.confidence import match_confidence
from sattools.prior.frame import Frame
from sattools.prior.leftout import left_out_agreement
from sattools.prior.matching.match import Match, margin_for, match
from sattools.prior.matching.pairs import choose_pairs
from sattools.prior.neighbours import OUTSTANDING, STEP_M, means_of_cells, quarters, relief
from sattools.prior.options import PriorOptions
from sattools.prior.tones import grey, toned_views, with_contrast
from sattools.progress import Progress, silent
from sattools.scene import Grid
from sattools.scene.regrid import nearest_cells, resize_map
from sattools.views import (
    GROUND_SHARE,
    Source,
    View,
    check_seen,
    line_of_sight,
    match_colours,
    views_on,
)


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
        water: ``[H, W]`` uint8, 1 = laid level as water, which says nothing of how high it is; None = nowhere.
    """

    height: np.ndarray
    confidence: np.ndarray
    pairs: list[tuple[str, str]]
    agreement: dict[str, float | None]
    seen_by_two: float
    consistent_in_two: float
    bent: tuple[str, float]
    shares: dict[str, float]
    water: np.ndarray | None = None


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
    height, cells, side = maps["height"], fine, maps.pop("side", None)
    if side is not None:
        height, cells = quarters(height, side), fine.resized(fine.cell_size / 2)
    resized: dict[str, Any] = {
        name: nearest_cells(array, fine, grid) if array.dtype == np.uint8 else resize_map(array, fine, grid)
        for name, array in maps.items()
    }
    out = OUTSTANDING * fine.cell_size / grid.cell_size
    resized["height"] = means_of_cells(height, cells, grid, matched.blur, STEP_M * relief(fine.cell_size), out=out)
    return replace(matched, **resized, side=None), views, pairs, agreement


def crop(array: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The upper left part of that shape [cells] (a frame may have a row or column more than the grid)."""
    return array[: shape[0], : shape[1]]


def matching_height(z_range: tuple[float, float]) -> float:
    """Height at which the images are laid over the grid to be matched [m].

    Args:
        z_range: lowest and highest height [m].
    """
    return z_range[0] + GROUND_SHARE * (z_range[1] - z_range[0])


def make_frame(
    sources: list[Source], grid: Grid, z_range: tuple[float, float], window: int, tone: float | None = None
) -> tuple[Frame, list[View]]:
    """Resample all images to the grid and a margin around it, so that high and low points at its border are seen too.

    Rows and columns are made even, as matching halves them. The views have the tone curve of the frame.

    Args:
        sources: the images.
        grid: ground grid.
        z_range: lowest and highest height [m].
        window: half width of the matching window [cells].
        tone: exponent of the tone curve, where it is known; else see `tone_of`.
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
    balances = [s.balance for s in sources if s.balance and s.balance.tone]
    contrast = None
    if len(balances) == len(sources):
        contrast, tone = balances[0].contrast, balances[0].tone
    views, tone = toned_views(sources, views, tone)
    if contrast:
        gain, offset = (
            np.array([t.gain for t in balances], np.float32),
            np.array([t.offset for t in balances], np.float32),
        )
    else:
        gain, offset = match_colours(views)
    images, masks = grey(views, gain, offset), np.stack([view.mask for view in views])
    inside = slice(margin, -margin or None)
    for view, mask in zip(views, masks, strict=True):
        check_seen(view.id, mask[inside, inside])
    images = with_contrast(images, masks, contrast)
    lon, lat = middle_lon_lat(grid)
    pixels = tuple(ground_sample_distance(source.rpc, lon, lat, z_ref) for source in sources)
    suns = tuple(view.sun for view in views)
    return Frame(images, masks, parallax, z_ref, cell, margin, suns, pixels, tone=tone), views


__all__ = [
    "Matched", "crop", "make_frame", "match_area", "match_sources", "matching_height",
]  # fmt: skip

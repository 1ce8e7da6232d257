"""Multi-view matching on the ground grid: images on a frame go in, heights and their evidence come out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter, minimum_filter

from sattools.prior.frame import Frame
from sattools.prior.matching.equalise import brightened, equally_bright, equally_sharp
from sattools.prior.matching.subplane import refine_subplane
from sattools.prior.matching.sweep import (
    BEYOND_PLANES,
    FEW_PAIRS,
    KEEP_PLANES,
    ROBUST_PAIRS,
    MatchTask,
    narrow,
    sweep_blocks,
)
from sattools.prior.matching.weights import pair_shares, view_shares
from sattools.prior.neighbours import STEP_M, mean_of_neighbours, relief
from sattools.prior.options import PriorOptions
from sattools.prior.visibility.alone import stands_alone
from sattools.prior.visibility.chance import without_lumps
from sattools.prior.visibility.consistency import RayMinima, count_consistent_views, filled, standing, supported
from sattools.prior.visibility.courtyards import RoughSurface, open_courtyards
from sattools.prior.visibility.crowns import bare_crowns, with_crowns
from sattools.prior.visibility.edges import snap_edges
from sattools.prior.visibility.occlusion import (
    all_visible,
    compute_visibility,
    erode,
    measure_dark,
    mostly_shaded,
    within_images,
)
from sattools.prior.visibility.pits import close_pits
from sattools.prior.visibility.restless import restless
from sattools.prior.visibility.torn import pieces_of_roofs
from sattools.progress import Progress, silent, subprogress
from sattools.scene.regrid import split_cells

SURE = 0.5  # agreement above which a cell of the first pass says where the surface lies
CONVERGED = 0.002  # share of cells that may still change when the rough passes stop
LEAST_ERODED = 1.0  # cells by which the surface is eroded where `erode` is less
OPENING_PASSES = 1  # rough passes after which roofs of courtyards are looked for
PLANE_CELLS = 2  # least distance of the height planes, in cells
SMOOTH = 3  # cells of the median filter that ends it all
SLOPES_DEG = (8.0, 50.0)  # steeper than what is built level, less steep than walls
HILLS = (0.58, 0.65)  # share of the sure cells that are such slopes: up to the first a town, from the second on hills
CHANCE_PAIRS = 12  # pairs below which what views agree about may be chance, in towns, too
HILLS_PAIRS = 10  # pairs without which slopes are not believed: old towns in three views look like hills
HILLS_UNLIKE = 3.0  # factor of `brightness` and `edges` there: seen from nearer to the sun open ground is brighter
AGREED = (0.55, 0.75)  # share of what two images show that few pairs agree about: up to the first they are unlike
UNLIKE = 2.0  # factor of `brightness` there, none from the second share on


@dataclass(frozen=True)
class Match:
    """What matching found on the grid.

    Attributes:
        height: ``[H, W]`` float32 [m].
        score: ``[H, W]`` float32 agreement of the images there, in [0, 1].
        uniqueness: ``[H, W]`` float32 aggregated cost, per path, by which the best height two planes away or more is
            dearer.
        views: ``[H, W]`` uint8 number of images that see the surface there.
        consistent_views: ``[H, W]`` uint8 number of these whose rays have their best place there (see `minima`).
        blur: how far coarser cells that a wall divides are the mean of both sides (see `blurred_walls`).
        shares: per view, how much it counted (see `view_shares`).
        side: ``[H, W]`` float32 which side of a wall the matching's own cells belong to, see `Snapped`; or None.
    """

    height: np.ndarray
    score: np.ndarray
    uniqueness: np.ndarray
    views: np.ndarray
    consistent_views: np.ndarray
    blur: float = 1.0
    shares: tuple[float, ...] = ()
    side: np.ndarray | None = None


def margin_for(parallax: np.ndarray, z_ref: float, z_range: tuple[float, float], window: int) -> int:
    """Margin in cells, even, so that no point within the heights leaves the frame with its window.

    Args:
        parallax: ``[V, 2]`` (row, column) cells per metre of height.
        z_ref: reference height [m].
        z_range: lowest and highest height [m].
        window: half width of the matching window [cells].
    """
    reach = max(abs(z_range[0] - z_ref), abs(z_range[1] - z_ref))
    cells = math.ceil(float(np.abs(parallax).max()) * reach) + 2 * window + 4
    return cells + cells % 2


def match(
    frame: Frame,
    pairs: np.ndarray,
    z_range: tuple[float, float],
    options: PriorOptions,
    progress: Progress = silent,
    *,
    finer: float = 1.0,
) -> Match:
    """Find the surface: rough passes find the occlusions, a last one the heights.

    Args:
        frame: the views; at least two.
        pairs: ``[P, 2]`` indices of the views to correlate.
        z_range: lowest and highest height [m].
        options: see `PriorOptions`.
        progress: told the share done.
        finer: number of the frame's cells along a cell of the surface that is made of it.
    """
    task = _prepared(frame, pairs, z_range, options)
    frame, step = task.frame, task.step
    visibility = all_visible(frame)
    guide = ceiling = crowns = None
    if options.rough_passes:
        task, surface = _rough_passes(task, progress)
        frame = task.frame
        visibility = surface.visibility.doubled()
        guide = split_cells(surface.height)
        ceiling, crowns = (None if one is None else split_cells(one) for one in (surface.ceiling, surface.crowns))
    last = subprogress(progress, 0.4, 1.0)
    minima = RayMinima.unknown(frame)
    height, score, uniqueness = sweep_blocks(task, visibility, last, guide=guide, ceiling=ceiling, minima=minima)
    height = median_filter(height, SMOOTH, mode="nearest")
    hits, tolerance = visibility.first_hit_height, task.options.tolerance
    agreeing, views = count_consistent_views(frame, hits, minima, height, tolerance, step)
    # beyond the images nothing is known that could be on the lower side of anything
    beyond_images = np.asarray(~within_images(frame, height, tolerance).any(axis=0))
    chance = not task.robust or len(pairs) < CHANCE_PAIRS
    shaded = None if chance else mostly_shaded(frame, visibility, height, tolerance)
    stands = supported(standing(agreeing, views, beyond_images), height, agreeing, frame.cell, shaded)
    many_in_town = len(pairs) >= ROBUST_PAIRS and task.hills == 0
    if many_in_town and shaded is not None:
        stands |= stands_alone(height, agreeing, views, frame.cell) & ~shaded
    lowered = filled(height, stands, frame.cell)
    if chance:
        lowered = without_lumps(lowered, stands, frame.cell)
    if many_in_town:
        whole = pieces_of_roofs(height, lowered, agreeing / np.maximum(views, 1), frame.cell)
        lowered[whole] = height[whole]
        lowered = close_pits(task, visibility, lowered)
    height = lowered if crowns is None else with_crowns(lowered, crowns)
    height = median_filter(refine_subplane(task, visibility, height), SMOOTH, mode="nearest")
    doubt, blur, side = None, 1.0, None
    if task.options.edges and task.hills < 1:
        few = not task.robust
        height, doubt, blur, side = snap_edges(frame, hits, height, tolerance, task.options.edges, finer, few=few)
    agreeing, views = count_consistent_views(frame, hits, minima, height, tolerance, step)
    height = mean_of_neighbours(height, doubt, step_m=STEP_M * relief(frame.cell))
    return Match(height, score, uniqueness, views, agreeing, blur, task.frame.shares, side)


def _prepared(frame: Frame, pairs: np.ndarray, z_range: tuple[float, float], options: PriorOptions) -> MatchTask:
    """The task of the last pass.

    Images have lost their mean, masks the windows that reach beyond an image, and the margin is such that no height of
    any pass leaves the frame.
    """
    images, sharpness = equally_sharp(frame.images - np.float32(frame.images[frame.masks > 0].mean()), frame.masks)
    size = 2 * options.window + 1
    masks = np.stack([minimum_filter(mask, size, mode="nearest") for mask in frame.masks])
    shares = view_shares(sharpness, frame.pixels, frame.cell, options.blurred)
    fine = replace(frame, images=images, masks=masks, shares=shares)
    step = options.step or plane_distance(frame, pairs)
    # the first surface is known to the planes of the rough passes: what is nearer must not count as occluded
    options = replace(options, tolerance=max(options.tolerance, 2 * step))
    # the kernels test no bounds: the highest and lowest planes of the roughest pass must stay within the frame
    beyond = 2 * BEYOND_PLANES * step
    reached = (z_range[0] - beyond, z_range[1] + beyond)
    fine = fine.widened(margin_for(fine.parallax, fine.z_ref, reached, options.window))
    return MatchTask(fine, pairs, z_range, step, options, robust=len(pairs) >= ROBUST_PAIRS)


def how_hilly(height: np.ndarray, sure: np.ndarray, cell: float) -> float:
    """Whether a rough surface is one of hills: 0 a town, 1 hills; between, by the share of slopes.

    Args:
        height: ``[H, W]`` rough surface [m].
        sure: ``[H, W]`` bool, where the images agree about it; elsewhere it is noise, which has slopes, too.
        cell: its cells' edge [m].
    """
    slope = np.degrees(np.arctan(np.hypot(*np.gradient(height, cell))))
    share = float(np.mean(((slope > SLOPES_DEG[0]) & (slope < SLOPES_DEG[1]))[sure])) if sure.any() else 0.0
    return min(max((share - HILLS[0]) / (HILLS[1] - HILLS[0]), 0.0), 1.0)


def how_unlike(frame: Frame, height: np.ndarray, sure: np.ndarray, tolerance: float) -> float:
    """How unlike images are that show one surface: 0 as they mostly are, 1 very; by what they agree about.

    Seasons, haze, clouds' shadows and what shines make them so. Of many pairs some are alike everywhere.

    Args:
        frame: the views.
        height: ``[H, W]`` rough surface [m].
        sure: ``[H, W]`` bool, where the images agree about it.
        tolerance: depth below the visible surface that still counts as seen [m].
    """
    shown = within_images(frame, height, tolerance).sum(axis=0) >= 2
    share = float(np.mean(sure[shown])) if shown.any() else 1.0
    return min(max((AGREED[1] - share) / (AGREED[1] - AGREED[0]), 0.0), 1.0)


def for_hills(options: PriorOptions, hills: float) -> PriorOptions:
    """The options for ground that rises and falls.

    In a city most cells are level, and surfaces of one brightness each need it to be told apart. Hills have texture
    everywhere, but show every view a brightness of its own, by what their slopes and soils reflect to where it is.
    (Nor are their slopes walls, to be moved to where the brightness changes: see `match`.)

    Args:
        options: as they are given, for cities.
        hills: 0 to 1, see `how_hilly`.
    """
    unlike = 1 + hills * (HILLS_UNLIKE - 1)
    return replace(
        options,
        brightness=options.brightness * unlike,
        edges=options.edges * unlike,
    )


def _known_ground(rough: MatchTask, found: np.ndarray, height: np.ndarray, sure: np.ndarray) -> MatchTask:
    """The task of the second rough pass, after the first: heights that there are, hills or town.

    Args:
        rough: of the first pass.
        found: ``[H, W]`` heights of the matching, which has the slopes [m].
        height: ``[H, W]`` the same without what stands by chance [m].
        sure: ``[H, W]`` bool, where the images agree.
    """
    z_range = narrow(height[sure], rough.z_range, KEEP_PLANES * rough.step, rough.step)
    slopes = how_hilly(found, sure, rough.frame.cell)  # few pairs are not believed, but hills there may be
    hills = slopes if len(rough.pairs) >= HILLS_PAIRS else 0.0
    robust = rough.robust or (len(rough.pairs) >= FEW_PAIRS and slopes == 0)
    options = for_hills(rough.options, hills)
    if len(rough.pairs) < ROBUST_PAIRS:
        unlike = how_unlike(rough.frame, height, sure, options.tolerance)
        brightness = rough.options.brightness * (1 + unlike * (UNLIKE - 1))
        options = replace(options, brightness=max(options.brightness, brightness))
    return replace(rough, z_range=z_range, options=options, hills=hills, robust=robust)


def _rough_passes(task: MatchTask, progress: Progress) -> tuple[MatchTask, RoughSurface]:
    """Match at twice the cell until surface and occlusions agree; the task of the last pass, and the surface."""
    frame, options, passes = task.frame.halved(), task.options, task.options.rough_passes
    rough = replace(task, frame=frame, step=2 * task.step)
    visibility = all_visible(frame)
    before = ceiling = open_to_all = None
    for k in range(passes):
        progress(0.4 * k / passes, f"rough pass {k + 1} of {passes}")
        minima = None if rough.robust else RayMinima.unknown(frame)
        found, score, _ = sweep_blocks(rough, visibility, guide=before, ceiling=ceiling, minima=minima)
        height = found = median_filter(found, 3, mode="nearest")
        if minima is not None:
            # few views leave much unseen, and what is wrong there hides what is right in the next pass
            hits = visibility.first_hit_height
            agreeing, views = count_consistent_views(frame, hits, minima, found, options.tolerance, rough.step)
            stands = supported(standing(agreeing, views), found, agreeing, frame.cell)
            height = without_lumps(filled(found, stands, frame.cell), stands, frame.cell)
            height = median_filter(height, 3, mode="nearest")
        if k == 0:
            rough = _known_ground(rough, found, height, score > SURE)
        eroded = erode(height, max(options.erode / frame.cell, LEAST_ERODED) if options.erode else 0.0)
        if before is not None and len(task.pairs) >= ROBUST_PAIRS:
            if open_to_all is None:  # the first time, as what hides nothing settles
                open_to_all = restless(height, before, frame.cell)
            eroded = np.where(open_to_all, np.float32(rough.z_range[0] - rough.step), eroded)
        visibility = compute_visibility(frame, eroded, rough.z_range, options.tolerance, visibility.dark)
        if k == 0:
            light = equally_bright(frame, visibility, height, score > SURE, options.tolerance)
            frame, fine = brightened(frame, *light), brightened(task.frame, *light)
            task, rough = replace(task, frame=fine), replace(rough, frame=frame)
        dark = measure_dark(frame, height, options.tolerance, visibility)
        surface = RoughSurface(height, score, eroded, replace(visibility, dark=dark), ceiling)
        if k < OPENING_PASSES:
            # how the views agree about a floor is compared with how they did about the roof: by the same mean (that
            # they are equally bright since is worth 0.02 to 0.06, once 0.13; taken off, courtyards were no better)
            surface = open_courtyards(replace(rough, robust=task.robust), surface)
        visibility, ceiling = surface.visibility, surface.ceiling
        if before is not None and np.mean(np.abs(surface.height - before) > task.step) < CONVERGED:
            break
        before = surface.height
    known = replace(task, z_range=rough.z_range, options=rough.options, hills=rough.hills, robust=rough.robust)
    if len(task.pairs) >= ROBUST_PAIRS:
        # in the last pass alone: those before it have to find what hides what, which pairs of all kinds tell
        sure = surface.score > SURE
        shares = pair_shares(frame, surface.visibility, surface.height, sure, task.pairs, rough.options)
        known = replace(known, shares=shares)
        if rough.hills == 0:
            crowns = bare_crowns(replace(rough, shares=shares), surface, open_to_all)
            surface = replace(surface, crowns=crowns)
    return known, surface


def plane_distance(frame: Frame, pairs: np.ndarray) -> float:
    """Distance of the height planes [m]: `PLANE_CELLS`, or more where no pair moves by one cell over that distance."""
    apart = np.abs(frame.parallax[pairs[:, 0]] - frame.parallax[pairs[:, 1]])  # [P, 2] cells per metre
    return max(PLANE_CELLS * frame.cell, 1.0 / float(np.linalg.norm(apart, axis=1).max()))


__all__ = ["PLANE_CELLS", "Match", "margin_for", "match"]

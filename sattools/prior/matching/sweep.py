"""One pass of the matching: agreement at all heights, aggregated, in blocks that fit into memory."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter

from sattools.errors import counted
from sattools.prior.frame import Frame
from sattools.prior.matching.penalties import penalties
from sattools.prior.options import PriorOptions
from sattools.prior.visibility.consistency import RayMinima, update_minima
from sattools.prior.visibility.occlusion import Visibility, dark_noise
from sattools.progress import Progress, silent

ROBUST_PAIRS = 30  # pairs from which on the mean over them is robust
FEW_PAIRS = 4  # the same in towns once a rough surface says what hides what; of three, one that is hidden would decide
BEYOND_PLANES = 2  # planes above the height range, at most (one below)
KEEP_PLANES = 3  # planes kept above and below what was found
REACH_M = 6.0  # distance within which heights of an earlier pass may turn out to be a cell's own
FAR_REACH_M = 10.0  # the same where few pairs made that pass, and all heights between them
NEAR_M = 4.0  # distance above and below them up to which heights are looked at again
STRAY = 30  # cells that may be wrong about it at either end
MANY_PLANES = 160  # from this number of heights on, blocks that look near their own ground save time
BLOCK = 384  # cells of such a block
LEAST_HIDDEN = 0.05  # weight, at least, of an image that does not see a place, in the mean that shows it
PLANES = np.empty((0, 0), np.float32)  # no surface to which heights are relative
VOLUMES_B = 12  # bytes of a cell and height: three volumes of single precision live at a time
OVERLAP = 32  # cells by which blocks overlap: paths of the aggregation forget where they came from over this distance


def planes(z_range: tuple[float, float], step: float) -> np.ndarray:
    """Heights ``[D]`` float64 [m] to try: one plane beyond either end, at least three."""
    count = max(3, math.ceil((z_range[1] - z_range[0]) / step - 1e-9) + 1 + BEYOND_PLANES)
    return z_range[0] - step + step * np.arange(count)


def narrow(heights: np.ndarray, z_range: tuple[float, float], margin: float, step: float) -> tuple[float, float]:
    """The part of a height range in which a surface was found.

    Args:
        heights: ``[N]`` heights of well-matched cells [m].
        z_range: lowest and highest height so far [m].
        margin: kept below and above [m].
        step: distance of the height planes [m]; the lowest stays one of them, so that neighbouring parts of an area
            look at the same heights.
    """
    if len(heights) < 10 * STRAY:
        return z_range
    ordered = np.partition(heights, (STRAY, -STRAY - 1))
    low, high = float(ordered[STRAY]) - margin, float(ordered[-STRAY - 1]) + margin
    return z_range[0] + max(0, math.floor((low - z_range[0]) / step)) * step, min(z_range[1], high)


def _blocks(shape: tuple[int, int], volume: int, planes_wanted: int, guided: bool) -> list[tuple[slice, slice]]:
    """Parts to match one after the other: all at once if memory allows and heights are few.

    Args:
        shape: (rows, columns) of the grid.
        volume: largest number of (cell, height) that fits in memory.
        planes_wanted: number of heights over the whole grid.
        guided: each block may look for its own heights, which pays where the ground itself rises and falls.
    """
    rows, cols = shape
    affordable = math.isqrt(max(volume // planes_wanted, 1))
    if affordable**2 >= rows * cols and not (guided and planes_wanted > MANY_PLANES):
        return [(slice(0, rows), slice(0, cols))]
    size = max(min(affordable - 2 * OVERLAP, BLOCK) if guided else affordable - 2 * OVERLAP, 2 * OVERLAP)
    high, wide = (math.ceil(n / math.ceil(n / size)) for n in shape)
    return [
        (slice(r, min(r + high, rows)), slice(c, min(c + wide, cols)))
        for r in range(0, rows, high)
        for c in range(0, cols, wide)
    ]


def volume_bytes(shape: tuple[int, int], count: int, limit_mb: float, guided: bool) -> float:
    """Bytes that a pass takes for agreements and costs of its largest block.

    Args:
        shape: (rows, columns) of the grid.
        count: of the heights over the whole grid.
        limit_mb: above which the grid is cut into blocks [MB].
        guided: see `_blocks`.
    """
    blocks = _blocks(shape, int(limit_mb * 1e6 / VOLUMES_B), count, guided)
    edges = [[min(part.stop - part.start + 2 * OVERLAP, n) for part, n in zip(block, shape)] for block in blocks]
    return float(VOLUMES_B * count * max(rows * cols for rows, cols in edges))


@dataclass(frozen=True)
class MatchTask:
    """What a pass of the matching is about.

    Attributes:
        frame: the views.
        pairs: ``[P, 2]`` indices of the views to correlate.
        z_range: lowest and highest height to try [m].
        step: distance of the height planes [m].
        options: see `PriorOptions`.
        robust: whether so many pairs decide that what one of them says by chance does not.
        hills: whether the ground rises and falls, 0 to 1.
        shares: per pair, how much it counts beside the others (0 to 1); empty = all alike.
        by_most: what most pairs agree about counts, not what some of them agree about best.
    """

    frame: Frame
    pairs: np.ndarray
    z_range: tuple[float, float]
    step: float
    options: PriorOptions
    robust: bool
    hills: float = 0.0
    shares: tuple[float, ...] = ()
    by_most: bool = False

    @property
    def pair_shares(self) -> np.ndarray:
        """The shares ``[P]`` float32."""
        return np.array(self.shares or (1.0,) * len(self.pairs), np.float32)


def sweep_blocks(
    task: MatchTask,
    visibility: Visibility,
    progress: Progress = silent,
    *,
    guide: np.ndarray | None = None,
    ceiling: np.ndarray | None = None,
    minima: RayMinima | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One pass over the whole grid.

    Args:
        task: what is matched.
        visibility: what is occluded and shaded.
        progress: told the share done.
        guide: ``[H, W]`` heights of an earlier pass [m]; blocks of a hilly area look only near them.
        ceiling: ``[H, W]`` heights above which nothing is looked for [m].
        minima: filled in, if given, with the best place on every ray.

    Returns:
        Height [m], score and uniqueness, each ``[H, W]`` float32 (see `Match`).
    """
    frame, step, margin = task.frame, task.step, task.frame.margin
    wanted = len(planes(task.z_range, step))
    blocks = _blocks(frame.shape, int(task.options.memory * 1e6 / VOLUMES_B), wanted, guide is not None)
    maps: tuple[np.ndarray, ...] = tuple(np.empty(frame.shape, np.float32) for _ in range(3))
    for k, (rows, cols) in enumerate(blocks):
        progress(
            k / len(blocks),
            f"matching {counted(len(task.pairs), 'pairs')} at up to {wanted} heights, cell {frame.cell:g} m",
        )
        top, left = max(0, rows.start - OVERLAP), max(0, cols.start - OVERLAP)
        bottom, right = min(frame.shape[0], rows.stop + OVERLAP), min(frame.shape[1], cols.stop + OVERLAP)
        near = task.z_range
        if guide is not None and len(blocks) > 1:
            near = narrow(guide[top:bottom, left:right].ravel(), near, KEEP_PLANES * step, step)
        window = (slice(None), slice(top, bottom + 2 * margin), slice(left, right + 2 * margin))
        shaded = (slice(None), slice(top, bottom), slice(left, right))
        # in memory's order, as the whole is: kernels would be compiled anew for parts of it
        images, masks, hit, shadow = (
            np.ascontiguousarray(array[part])
            for array, part in (
                (frame.images, window), (frame.masks, window), (visibility.first_hit_height, window),
                (visibility.shadow_height, shaded),
            )
        )  # fmt: skip
        piece = replace(task, frame=replace(frame, images=images, masks=masks))
        inside = Visibility(hit, shadow, visibility.dark)
        heights = planes(near, step)
        near_block = (slice(top, bottom), slice(left, right))
        below = None if ceiling is None else ceiling[near_block]
        *new, total = sweep(piece, inside, heights, below, None if guide is None else guide[near_block])
        inner = (slice(rows.start - top, rows.stop - top), slice(cols.start - left, cols.stop - left))
        for whole, part in zip(maps, new, strict=True):
            whole[rows, cols] = part[inner]
        if minima is not None:
            corner = (margin + rows.start, margin + cols.start)
            update_minima(
                total[inner[0], :, inner[1]], frame.parallax, heights, frame.z_ref, *corner, minima.cost, minima.height
            )
    return maps[0], maps[1], maps[2]


def active_planes(
    heights: np.ndarray, guide: np.ndarray | None, shape: tuple[int, int], reach: int, margin: float
) -> np.ndarray:
    """Planes that are looked at in every tile of the kernel: those near a surface that is known roughly.

    Args:
        heights: ``[D]`` of the planes, evenly spaced [m].
        guide: ``[H, W]`` surface [m]; None = all planes everywhere.
        shape: (rows, columns) of the grid.
        reach: cells around a tile whose surface counts.
        margin: distance from the surface up to which planes are looked at [m].

    Returns:
        ``[h, w, D]`` bool. Between a street and the roofs beside it there may be planes near neither.
    """
    from sattools.prior.matching.kernels import TILE, TILE_COLS

    tiles = math.ceil(shape[0] / TILE), math.ceil(shape[1] / TILE_COLS)
    active = np.ones((*tiles, len(heights)), bool)
    if guide is None:
        return active
    step = heights[1] - heights[0]
    first = np.clip(np.floor((guide - margin - heights[0]) / step), 0, len(heights) - 1).astype(np.intp)
    end = np.clip(np.ceil((guide + margin - heights[0]) / step) + 1, 1, len(heights)).astype(np.intp)
    for i, j in np.ndindex(tiles):
        rows = slice(max(0, i * TILE - reach), (i + 1) * TILE + reach)
        cols = slice(max(0, j * TILE_COLS - reach), (j + 1) * TILE_COLS + reach)
        begun, ended = (np.bincount(at[rows, cols].ravel(), minlength=len(heights) + 1) for at in (first, end))
        active[i, j] = np.cumsum(begun - ended)[:-1] > 0
    return active


def sweep(
    task: MatchTask,
    visibility: Visibility,
    heights: np.ndarray,
    ceiling: np.ndarray | None = None,
    guide: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Correlate at all heights, aggregate, choose.

    Args:
        task: what is matched.
        visibility: what is occluded and shaded.
        heights: ``[D]`` float64 to try [m].
        ceiling: ``[H, W]`` heights above which nothing is looked for [m].
        guide: ``[H, W]`` heights near which they are looked for [m]; None = everywhere.

    Returns:
        height [m], score in [0, 1], uniqueness: ``[H, W]`` float32 (see `Match`); aggregated cost ``[H, D, W]``.
    """
    from sattools.prior.matching.sgm import aggregate, lowest, second_best_margin

    options = task.options
    reach = math.ceil((REACH_M if task.robust else FAR_REACH_M) / task.frame.cell)
    active = active_planes(heights, guide, task.frame.shape, reach, max(KEEP_PLANES * task.step, NEAR_M))
    if not task.robust:
        active = np.logical_or.accumulate(active, -1) & np.logical_or.accumulate(active[..., ::-1], -1)[..., ::-1]
    volume = agreement(task, visibility, heights, active=active)
    if ceiling is not None:
        for row in np.flatnonzero((ceiling < heights[-1]).any(axis=1)):  # where there is a courtyard at all
            volume[row][heights[:, None] > ceiling[row]] = 0
    look = looks_at(task, visibility, heights, active) if options.edges else np.zeros_like(volume)
    total = np.empty_like(volume)
    aggregate(volume, look, penalties(options, len(task.pairs), task.hills), total)
    height = np.empty(task.frame.shape, np.float32)
    index = np.empty(task.frame.shape, np.int32)
    lowest(total, heights, height, index)
    score = np.take_along_axis(volume, index[:, None].astype(np.int64), axis=1)[:, 0]
    gap = np.empty(task.frame.shape, np.float32)
    second_best_margin(total, index, gap)
    return height, np.clip(score, 0, 1), gap / 8, total


def agreement(
    task: MatchTask,
    visibility: Visibility,
    heights: np.ndarray,
    base: np.ndarray = PLANES,
    active: np.ndarray | None = None,
) -> np.ndarray:
    """Agreement of the views at every cell and height (see `kernels.correlate`).

    Args:
        task: what is matched.
        visibility: what is occluded and shaded.
        heights: ``[D]`` float64 [m].
        base: surface to which the heights are relative, ``[H + 2 window, W + 2 window]`` [m]; empty = none.
        active: planes to look at, see `active_planes`; None = all.

    Returns:
        ``[H, D, W]`` float32, at most 1.
    """
    from sattools.prior.matching.kernels import correlate

    frame, options = task.frame, task.options
    shadow_noise = dark_noise(frame, visibility.dark, options.brightness / 2, options.noise)
    if active is None:
        active = active_planes(heights, None, frame.shape, 0, 0.0)
    volume = np.empty((frame.shape[0], len(heights), frame.shape[1]), np.float32)
    correlate(
        frame.images, frame.masks, frame.view_weights, frame.parallax, heights, base, frame.z_ref,
        visibility.first_hit_height, visibility.shadow_height, visibility.dark, options.tolerance, task.pairs,
        task.pair_shares, options.window, options.noise, shadow_noise, options.brightness, frame.margin,
        np.float32(options.unseen), *pair_weights(task), active, volume,
    )  # fmt: skip
    return volume


def looks_at(task: MatchTask, visibility: Visibility, heights: np.ndarray, active: np.ndarray) -> np.ndarray:
    """What the images of a task show on average, ``[H, D, W]`` float32.

    Args:
        task: what is matched.
        visibility: what is occluded.
        heights: ``[D]`` of the planes [m].
        active: ``[h, w, D]`` bool, planes that are looked at in every tile; the tiles around one look at them, too, as
            a step between two tiles is a change from one to the other.
    """
    from sattools.prior.matching.look import mean_look

    frame, options = task.frame, task.options
    look = np.empty((frame.shape[0], len(heights), frame.shape[1]), np.float32)
    mean_look(
        frame.images, frame.masks, frame.view_weights, frame.parallax, heights, frame.z_ref,
        visibility.first_hit_height, options.tolerance, np.float32(max(options.weak, LEAST_HIDDEN)), frame.margin,
        maximum_filter(active, (3, 3, 1)), look,
    )  # fmt: skip
    return look


def pair_weights(task: MatchTask) -> tuple[int, np.float32, np.float32]:
    """Half the exponent of the mean over the pairs, weight of hidden views, and of pairs in different light.

    Many pairs outvote what the surface of an earlier pass got wrong. Among fewer, one that agrees by chance would
    decide before it is known what hides what, so there the mean is a root mean square, and among three, or on hills,
    where little is hidden, the hidden pair would: there it is one of what is surely seen.
    """
    weak, mixed = np.float32(task.options.weak), np.float32(task.options.mixed)
    if task.robust and not task.by_most:
        return 3, weak, mixed
    if len(task.pairs) < FEW_PAIRS or task.hills > 0:
        return 1, np.float32(0), np.float32(0)
    return 1, weak, mixed


__all__ = [
    "BEYOND_PLANES",
    "FEW_PAIRS",
    "KEEP_PLANES",
    "ROBUST_PAIRS",
    "MatchTask",
    "agreement",
    "narrow",
    "pair_weights",
    "planes",
    "sweep",
    "sweep_blocks",
    "volume_bytes",
]

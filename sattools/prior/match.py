"""Multi-view matching on the ground grid: images on a frame go in, heights and their evidence come out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import grey_erosion, median_filter, minimum_filter

from sattools.prior.edges import sharpen
from sattools.prior.frame import Frame
from sattools.prior.options import PriorOptions
from sattools.progress import Progress, part, silent

UNKNOWN = -1e9  # first hit of a ray when nothing is known about the surface: everything is seen
SURE = 0.5  # agreement above which a cell of the first pass says where the surface lies
STRAY = 30  # cells that may be wrong about it at either end
MANY_PAIRS = 60  # pairs for which the penalty of a height jump is meant
BEYOND_PLANES = 2  # planes above the height range, at most (one below)
KEEP_PLANES = 3  # planes kept above and below what was found
SETTLED = 0.002  # share of cells that may still change when the rough passes stop
MANY_PLANES = 160  # from this number of heights on, blocks that look near their own ground save time
BLOCK = 384  # cells of such a block
SMOOTH = 3  # cells of the median filter that ends it all
OVERLAP = 32  # cells by which blocks overlap: paths of the aggregation forget where they came from over this distance


@dataclass(frozen=True)
class Match:
    """What matching found on the grid.

    Attributes:
        height: ``[H, W]`` float32 [m].
        score: ``[H, W]`` float32 agreement of the images there, in [0, 1].
        rival: ``[H, W]`` float32 aggregated cost, per path, by which the best height two planes away or more is dearer.
        views: ``[H, W]`` uint8 number of images that see the surface there.
    """

    height: np.ndarray
    score: np.ndarray
    rival: np.ndarray
    views: np.ndarray


@dataclass(frozen=True)
class Hidden:
    """What a surface hides from the views and from their suns.

    Attributes:
        hits: ``[V, Hf, Wf]`` float32 height at which the ray through a frame position first meets it [m].
        shades: ``[V, H, W]`` float32 height below which a point over a cell lies in shadow [m].
    """

    hits: np.ndarray
    shades: np.ndarray

    def doubled(self) -> Hidden:
        """The same on cells of half the size."""
        return Hidden(*(a.repeat(2, axis=1).repeat(2, axis=2) for a in (self.hits, self.shades)))


def nothing_hidden(frame: Frame) -> Hidden:
    """Everything is seen and lit."""
    hits = np.full(frame.images.shape, UNKNOWN, np.float32)
    return Hidden(hits, np.full((len(hits), *frame.shape), UNKNOWN, np.float32))


def margin_for(slopes: np.ndarray, z_ref: float, z_range: tuple[float, float], window: int) -> int:
    """Margin in cells, even, so that no point within the heights leaves the frame with its window."""
    reach = max(abs(z_range[0] - z_ref), abs(z_range[1] - z_ref))
    cells = math.ceil(float(np.abs(slopes).max()) * reach) + 2 * window + 4
    return cells + cells % 2


def planes(z_range: tuple[float, float], step: float) -> np.ndarray:
    """Heights ``[D]`` float64 to try: one plane beyond either end, at least three."""
    count = max(3, math.ceil((z_range[1] - z_range[0]) / step - 1e-9) + 1 + BEYOND_PLANES)
    return z_range[0] - step + step * np.arange(count)


def match(
    frame: Frame, pairs: np.ndarray, z_range: tuple[float, float], options: PriorOptions, progress: Progress = silent
) -> Match:
    """Find the surface: rough passes settle what hides what, a last one the heights.

    Args:
        frame: the views; at least two.
        pairs: ``[P, 2]`` indices of the views to correlate.
        z_range: lowest and highest height [m].
        options: see `PriorOptions`.
        progress: told the share done.
    """
    images = frame.images - np.float32(frame.images[frame.masks > 0].mean())
    size = 2 * options.window + 1
    masks = np.stack([minimum_filter(mask, size, mode="nearest") for mask in frame.masks])
    fine = Frame(images, masks, frame.slopes, frame.z_ref, frame.cell, frame.margin, frame.suns)
    step = options.step or plane_distance(frame, pairs)
    # the first surface is known to the planes of the rough passes: what is nearer must not count as hidden
    options = replace(options, tolerance=max(options.tolerance, 2 * step))
    # the kernels test no bounds: the highest and lowest planes of the roughest pass must stay within the frame
    beyond = 2 * BEYOND_PLANES * step
    reached = (z_range[0] - beyond, z_range[1] + beyond)
    fine = fine.widened(margin_for(fine.slopes, fine.z_ref, reached, options.window))
    hidden = nothing_hidden(fine)
    guide = None
    if options.rough_passes:
        rough = fine.halved()
        seen = nothing_hidden(rough)
        before = None
        for k in range(options.rough_passes):
            progress(0.4 * k / options.rough_passes, f"rough pass {k + 1} of {options.rough_passes}")
            surface, score, _ = _in_blocks(rough, seen, pairs, z_range, 2 * step, options, silent, before)
            surface = median_filter(surface, 3, mode="nearest")
            if k == 0:
                z_range = narrow(surface[score > SURE], z_range, KEEP_PLANES * 2 * step, 2 * step)
            _hide(rough, surface, z_range, options, seen)
            if before is not None and np.mean(np.abs(surface - before) > step) < SETTLED:
                break
            before = surface
        hidden = seen.doubled()
        guide = surface.repeat(2, axis=0).repeat(2, axis=1)
    last = part(progress, 0.4, 1.0)
    height, score, rival = _in_blocks(fine, hidden, pairs, z_range, step, options, last, guide)
    height = median_filter(height, SMOOTH, mode="nearest")
    if options.edges:
        height = sharpen(fine, hidden.hits, height, options.tolerance, options.edges)
    return Match(height, score, rival, seeing(fine, hidden.hits, height, options.tolerance))


def plane_distance(frame: Frame, pairs: np.ndarray) -> float:
    """Distance of the height planes [m]: two cells, or more where no pair moves by one cell over that distance."""
    apart = np.abs(frame.slopes[pairs[:, 0]] - frame.slopes[pairs[:, 1]])  # [P, 2] cells per metre
    return max(2 * frame.cell, 1.0 / float(np.linalg.norm(apart, axis=1).max()))


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


def _hide(
    frame: Frame, surface: np.ndarray, z_range: tuple[float, float], options: PriorOptions, hidden: Hidden
) -> None:
    """Fill in what the surface hides and shades, thinned: matching makes its edges too wide."""
    from sattools.prior.kernels import first_hits, shade_heights

    thin = grey_erosion(surface, footprint=disk(options.erode / frame.cell), mode="nearest")
    wide = np.pad(thin, frame.margin, mode="edge")
    first_hits(wide, frame.slopes, frame.z_ref, z_range[1] + 1.0, z_range[0] - 1.0, hidden.hits)
    for sun, shade in zip(frame.suns, hidden.shades, strict=True):
        if sun is not None:
            shade_heights(thin, np.array(sun), frame.cell, float(thin.max()), shade)


def disk(radius: float) -> np.ndarray:
    """Boolean footprint of all cells whose centre lies within the radius [cells]."""
    n = math.floor(radius)
    y, x = np.mgrid[-n : n + 1, -n : n + 1]
    return x * x + y * y <= radius * radius


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


def _in_blocks(
    frame: Frame,
    hidden: Hidden,
    pairs: np.ndarray,
    z_range: tuple[float, float],
    step: float,
    options: PriorOptions,
    progress: Progress,
    guide: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One pass over the whole grid: height, score and rival ``[H, W]``.

    Args:
        guide: ``[H, W]`` heights of an earlier pass [m]; blocks of a hilly area look only near them.
    """
    wanted = len(planes(z_range, step))
    # two volumes of single precision live at a time
    blocks = _blocks(frame.shape, int(options.memory * 1e6 / 8), wanted, guide is not None)
    found: tuple[np.ndarray, ...] = tuple(np.empty(frame.shape, np.float32) for _ in range(3))
    for k, (rows, cols) in enumerate(blocks):
        progress(k / len(blocks), f"matching {len(pairs)} pairs at up to {wanted} heights, cell {frame.cell:g} m")
        top, left = max(0, rows.start - OVERLAP), max(0, cols.start - OVERLAP)
        bottom, right = min(frame.shape[0], rows.stop + OVERLAP), min(frame.shape[1], cols.stop + OVERLAP)
        near = z_range
        if guide is not None and len(blocks) > 1:
            near = narrow(guide[top:bottom, left:right].ravel(), z_range, KEEP_PLANES * step, step)
        window = (slice(None), slice(top, bottom + 2 * frame.margin), slice(left, right + 2 * frame.margin))
        piece = replace(frame, images=frame.images[window], masks=frame.masks[window])
        inside = Hidden(hidden.hits[window], hidden.shades[:, top:bottom, left:right])
        new = sweep(piece, inside, pairs, planes(near, step), options)
        for whole, part_found in zip(found, new, strict=True):
            inner = (slice(rows.start - top, rows.stop - top), slice(cols.start - left, cols.stop - left))
            whole[rows, cols] = part_found[inner]
    return found[0], found[1], found[2]


def sweep(
    frame: Frame, hidden: Hidden, pairs: np.ndarray, heights: np.ndarray, options: PriorOptions
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correlate at all heights, aggregate, choose.

    Returns:
        height [m], score in [0, 1] and rival, each ``[H, W]`` float32 (see `Match`).
    """
    from sattools.prior.kernels import correlate
    from sattools.prior.sgm import aggregate, lowest, rival

    volume = np.empty((*frame.shape, len(heights)), np.float32)
    correlate(
        frame.images, frame.masks, frame.slopes, heights, frame.z_ref, hidden.hits, hidden.shades, options.tolerance,
        pairs,
        options.window, options.noise, options.brightness, frame.margin, np.float32(options.unseen), volume,
    )  # fmt: skip
    total = np.empty_like(volume)
    aggregate(volume, np.float32(options.small_jump), np.float32(options.large_jump * scarcity(len(pairs))), total)
    height = np.empty(frame.shape, np.float32)
    index = np.empty(frame.shape, np.int64)
    lowest(total, heights, height, index)
    score = np.take_along_axis(volume, index[..., None], axis=2)[..., 0]
    gap = np.empty(frame.shape, np.float32)
    rival(total, index, gap)
    return height, np.clip(score, 0, 1), gap / 8


def scarcity(pairs: int) -> float:
    """Factor of the penalty for height jumps: agreement is an average, and so the noisier the fewer pairs there are."""
    return min(max(math.sqrt(MANY_PAIRS / max(pairs, 1)), 1.0), 4.0)


def seeing(frame: Frame, hits: np.ndarray, height: np.ndarray, tolerance: float) -> np.ndarray:
    """Number of views ``[H, W]`` uint8 that see the surface at every cell."""
    rows, cols = np.indices(frame.shape)
    count = np.zeros(frame.shape, np.uint8)
    last = np.array(frame.images.shape[1:]) - 1
    for slope, mask, hit in zip(frame.slopes, frame.masks, hits, strict=True):
        dz = height - frame.z_ref
        r = np.clip(np.rint(rows + frame.margin + slope[0] * dz).astype(int), 0, last[0])
        c = np.clip(np.rint(cols + frame.margin + slope[1] * dz).astype(int), 0, last[1])
        count += (mask[r, c] > 0) & (hit[r, c] <= height + tolerance)
    return count


__all__ = ["Frame", "Match", "margin_for", "match", "planes", "seeing", "sweep"]

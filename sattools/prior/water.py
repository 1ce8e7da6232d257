"""Water with waves: no two images show the same of it, and what matching finds there is lumps, metres high.

A wide region in which the images agree nowhere, and whose heights are rough, says nothing. Where each image shows it in
one brightness, and ground that is level and surely matched lies beside, it is laid level with the lowest of that, and
its confidence is 0. What is surely matched within it, as piers and boats at anchor are, stays. The brightness tells
water from shade and gloss, about which few images agree as little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.ndimage import binary_dilation, find_objects, label, uniform_filter

from sattools.scene.stored import map_like, pieces

BLOCK_M = 4.0  # edge of the blocks that are looked at
CORE = 0.08  # mean confidence of a square of 5 blocks, up to which nothing of it has been matched
UNMATCHED = 0.3  # of what looks like water, at least, is so
SHOWN = 0.5  # of the images show it, more than that share
FEW_PAIRS = 12  # with fewer pairs of images, which are sure of less, the same three are:
FEW_CORE, FEW_UNMATCHED, FEW_SHOWN = 0.04, 0.5, 0.49  # two of four, where glare is masked in the others
AROUND = 2.0  # times that, of a square of 3 blocks, up to which it belongs to such a place beside it
SURE = 0.25  # confidence of a cell, from which on it has been matched
TOGETHER, TOGETHER_M = 0.4, 4.0  # share of the cells of a square of that edge that are sure where anything is
BESIDE_M = 2.0  # around what is sure: the walls of what stands at the water, of which matching is never sure
LEAST_M2 = 800.0  # of a region: a lake or a river, no courtyard
ROUGH_M = 1.0  # mean standard deviation of its heights in squares of 3 blocks, at least
RIMS = 2, 4, 6  # blocks around it in which its shore may be: the first of these in which there is one
FEWEST = 15  # sure blocks of a shore
LOW = 10  # per cent of these, which are at most as high as water
LEVEL_M, LEVEL_SHARE = 3.0, 0.5  # so many of them lie so close above that: 53 to 100 % of shores', 11 to 33 % of hills'
PLAIN = 0.15  # of the brightness is its standard deviation among 3 by 3 blocks, at most, in half of the images
TILE = 128  # blocks along an edge of what is looked at together: over kilometres glint makes water lighter and darker
ALIKE = 0.4  # of its median are all blocks' 80 % in the middle wide, at most: water 0.01 to 0.33, all else 0.33 to 2

Box = tuple[slice, slice]
Looks = Callable[[slice, slice, float], np.ndarray]  # of these blocks at a height [m]: brightness ``[V, h, w]``


def block_of(cell: float) -> int:
    """Cells along an edge of the blocks that are looked at, of cells with that edge [m]."""
    return max(1, round(BLOCK_M / cell))


def level_water(height: np.ndarray, confidence: np.ndarray, cell: float, looks: Looks, pairs: int) -> np.ndarray:
    """Lay level what has not been matched and looks like water.

    Args:
        height: ``[H, W]`` matched [m], to be read and written by rows; changed.
        confidence: ``[H, W]`` of it, 0 ... 1; the same.
        cell: edge of a cell [m].
        looks: how the images show blocks of `block_of` cells.
        pairs: of images that were matched.

    Returns:
        ``[H, W]`` uint8, 1 = was laid level; a map as that of the heights.
    """
    water = map_like(height, (height.shape[0], height.shape[1]), np.uint8)
    size = block_of(cell)
    shape = height.shape[0] // size, height.shape[1] // size
    if min(shape) < 5:
        return water
    means = np.zeros((5, *shape))
    for rows, blocks in _bands(shape, size):
        own, doubt = height[rows, : shape[1] * size], confidence[rows, : shape[1] * size]
        sure = doubt >= SURE
        for total, values in zip(means, (doubt, own, np.square(own, dtype=np.float64), sure, sure * own), strict=True):
            total[blocks] = values.reshape(-1, size, shape[1], size).mean(axis=(1, 3), dtype=np.float64)
    levels = water_levels(means, size * cell, looks, few=pairs < FEW_PAIRS)
    if not np.isfinite(levels).any():
        return water
    # what makes no whole block along two edges is as the block beside it
    of_row, of_col = (np.minimum(np.arange(n) // size, count - 1) for n, count in zip(water.shape, shape, strict=True))
    for rows, blocks in _bands(shape, size):
        if blocks.stop == shape[0]:
            rows = slice(rows.start, water.shape[0])
        level = levels[of_row[rows]][:, of_col]
        own, doubt = np.array(height[rows]), np.array(confidence[rows])
        first = max(0, rows.start - 2 * size)  # what is sure stays so where rows above have been laid level
        something = _stands_there(confidence[first : rows.stop + 2 * size], cell)
        laid = np.isfinite(level) & ~something[rows.start - first :][: len(own)]
        own[laid], doubt[laid] = level[laid], 0.0
        height[rows], confidence[rows] = own, doubt
        water[rows] = laid
    return water


def _stands_there(confidence: np.ndarray, cell: float) -> np.ndarray:
    """Cells ``[H, W]`` bool where something has surely been matched, or close beside it."""
    sure = confidence >= SURE
    together = uniform_filter(sure.astype(np.float32), max(1, round(TOGETHER_M / cell)), mode="nearest") > TOGETHER
    steps = max(1, round(BESIDE_M / cell))
    return np.asarray(binary_dilation(together, iterations=steps))


def water_levels(blocks: np.ndarray, edge: float, looks: Looks, *, few: bool = False) -> np.ndarray:
    """The level of what looks like water, ``[h, w]`` [m]; NaN elsewhere.

    Args:
        blocks: ``[5, h, w]`` means over blocks of cells: of the confidence, the heights [m], their squares, whether
            a cell has surely been matched, and its height [m] where it has, else 0.
        edge: of a block [m].
        looks: how the images show them.
        few: fewer than `FEW_PAIRS` pairs of images were matched.
    """
    confidence, height, square, sure, found = blocks
    core, least_core, shown = (FEW_CORE, FEW_UNMATCHED, FEW_SHOWN) if few else (CORE, UNMATCHED, SHOWN)
    levels = np.full(height.shape, np.nan, np.float32)
    unmatched = uniform_filter(confidence, 5, mode="nearest") < core
    regions, _ = label(unmatched | (uniform_filter(confidence, 3, mode="nearest") < AROUND * core))
    mean = uniform_filter(height, 3, mode="nearest")
    spread = np.sqrt(np.maximum(uniform_filter(square, 3, mode="nearest") - mean * mean, 0.0))
    least = LEAST_M2 / (edge * edge)
    for number, box in enumerate(find_objects(regions), 1):
        wide = _widened(box, height.shape)
        region = regions[wide] == number
        if region.sum() < least or (unmatched[wide] & region).sum() < least_core * least:
            continue
        known = np.where(region, 0.0, sure[wide])
        shore = _shore(region, known, found[wide])
        if not len(shore):
            continue
        parts = _plain_parts(region, looks, wide, float(np.percentile(shore, LOW)), shown)
        for k, inner in enumerate(find_objects(parts), 1):
            near = _widened(inner, region.shape)
            # what lies beside the rim of water is no longer plain, and yet water
            part = binary_dilation(parts[near] == k) & region[near]
            own = _placed(near, wide)
            open_water = part & unmatched[own]
            if part.sum() < least or open_water.sum() < least_core * part.sum() or spread[own][part].mean() < ROUGH_M:
                continue
            shore = _shore(part, known[near], found[own])
            if len(shore) < FEWEST:
                continue
            level = float(np.percentile(shore, LOW))
            if np.mean(shore < level + LEVEL_M) >= LEVEL_SHARE and _alike(open_water, looks, own, level):
                levels[own][part] = level
    return levels


def _widened(box: Sequence[slice], shape: Sequence[int], edge: int = RIMS[-1]) -> Box:
    """A box with so many blocks around it, among which its shore is."""
    rows, cols = (slice(max(0, p.start - edge), min(p.stop + edge, count)) for p, count in zip(box, shape, strict=True))
    return rows, cols


def _shore(region: np.ndarray, sure: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Heights [m] of the sure blocks beside a region: in a wider rim where there are few."""
    for rim in RIMS:
        beside = binary_dilation(region, iterations=rim) & ~region & (sure > 0.5)
        if beside.sum() >= FEWEST:
            break
    return np.asarray(found[beside] / sure[beside])


def _plain_parts(region: np.ndarray, looks: Looks, box: Box, level: float, least: float) -> np.ndarray:
    """What of a region ``[h, w]`` more than that share of the images show, without contrast: numbers of its parts."""
    plain = np.zeros(region.shape, bool)
    for rows, cols in _tiles(region):
        around = _widened((rows, cols), region.shape, 1)  # for the contrast of blocks at the border
        seen = looks(*_placed(around, box), level)
        valid = np.isfinite(seen)
        shown = np.where(valid, seen, 0.0).astype(np.float64)
        share, value, square = (uniform_filter(x, (0, 3, 3), mode="nearest") for x in (valid * 1.0, shown, shown**2))
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = value / share
            contrast = np.sqrt(np.maximum(square / share - mean * mean, 0.0)) / mean
        inside = slice(rows.start - around[0].start, None), slice(cols.start - around[1].start, None)
        found = (_median(np.where(valid, contrast, np.nan), least) < PLAIN)[inside]
        plain[rows, cols] = found[: rows.stop - rows.start, : cols.stop - cols.start]
    parts, _ = label(region & plain)
    return np.asarray(parts)


def _alike(blocks: np.ndarray, looks: Looks, box: Box, level: float) -> bool:
    """Whether each image shows blocks ``[h, w]`` bool of a box in one brightness, in half of its tiles at least."""
    count = 0
    for tile in _tiles(blocks):
        seen = looks(*_placed(tile, box), level)[:, blocks[tile]]
        shown = seen[np.isfinite(seen).mean(axis=1) > 0.5]
        if len(shown) < max(2, len(seen) / 2):
            continue
        low, middle, high = np.nanpercentile(shown, (10, 50, 90), axis=1)
        if np.median((high - low) / np.maximum(middle, 1e-9)) <= ALIKE:
            count += int(blocks[tile].sum())
    return count >= 0.5 * int(blocks.sum())


def _tiles(blocks: np.ndarray) -> Iterator[Box]:
    """Tiles of an array in which any block is one of these, some at a time."""
    rows, cols = blocks.shape
    for top in range(0, rows, TILE):
        for left in range(0, cols, TILE):
            tile = slice(top, min(top + TILE, rows)), slice(left, min(left + TILE, cols))
            if blocks[tile].any():
                yield tile


def _placed(inner: Box, outer: Box) -> Box:
    """A part of a box as part of what the box is of."""
    rows, cols = (slice(b.start + a.start, b.start + a.stop) for a, b in zip(inner, outer, strict=True))
    return rows, cols


def _median(values: np.ndarray, least: float) -> np.ndarray:
    """Of the known among the first axis, where these are two, and more than that share of all; else infinite."""
    known = np.isfinite(values).sum(axis=0)
    ordered = np.sort(values, axis=0)  # NaN last
    middle = np.take_along_axis(ordered, np.maximum(known - 1, 0)[None] // 2, axis=0)[0]
    return np.where((known >= 2) & (known > least * len(values)), middle, np.inf)


def _bands(shape: tuple[int, int], size: int) -> Iterator[tuple[slice, slice]]:
    """Rows of cells, and the rows of blocks that these are, some at a time."""
    for blocks in pieces((shape[0], shape[1] * size * size)):
        yield slice(blocks.start * size, blocks.stop * size), blocks


__all__ = ["SURE", "Looks", "block_of", "level_water", "water_levels"]

"""Water with waves: no two images show the same of it, and what matching finds there is lumps, metres high.

A wide region in which the images agree nowhere, and whose heights are rough, says nothing. Where ground that is level
and surely matched lies beside it, it is laid level with the lowest of that, and its confidence is 0, so that
`validity` has it as filled. What is surely matched within it, as piers and boats at anchor are, stays.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import binary_dilation, find_objects, label, uniform_filter

from sattools.scene.stored import pieces

BLOCK_M = 4.0  # edge of the blocks that are looked at
CORE = 0.06  # mean confidence of a square of 5 blocks, up to which nothing of it has been matched
AROUND = 0.12  # mean confidence of a square of 3 blocks, up to which it belongs to such a place beside it
SURE = 0.25  # confidence of a cell, from which on it has been matched
TOGETHER, TOGETHER_M = 0.4, 4.0  # share of the cells of a square of that edge that are sure where anything is
BESIDE_M = 2.0  # around what is sure: the walls of what stands at the water, of which matching is never sure
LEAST_M2 = 800.0  # of a region: a lake or a river, no courtyard
ROUGH_M = 1.0  # mean standard deviation of its heights in squares of 3 blocks, at least
RIM = 2  # blocks around a region that may be its shore
FEWEST = 20  # sure blocks of a shore
LOW = 10  # per cent of these, which are at most as high as water
LEVEL_M, LEVEL_SHARE = 3.0, 0.5  # so many of them lie so close above that: 62 to 100 % of shores', 11 to 33 % of hills'


def level_water(height: np.ndarray, confidence: np.ndarray, cell: float) -> float:
    """Lay level what has not been matched and looks like water; its share of the cells.

    Args:
        height: ``[H, W]`` matched [m], to be read and written by rows; changed.
        confidence: ``[H, W]`` of it, 0 ... 1; the same.
        cell: edge of a cell [m].
    """
    size = max(1, round(BLOCK_M / cell))
    shape = height.shape[0] // size, height.shape[1] // size
    if min(shape) < 2 * RIM + 1:
        return 0.0
    means = np.zeros((5, *shape))
    for rows, blocks in _bands(shape, size):
        own, doubt = height[rows, : shape[1] * size], confidence[rows, : shape[1] * size]
        sure = doubt >= SURE
        for total, values in zip(means, (doubt, own, np.square(own, dtype=np.float64), sure, sure * own), strict=True):
            total[blocks] = values.reshape(-1, size, shape[1], size).mean(axis=(1, 3), dtype=np.float64)
    levels = water_levels(means, size * cell)
    if not np.isfinite(levels).any():
        return 0.0
    count = 0
    for rows, blocks in _bands(shape, size):
        level = np.repeat(np.repeat(levels[blocks], size, axis=0), size, axis=1)
        own, doubt = np.array(height[rows, : level.shape[1]]), np.array(confidence[rows, : level.shape[1]])
        first = max(0, rows.start - 2 * size)  # what is sure stays so where rows above have been laid level
        something = stands_there(confidence[first : rows.stop + 2 * size, : level.shape[1]], cell)
        laid = np.isfinite(level) & ~something[rows.start - first :][: len(own)]
        own[laid], doubt[laid] = level[laid], 0.0
        height[rows, : level.shape[1]], confidence[rows, : level.shape[1]] = own, doubt
        count += int(laid.sum())
    return count / (height.shape[0] * height.shape[1])


def stands_there(confidence: np.ndarray, cell: float) -> np.ndarray:
    """Cells ``[H, W]`` bool where something has surely been matched, or close beside it."""
    sure = confidence >= SURE
    together = uniform_filter(sure.astype(np.float32), max(1, round(TOGETHER_M / cell)), mode="nearest") > TOGETHER
    steps = max(1, round(BESIDE_M / cell))
    return np.asarray(binary_dilation(together, iterations=steps))


def water_levels(blocks: np.ndarray, edge: float) -> np.ndarray:
    """The level of what looks like water, ``[h, w]`` [m]; NaN elsewhere.

    Args:
        blocks: ``[5, h, w]`` means over blocks of cells: of the confidence, the heights [m], their squares, whether
            a cell has surely been matched, and its height [m] where it has, else 0.
        edge: of a block [m].
    """
    confidence, height, square, sure, found = blocks
    levels = np.full(height.shape, np.nan, np.float32)
    unmatched = uniform_filter(confidence, 5, mode="nearest") < CORE
    regions, _ = label(unmatched | (uniform_filter(confidence, 3, mode="nearest") < AROUND))
    mean = uniform_filter(height, 3, mode="nearest")
    spread = np.sqrt(np.maximum(uniform_filter(square, 3, mode="nearest") - mean * mean, 0.0))
    for number, box in enumerate(find_objects(regions), 1):
        # with the blocks around it, among which its shore is
        wide = tuple(slice(max(0, part.start - RIM), part.stop + RIM) for part in box)
        region = regions[wide] == number
        if not (unmatched[wide] & region).any() or region.sum() * edge * edge < LEAST_M2:
            continue
        beside = binary_dilation(region, iterations=RIM) & ~region & (sure[wide] > 0.5)
        shore = found[wide][beside] / sure[wide][beside]
        if len(shore) < FEWEST or spread[wide][region].mean() < ROUGH_M:
            continue
        level = np.percentile(shore, LOW)
        if np.mean(shore < level + LEVEL_M) >= LEVEL_SHARE:
            levels[wide][region] = level
    return levels


def _bands(shape: tuple[int, int], size: int) -> Iterator[tuple[slice, slice]]:
    """Rows of cells, and the rows of blocks that these are, some at a time."""
    for blocks in pieces((shape[0], shape[1] * size * size)):
        yield slice(blocks.start * size, blocks.stop * size), blocks


__all__ = ["level_water", "water_levels"]

"""Bring a predicted surface onto the reference: whole-pixel NCC, Nuth & Kääb, or height only.

All functions work on arrays, or maps that are read by rows (`sattools.scene.stored`), row 0 = north. A *margin* is a
number of cells by which the prediction reaches beyond the reference on every side, so that a shift moves real heights
in from outside, not holes.
A shift is what has to be added to the prediction: (east, north, up) in metres or (columns, rows) in cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sattools.errors import InputError, counted
from sattools.scene.stored import map_like, pieces

Method = Literal["ncc", "nuth-kaab", "z", "none"]
METHODS: tuple[Method, ...] = ("ncc", "nuth-kaab", "z", "none")

SEARCH_CELLS = 5  # half width of the search window on each pyramid level
STRIP_ROWS = 256  # rows of a map that are looked at in double precision at a time
SLOPES = 2_000_000  # cells whose slopes tell of parts of a cell: more would not make them more certain
BAND_ROWS = 16  # that are looked at together where not all are
STEPS, SECTORS = 20, 72  # most steps of Nuth and Kaab, and directions of slopes that it tells apart
COARSEST_CELLS = 100  # the pyramid ends when the smaller side has no more cells than this


@dataclass(frozen=True)
class Registration:
    """Shift to add to a prediction, in cells (columns east-, rows southward) and metres up."""

    columns: float
    rows: float
    up: float
    method: Method
    correlation: float | None = None
    """Zero-mean normalised cross-correlation at the shift found; None where none was computed."""
    peak: tuple[float, float] | None = None
    """Where the correlation around the shift peaks: (columns, rows) beyond its whole cells, within half a cell."""

    def metres(self, cell_size: float) -> tuple[float, float, float]:
        """Shift as (east, north, up) in metres."""
        return self.columns * cell_size, (-self.rows or 0.0) * cell_size, self.up  # no -0.0


def pyramid_levels(shape: tuple[int, int]) -> int:
    """Number of halvings until the smaller side of `shape` has at most 100 cells."""
    levels, side = 0, min(shape)
    while side > COARSEST_CELLS:
        side //= 2
        levels += 1
    return levels


def search_margin(shape: tuple[int, int]) -> int:
    """Cells by which the prediction should reach beyond a reference of `shape`: the largest shift that can be found.

    A multiple of the coarsest cell, so that the pyramids of both rasters stay aligned.
    """
    step: int = 2 ** pyramid_levels(shape)
    largest = SEARCH_CELLS * (2 * step - 1)
    return -(-largest // step) * step


def register(predicted: np.ndarray, reference: np.ndarray, method: Method = "ncc", margin: int = 0) -> Registration:
    """Find the shift that brings `predicted` [H + 2 margin, W + 2 margin] onto `reference` [H, W]; NaN = no height.

    `ncc`: whole-cell shift by multi-scale normalised cross-correlation, then the mean height difference;
    `nuth-kaab`: sub-cell shift by Nuth & Kääb (2011), doi:10.5194/tc-5-271-2011, eq. 2-3, then the mean difference;
    `z`: mean height difference only; `none`: nothing.
    Raises InputError where the two have no cell in common, or for an unknown method.

    Args:
        predicted: see above [m].
        reference: see above [m].
        method: how the shift is found.
        margin: cells by which the prediction reaches beyond the reference.
    """
    height, width = reference.shape
    if predicted.shape != (height + 2 * margin, width + 2 * margin):
        raise InputError(
            f"prediction: found shape {predicted.shape}, expected {reference.shape} plus {margin} cells all round"
        )
    if method not in METHODS:
        raise InputError(f"registration: found {method!r}, expected one of {', '.join(METHODS)}")
    if method == "none":
        return Registration(0.0, 0.0, 0.0, method)
    columns, rows, correlation, peak = 0.0, 0.0, None, None
    if method == "ncc":
        whole_rows, whole_columns, correlation, peak = _ncc_shift(predicted, reference, margin)
        columns, rows = float(whole_columns), float(whole_rows)
    elif method == "nuth-kaab":
        columns, rows = _nuth_kaab_shift(predicted, reference, margin)
    count, total = 0, 0.0
    for some in pieces((height, width)):
        difference = reference[some] - shifted(predicted, columns, rows, margin, some)
        difference = difference[np.isfinite(difference)]
        count, total = count + difference.size, total + float(difference.sum(dtype=np.float64))
    if not count:
        raise InputError("prediction: found no cell in common with the reference, expected overlap")
    return Registration(columns, rows, total / count, method, correlation, peak)


def shifted(
    predicted: np.ndarray,
    columns: float,
    rows: float,
    margin: int = 0,
    part: slice | None = None,
    *,
    beyond: bool = False,
) -> np.ndarray:
    """Cells of the reference [H, W] from `predicted` [H + 2 margin, W + 2 margin] moved by `columns` and `rows`.

    Whole shifts copy cells; others interpolate linearly. Cells that come from outside are NaN.

    Args:
        predicted: see above [m].
        columns: cells eastwards.
        rows: cells southwards.
        margin: cells by which the prediction reaches beyond the reference.
        part: rows of the reference; None = all.
        beyond: the border goes on outside instead.
    """
    part = part or slice(0, predicted.shape[0] - 2 * margin)
    row0, column0 = int(np.floor(rows)), int(np.floor(columns))
    weight_row, weight_column = rows - row0, columns - column0
    result: np.ndarray | None = None
    for row, row_weight in ((row0, 1 - weight_row), (row0 + 1, weight_row)):
        for column, column_weight in ((column0, 1 - weight_column), (column0 + 1, weight_column)):
            weight = row_weight * column_weight
            if weight > 0:
                moved = weight * _window(predicted, column, row, margin, part, beyond)
                result = moved if result is None else result + moved
    assert result is not None  # the four weights sum to one
    return result


def _ncc_shift(
    predicted: np.ndarray, reference: np.ndarray, margin: int = 0
) -> tuple[int, int, float, tuple[float, float]]:
    """Whole-cell shift (rows, columns) of largest zero-mean normalised cross-correlation, that, and where it peaks.

    From coarse (at most 100 cells a side) to fine, within ±5 cells of the coarser level's shift; cells that are NaN
    in either raster do not count. Where nothing correlates (a constant surface) the shift stays zero.

    Args:
        predicted: ``[H + 2 margin, W + 2 margin]`` heights [m].
        reference: ``[H, W]`` heights [m]; NaN = none.
        margin: cells by which the prediction reaches beyond the reference.
    """
    levels = pyramid_levels(reference.shape)
    step = 2**levels
    if margin % step:  # keep coarse cells of both rasters on one lattice
        pad = step - margin % step
        predicted, margin = _padded(predicted, pad), margin + pad
    pairs = [(predicted, reference)]
    for _ in range(levels):
        pairs.append((halved(pairs[-1][0]), halved(pairs[-1][1])))
    rows, columns, best, peak = 0, 0, 0.0, (0.0, 0.0)
    for level in range(levels, -1, -1):
        rows, columns = 2 * rows * (level < levels), 2 * columns * (level < levels)
        coarse_predicted, coarse_reference = pairs[level]
        rows, columns, best, peak = _search(coarse_predicted, coarse_reference, margin >> level, rows, columns)
    return rows, columns, best, peak


def halved(array: np.ndarray) -> np.ndarray:
    """Mean of the finite heights [m] of each 2×2 block [H // 2, W // 2], float64; NaN where a block has none."""
    height, width = array.shape[0] // 2, array.shape[1] // 2
    means = map_like(array, (height, width), np.float64)
    for rows in pieces((height, 4 * width), STRIP_ROWS):  # of which each is made of four
        part = array[2 * rows.start : 2 * rows.stop, : 2 * width].astype(np.float64)
        blocks = part.reshape(-1, 2, width, 2)
        finite = np.isfinite(blocks)
        count = finite.sum(axis=(1, 3))
        total = np.where(finite, blocks, 0.0).sum(axis=(1, 3))
        means[rows] = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return means


def _nuth_kaab_shift(predicted: np.ndarray, reference: np.ndarray, margin: int = 0) -> tuple[float, float]:
    """Sub-cell shift (columns, rows) after Nuth & Kääb (2011): dh / tan(slope) = a cos(b - aspect) + c.

    The height differences per aspect sector enter by their median, since height steps of a city are outliers to
    this model; iterated until the step is below 0.01 cell. Of large maps some rows are looked at, evenly spread. Raises
    InputError where the reference has no slopes.

    Args:
        predicted: ``[H + 2 margin, W + 2 margin]`` heights [m].
        reference: ``[H, W]`` heights [m]; NaN = none.
        margin: cells by which the prediction reaches beyond the reference.
    """
    parts = list(_some_rows((reference.shape[0], reference.shape[1])))
    gradient_row, gradient_column = (np.concatenate(g) for g in zip(*(_gradient(reference, part) for part in parts)))
    heights = np.concatenate([reference[part] for part in parts])
    slope = np.hypot(gradient_row, gradient_column)  # height per cell
    aspect = np.arctan2(-gradient_column, gradient_row)  # downhill direction, clockwise from north
    columns = rows = 0.0
    for _ in range(STEPS):
        moved = [shifted(predicted, columns, rows, margin, part) for part in parts]
        difference = np.concatenate(moved) - heights
        finite = np.isfinite(difference) & np.isfinite(slope)
        if not finite.any():
            raise InputError("prediction: found no cell in common with the reference, expected overlap")
        difference = difference - np.median(difference[finite])
        steepest = np.quantile(slope[finite], 0.98)  # steps between ground and roof, where the model does not hold
        spread = 1.4826 * np.median(np.abs(difference[finite]))
        use = finite & (slope > 0.02) & (slope <= steepest) & (np.abs(difference) <= 3 * spread + 1e-6)
        if use.sum() < 100:
            raise InputError(
                f"reference: found {counted(int(use.sum()), 'sloping cells')}, expected 100 or more for nuth-kaab"
            )
        step_columns, step_rows = _cosine_fit(difference[use] / slope[use], aspect[use])
        columns, rows = columns + step_columns, rows + step_rows
        if np.hypot(step_columns, step_rows) < 0.01:
            break
    return columns, rows


def _some_rows(shape: tuple[int, int]) -> Iterator[slice]:
    """Rows of which no more than about `SLOPES` cells are looked at; all of a small map."""
    height, width = shape
    few = math.ceil(height * width / SLOPES)
    if few == 1:
        yield slice(0, height)
        return
    for first in range(0, height, few * BAND_ROWS):
        yield slice(first, min(first + BAND_ROWS, height))


def _gradient(heights: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """Height per cell ``[h, W]`` southwards and eastwards in some rows."""
    first, last = max(0, rows.start - 1), min(heights.shape[0], rows.stop + 1)
    own = slice(rows.start - first, rows.stop - first)
    around = heights[first:last].astype(np.float64)
    south, east = np.gradient(around)[:2]
    return np.asarray(south)[own], np.asarray(east)[own]


def _cosine_fit(ratio: np.ndarray, aspect: np.ndarray) -> tuple[float, float]:
    """Shift (columns, rows) to add from dh / tan(slope) over aspect by sector medians and least squares."""
    sector = np.floor((aspect + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    angles, medians = [], []
    for number in range(SECTORS):
        values = ratio[sector == number]
        if values.size:
            angles.append((number + 0.5) / SECTORS * 2 * np.pi - np.pi)
            medians.append(np.median(values))
    angle = np.array(angles)
    design = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], axis=1)
    (north, east, _), *_ = np.linalg.lstsq(design, np.array(medians), rcond=None)
    # a slope that falls to the east shows positive differences where the prediction lies too far east
    return -float(east), float(north)


def _window(predicted: np.ndarray, columns: int, rows: int, margin: int, part: slice, beyond: bool) -> np.ndarray:
    """Part of `predicted` that falls on rows of the reference after a whole-cell shift."""
    width = predicted.shape[1] - 2 * margin
    top, left, height = margin - rows + part.start, margin - columns, part.stop - part.start
    if not beyond:
        return _box(predicted, top, left, height, width)
    row, col = (
        np.clip(np.arange(first, first + count), 0, most - 1)
        for first, count, most in zip((top, left), (height, width), predicted.shape, strict=True)
    )
    part_there = predicted[row[0] : row[-1] + 1, col[0] : col[-1] + 1]
    return part_there[np.ix_(row - row[0], col - col[0])]


def _padded(array: np.ndarray, pad: int) -> np.ndarray:
    """An array with so many more cells on every side, which are NaN."""
    height, width = array.shape[0] + 2 * pad, array.shape[1] + 2 * pad
    padded = map_like(array, (height, width), array.dtype)
    for rows in pieces((height, width)):
        padded[rows] = _box(array, rows.start - pad, -pad, rows.stop - rows.start, width)
    return padded


def _box(array: np.ndarray, top: int, left: int, height: int, width: int) -> np.ndarray:
    """Cells ``[height, width]`` of an array from a row and a column on, which may lie outside; NaN there."""
    row0, row1 = max(top, 0), min(top + height, array.shape[0])
    column0, column1 = max(left, 0), min(left + width, array.shape[1])
    if (row1 - row0, column1 - column0) == (height, width):
        return array[row0:row1, column0:column1]
    window = np.full((height, width), np.nan, dtype=array.dtype)
    if row0 < row1 and column0 < column1:
        window[row0 - top : row1 - top, column0 - left : column1 - left] = array[row0:row1, column0:column1]
    return window


def _search(
    predicted: np.ndarray, reference: np.ndarray, margin: int, rows: int, columns: int
) -> tuple[int, int, float, tuple[float, float]]:
    """Best whole-cell shift within ±5 cells of (rows, columns), its correlation and `Registration.peak`.

    Nearer shifts win ties.
    """
    height, width = reference.shape
    offsets = range(-SEARCH_CELLS, SEARCH_CELLS + 1)
    trials = sorted(((dr, dc) for dr in offsets for dc in offsets), key=lambda t: t[0] ** 2 + t[1] ** 2)
    centre_r, centre_p = _mean(reference), _mean(predicted)
    # of every trial: number of cells that both have, their sums, squares and products
    sums = np.zeros((len(trials), 6))
    left = margin - columns - SEARCH_CELLS
    for strip in pieces((height, width), STRIP_ROWS):
        top = margin - rows - SEARCH_CELLS + strip.start
        around = _box(predicted, top, left, strip.stop - strip.start + 2 * SEARCH_CELLS, width + 2 * SEARCH_CELLS)
        mask_r, value_r, square_r = _parts(reference[strip], centre_r)
        wide = _parts(around, centre_p)
        for trial, (dr, dc) in enumerate(trials):
            first_row, first_col = SEARCH_CELLS - dr, SEARCH_CELLS - dc
            box = (slice(first_row, first_row + len(mask_r)), slice(first_col, first_col + width))
            mask_p, value_p, square_p = (part[box] for part in wide)
            sums[trial] += (
                _dot(mask_r, mask_p), _dot(value_r, mask_p), _dot(mask_r, value_p), _dot(square_r, mask_p),
                _dot(mask_r, square_p), _dot(value_r, value_p),
            )  # fmt: skip
    scores = []
    for count, *totals in sums:
        if count < 2:
            scores.append((0.0, -np.inf))
            continue
        mean_r, mean_p, mean_rr, mean_pp, mean_rp = (total / count for total in totals)
        var_r, var_p = mean_rr - mean_r**2, mean_pp - mean_p**2
        flat = min(var_r, var_p) <= 1e-12
        scores.append((count, -np.inf if flat else (mean_rp - mean_r * mean_p) / np.sqrt(var_r * var_p)))
    # a small overlap correlates by chance: it needs half the cells of the largest one to count
    enough = 0.5 * max(count for count, _ in scores)
    # nearer shifts come first
    found = {trial: score for trial, (count, score) in zip(trials, scores, strict=True) if count >= enough}
    best, place = -np.inf, (0, 0)
    for shift, score in found.items():
        if score > best + 1e-12:
            best, place = score, shift
    peak = _peak([found.get((place[0] + k // 3 - 1, place[1] + k % 3 - 1), np.nan) for k in range(9)])
    return rows + place[0], columns + place[1], min(float(best), 1.0) if np.isfinite(best) else 0.0, peak


def _peak(scores: list[float]) -> tuple[float, float]:
    """Where a quadratic surface through the scores of 3 x 3 cells peaks: (columns, rows), within half a cell.

    (0, 0) where it has no peak, or a score is not known.
    """
    if not np.isfinite(scores).all():
        return 0.0, 0.0
    y, x = (part.ravel() for part in np.mgrid[-1:2, -1:2])
    design = np.stack([np.ones(9), x, y, x * x / 2, x * y, y * y / 2], axis=1)
    _, east, south, xx, xy, yy = np.linalg.lstsq(design, np.array(scores), rcond=None)[0]
    if xx >= -1e-12 or xx * yy - xy * xy <= 1e-24:
        return 0.0, 0.0
    column, row = np.linalg.solve([[xx, xy], [xy, yy]], [-east, -south]).clip(-0.5, 0.5)
    return float(column), float(row)


def _mean(array: np.ndarray) -> float:
    """Mean of what is finite; 0 where nothing is."""
    count, total = 0, 0.0
    for rows in pieces((array.shape[0], array.shape[1]), STRIP_ROWS):
        part = array[rows]
        known = part[np.isfinite(part)]
        count, total = count + known.size, total + float(known.sum(dtype=np.float64))
    return total / max(count, 1)


def _parts(array: np.ndarray, centre: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where an array is finite (1, else 0), what it is there less a centre (else 0), and the square of that."""
    known = np.isfinite(array)
    value = np.where(known, array.astype(np.float64) - centre, 0.0)
    return known.astype(np.float64), value, value**2


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.einsum("ij,ij->", a, b))

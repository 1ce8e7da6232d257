"""Bring a predicted surface onto the reference: whole-pixel NCC, Nuth & Kääb, or height only.

All functions work on plain arrays, row 0 = north. A *margin* is a number of cells by which the prediction reaches
beyond the reference on every side, so that a shift moves real heights in from outside, not holes.
A shift is what has to be added to the prediction: (east, north, up) in metres or (columns, rows) in cells.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sattools.errors import InputError

Method = Literal["ncc", "nuth-kaab", "z", "none"]
METHODS: tuple[Method, ...] = ("ncc", "nuth-kaab", "z", "none")

SEARCH_CELLS = 5  # half width of the search window on each pyramid level
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
    columns, rows, correlation = 0.0, 0.0, None
    if method == "ncc":
        whole_rows, whole_columns, correlation = ncc_shift(predicted, reference, margin)
        columns, rows = float(whole_columns), float(whole_rows)
    elif method == "nuth-kaab":
        columns, rows = nuth_kaab_shift(predicted, reference, margin)
    moved = shifted(predicted, columns, rows, margin)
    difference = reference - moved
    difference = difference[np.isfinite(difference)]
    if not difference.size:
        raise InputError("prediction: found no cell in common with the reference, expected overlap")
    return Registration(columns, rows, float(difference.mean(dtype=np.float64)), method, correlation)


def shifted(predicted: np.ndarray, columns: float, rows: float, margin: int = 0) -> np.ndarray:
    """Cells of the reference [H, W] from `predicted` [H + 2 margin, W + 2 margin] moved by `columns` and `rows`.

    Whole shifts copy cells; others interpolate linearly. Cells that come from outside are NaN.

    Args:
        predicted: see above [m].
        columns: cells eastwards.
        rows: cells southwards.
        margin: cells by which the prediction reaches beyond the reference.
    """
    row0, column0 = int(np.floor(rows)), int(np.floor(columns))
    weight_row, weight_column = rows - row0, columns - column0
    result: np.ndarray | None = None
    for row, row_weight in ((row0, 1 - weight_row), (row0 + 1, weight_row)):
        for column, column_weight in ((column0, 1 - weight_column), (column0 + 1, weight_column)):
            weight = row_weight * column_weight
            if weight > 0:
                part = weight * _window(predicted, column, row, margin)
                result = part if result is None else result + part
    assert result is not None  # the four weights sum to one
    return result


def ncc_shift(predicted: np.ndarray, reference: np.ndarray, margin: int = 0) -> tuple[int, int, float]:
    """Whole-cell shift (rows, columns) of largest zero-mean normalised cross-correlation, and that correlation.

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
        predicted = np.pad(predicted, pad, constant_values=np.nan)
        margin += pad
    pairs = [(predicted.astype(np.float64), reference.astype(np.float64))]
    for _ in range(levels):
        pairs.append((halved(pairs[-1][0]), halved(pairs[-1][1])))
    rows, columns, best = 0, 0, 0.0
    for level in range(levels, -1, -1):
        rows, columns = 2 * rows * (level < levels), 2 * columns * (level < levels)
        coarse_predicted, coarse_reference = pairs[level]
        rows, columns, best = _search(coarse_predicted, coarse_reference, margin >> level, rows, columns)
    return rows, columns, best


def halved(array: np.ndarray) -> np.ndarray:
    """Mean of the finite heights [m] of each 2×2 block [H // 2, W // 2]; NaN where a block has none."""
    height, width = array.shape[0] // 2, array.shape[1] // 2
    blocks = array[: 2 * height, : 2 * width].reshape(height, 2, width, 2)
    finite = np.isfinite(blocks)
    count = finite.sum(axis=(1, 3))
    total = np.where(finite, blocks, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def nuth_kaab_shift(
    predicted: np.ndarray, reference: np.ndarray, margin: int = 0, iterations: int = 20
) -> tuple[float, float]:
    """Sub-cell shift (columns, rows) after Nuth & Kääb (2011): dh / tan(slope) = a cos(b - aspect) + c.

    The height differences per aspect sector enter by their median, since height steps of a city are outliers to
    this model; iterated until the step is below 0.01 cell. Raises InputError where the reference has no slopes.

    Args:
        predicted: ``[H + 2 margin, W + 2 margin]`` heights [m].
        reference: ``[H, W]`` heights [m]; NaN = none.
        margin: cells by which the prediction reaches beyond the reference.
        iterations: number of steps.
    """
    gradient_row, gradient_column = np.gradient(reference.astype(np.float64))
    slope = np.hypot(gradient_row, gradient_column)  # height per cell
    aspect = np.arctan2(-gradient_column, gradient_row)  # downhill direction, clockwise from north
    columns = rows = 0.0
    for _ in range(iterations):
        difference = shifted(predicted, columns, rows, margin) - reference
        finite = np.isfinite(difference) & np.isfinite(slope)
        if not finite.any():
            raise InputError("prediction: found no cell in common with the reference, expected overlap")
        difference = difference - np.median(difference[finite])
        steepest = np.quantile(slope[finite], 0.98)  # steps between ground and roof, where the model does not hold
        spread = 1.4826 * np.median(np.abs(difference[finite]))
        use = finite & (slope > 0.02) & (slope <= max(steepest, 0.02)) & (np.abs(difference) <= 3 * spread + 1e-6)
        if use.sum() < 100:
            raise InputError(f"reference: found {int(use.sum())} sloping cells, expected 100 or more for nuth-kaab")
        step_columns, step_rows = _cosine_fit(difference[use] / slope[use], aspect[use])
        columns, rows = columns + step_columns, rows + step_rows
        if np.hypot(step_columns, step_rows) < 0.01:
            break
    return columns, rows


def _cosine_fit(ratio: np.ndarray, aspect: np.ndarray, sectors: int = 72) -> tuple[float, float]:
    """Shift (columns, rows) to add from dh / tan(slope) over aspect by sector medians and least squares."""
    sector = np.floor((aspect + np.pi) / (2 * np.pi) * sectors).astype(int) % sectors
    angles, medians = [], []
    for number in range(sectors):
        values = ratio[sector == number]
        if values.size:
            angles.append((number + 0.5) / sectors * 2 * np.pi - np.pi)
            medians.append(np.median(values))
    angle = np.array(angles)
    design = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], axis=1)
    (north, east, _), *_ = np.linalg.lstsq(design, np.array(medians), rcond=None)
    # a slope that falls to the east shows positive differences where the prediction lies too far east
    return -float(east), float(north)


def _window(predicted: np.ndarray, columns: int, rows: int, margin: int) -> np.ndarray:
    """Part of `predicted` that falls on the reference after a whole-cell shift; NaN from outside."""
    height, width = predicted.shape[0] - 2 * margin, predicted.shape[1] - 2 * margin
    top, left = margin - rows, margin - columns
    if 0 <= top <= 2 * margin and 0 <= left <= 2 * margin:
        return predicted[top : top + height, left : left + width]
    window = np.full((height, width), np.nan, dtype=predicted.dtype)
    row0, row1 = max(top, 0), min(top + height, predicted.shape[0])
    column0, column1 = max(left, 0), min(left + width, predicted.shape[1])
    if row0 < row1 and column0 < column1:
        window[row0 - top : row1 - top, column0 - left : column1 - left] = predicted[row0:row1, column0:column1]
    return window


def _search(
    predicted: np.ndarray, reference: np.ndarray, margin: int, rows: int, columns: int
) -> tuple[int, int, float]:
    """Best whole-cell shift within ±5 cells of (rows, columns); nearer shifts win ties."""
    height, width = reference.shape
    reach = SEARCH_CELLS + max(abs(rows), abs(columns))
    pad = max(reach - margin, 0)
    padded = np.pad(predicted, pad, constant_values=np.nan)[: height + 2 * (margin + pad), : width + 2 * (margin + pad)]
    border = margin + pad
    valid_r, valid_p = np.isfinite(reference), np.isfinite(padded)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # mean of an empty raster: handled below
        centre_r, centre_p = np.nanmean(reference[valid_r]), np.nanmean(padded[valid_p])
    mask_r, mask_p = valid_r.astype(np.float64), valid_p.astype(np.float64)
    value_r, value_p = np.where(valid_r, reference - centre_r, 0.0), np.where(valid_p, padded - centre_p, 0.0)
    square_r, square_p = value_r**2, value_p**2
    offsets = range(-SEARCH_CELLS, SEARCH_CELLS + 1)
    trials = sorted(((dr, dc) for dr in offsets for dc in offsets), key=lambda t: t[0] ** 2 + t[1] ** 2)
    scores = []
    for dr, dc in trials:
        top, left = border - rows - dr, border - columns - dc
        box = (slice(top, top + height), slice(left, left + width))
        count = _dot(mask_r, mask_p[box])
        if count < 2:
            scores.append((0.0, -np.inf))
            continue
        mean_r, mean_p = _dot(value_r, mask_p[box]) / count, _dot(mask_r, value_p[box]) / count
        var_r = _dot(square_r, mask_p[box]) / count - mean_r**2
        var_p = _dot(mask_r, square_p[box]) / count - mean_p**2
        covariance = _dot(value_r, value_p[box]) / count - mean_r * mean_p
        flat = min(var_r, var_p) <= 1e-12
        scores.append((count, -np.inf if flat else covariance / np.sqrt(var_r * var_p)))
    # a small overlap correlates by chance: it needs half the cells of the largest one to count
    enough = 0.5 * max(count for count, _ in scores)
    best, place = -np.inf, (rows, columns)
    for (dr, dc), (count, score) in zip(trials, scores, strict=True):
        if count >= enough and score > best + 1e-12:
            best, place = score, (rows + dr, columns + dc)
    return *place, min(float(best), 1.0) if np.isfinite(best) else 0.0


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.einsum("ij,ij->", a, b))

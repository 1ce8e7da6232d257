"""What speaks against a comparison: numbers that are no heights in metres, registrations that lead away."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rasterio.enums import ColorInterp
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.compare.registration import Registration, shifted
from sattools.errors import InputError
from sattools.scene.grid import Grid
from sattools.scene.opening import opened
from sattools.scene.raster import read_window
from sattools.scene.stored import pieces
from sattools.scene.values import is_length, says_metres, scale_of

UNITS = {"feet": 1 / 0.3048, "decimetres": 10.0, "centimetres": 100.0}  # -> in a metre
ALIKE, AS_LARGE = 0.9, 1.15  # correlation of two surfaces, and by what factor their ratio may be another than a unit's
RELIEF_M = 0.5  # standard deviation of a surface from which that can be told
SAMPLED = 1_000_000  # cells that are looked at
WORSE, LEAST_WORSE_M = 1.05, 0.01  # times what is left without a registration, and so much more: not chance
CLASS_CODES = (*range(19), 65)  # of ASPRS, and of the contest for what nobody has looked at
FAR_M, FAR_SHARE = 10.0, 0.25  # metres, share of the smaller side: no camera of a delivered image is off like that


def check_heights(path: Path, one_band: bool) -> None:
    """Raise InputError where a file says itself that it has no heights.

    Args:
        path: the file.
        one_band: whether more bands than one (and transparency) say so.
    """
    with opened(path) as data:
        count = sum(kind != ColorInterp.alpha for kind in data.colorinterp)
        unit, whole = data.units[0], np.issubdtype(np.dtype(data.dtypes[0]), np.integer)
        coloured = data.colorinterp[0] == ColorInterp.palette
        bare = scale_of(data) == (1.0, 0.0) and not says_metres(unit)
        codes = _class_codes(_middle_of(data, path)) if whole and bare and is_length(unit) else []
    if one_band and count > 1:
        raise InputError(f"{path}: found {count} bands, expected one of heights [m]")
    if not is_length(unit):
        raise InputError(f"{path}: found numbers in the unit {unit[:40]!r}, expected heights in metres or feet")
    if coloured:
        raise InputError(f"{path}: found a palette (numbers of colours or classes), expected heights [m]")
    if codes:
        raise InputError(
            f"{path}: found class codes ({', '.join(map(str, codes))}), expected heights [m] (or a file that says its "
            "unit: gdal_edit.py -units m)"
        )


def _middle_of(data: DatasetReader, path: Path) -> np.ndarray:
    """Numbers ``[h, w]`` of the first band in the middle of an open file, which may be one of the Earth; NaN = none."""
    edge = math.isqrt(SAMPLED)
    height, width = min(data.height, edge), min(data.width, edge)
    window = Window((data.width - width) // 2, (data.height - height) // 2, width, height)
    numbers = read_window(data, path, window)[0].astype(np.float32)
    # of bytes a number for no data is left as a code
    return np.where(numbers == data.nodata, np.nan, numbers) if data.nodata is not None else numbers


def _class_codes(numbers: np.ndarray) -> list[int]:
    """The codes of a class map ``[H, W]``; none where its whole numbers may be heights.

    Heights in whole metres that lie side by side seldom leave out a number that is nowhere else either; most borders
    between classes do.
    """
    codes = np.unique(numbers[np.isfinite(numbers)])
    if len(codes) < 2 or not np.isin(codes, CLASS_CODES).all():
        return []
    rank = np.full(int(codes[-1]) + 1, np.nan)
    rank[codes.astype(int)] = np.arange(len(codes))
    jumps = borders = 0
    for axis in (0, 1):
        apart = np.abs(np.diff(numbers, axis=axis))
        ranks = np.where(np.isfinite(numbers), rank[np.nan_to_num(numbers).astype(int)], np.nan)
        between = np.abs(np.diff(ranks, axis=axis))
        borders += int((apart > 0).sum())
        jumps += int((apart > between).sum())
    return [int(code) for code in codes] if jumps > borders / 2 else []


def in_other_unit(
    wide: np.ndarray, reference: np.ndarray, shift: Registration, margin: int, throughout: bool = False
) -> tuple[str, str] | None:
    """Which of "surface" and "reference" is in which of `UNITS` without saying so; None where neither is.

    One varies as much more than the other as numbers of that unit do, and alike: bad heights do the first at most.

    Args:
        wide: see `of_registration`.
        reference: likewise.
        shift: likewise.
        margin: likewise.
        throughout: so does the half of the ground that varies least, as it does not where a heap has grown.
    """
    found = []
    for rows, step in _some(reference.shape):
        part = shifted(wide, shift.columns, shift.rows, margin, rows)[::step], reference[rows][::step]
        known = np.isfinite(part[0]) & np.isfinite(part[1])
        found.append([values[known].astype(np.float64) for values in part])
    surface, own = (np.concatenate(values) for values in zip(*found, strict=True))
    if not own.size:
        return None
    spread, own_spread = float(surface.std()), float(own.std())
    if min(spread, own_spread) < RELIEF_M or np.corrcoef(surface, own)[0, 1] < ALIKE:
        return None
    ratios = [own_spread / spread]
    if throughout:
        middle, own_middle = (float(np.median(np.abs(heights - np.median(heights)))) for heights in (surface, own))
        ratios.append(own_middle / max(middle, 1e-9))
    for unit, count in UNITS.items():
        times = count if own_spread > spread else 1 / count
        if all(1 / AS_LARGE < ratio / times < AS_LARGE for ratio in ratios):
            return "reference" if own_spread > spread else "surface", unit
    return None


def check_metres(found: tuple[str, str] | None, name: str, reference: str, more: str = "") -> None:
    """Raise InputError, naming the file, for what `in_other_unit` finds.

    Args:
        found: see there.
        name: of the surface.
        reference: its name.
        more: that the file may say.
    """
    if found is not None:
        which, unit = found
        says = "unit: gdal_edit.py -units ft" if unit == "feet" else f"scale: gdal_edit.py -scale {1 / UNITS[unit]:g}"
        raise InputError(
            f"{reference if which == 'reference' else name}: found heights that are {UNITS[unit]:.3g} times the other "
            f"surface's, as {unit} are, expected metres (or a file that says its {says}{more})"
        )


def of_registration(wide: np.ndarray, reference: np.ndarray, shift: Registration, margin: int, grid: Grid) -> list[str]:
    """Reasons not to believe a horizontal shift; none where there are none.

    Args:
        wide: ``[H + 2 margin, W + 2 margin]`` the surface [m], read by rows.
        reference: ``[H, W]`` heights [m]; NaN = not scored.
        shift: of the surface.
        margin: see above.
        grid: of the reference.
    """
    if shift.method not in ("ncc", "nuth-kaab") or not (shift.columns or shift.rows):
        return []
    east, north, _ = shift.metres(grid.cell_size)
    reasons = []
    limit = min(FAR_M, FAR_SHARE * min(grid.shape) * grid.cell_size)
    if math.hypot(east, north) > limit:
        reasons.append(f"more than {limit:.1f} m")
    reasons += worse_than_none(wide, reference, shift, margin).values()
    if not reasons:
        return []
    return [
        f"registration by {shift.method} moves the surface {east:+.1f} m east and {north:+.1f} m north, which is "
        f"doubtful: {'; '.join(reasons)}; --register z or none scores it where it is"
    ]


def worse_than_none(wide: np.ndarray, reference: np.ndarray, shift: Registration, margin: int) -> dict[str, str]:
    """By "median" and "mean" how a horizontal shift makes the absolute deviation from the median error larger.

    Only those that are worse by more than chance; arguments as of `of_registration`.
    """
    here = _left(wide, reference, Registration(0.0, 0.0, 0.0, "none"), margin)
    there = _left(wide, reference, shift, margin)
    return {
        name: f"the {name} absolute deviation from the median error is {moved:.2f} m, {still:.2f} m without it"
        for name, moved, still in zip(("median", "mean"), there, here, strict=True)
        if moved > WORSE * still + LEAST_WORSE_M
    }


def _left(wide: np.ndarray, reference: np.ndarray, shift: Registration, margin: int) -> tuple[float, float]:
    """Median and mean absolute deviation from the median error [m]; infinite without a cell in common."""
    errors = []
    for rows, step in _some(reference.shape):
        apart = (shifted(wide, shift.columns, shift.rows, margin, rows) - reference[rows])[::step]
        errors.append(apart[np.isfinite(apart)].astype(np.float64))
    values = np.concatenate(errors)
    if not values.size:
        return math.inf, math.inf
    apart = np.abs(values - np.median(values))
    return float(np.median(apart)), float(apart.mean())


def _some(shape: tuple[int, ...]) -> Iterator[tuple[slice, int]]:
    """Pieces of a map, and the step at which rows of them are looked at: no more than about `SAMPLED` cells."""
    step = math.ceil(shape[0] * shape[1] / SAMPLED)
    for rows in pieces((shape[0], shape[1])):
        yield rows, step


__all__ = ["FAR_M", "check_heights", "check_metres", "in_other_unit", "of_registration", "worse_than_none"]

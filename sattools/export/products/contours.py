"""Lines of equal height."""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from sattools.errors import InputError
from sattools.export.products.maps import Maps
from sattools.progress import Progress
from sattools.scene.datums import ELLIPSOID
from sattools.scene.files import write_bytes
from sattools.scene.vectors import Features, geopackage

SMOOTH = 1.0  # cells: sigma of the Gaussian that takes the cells' noise out of the lines
_REACH = 4  # cells, of that Gaussian
_MOST_LEVELS = 20_000
_SHORTEST = 8.0  # cells, of a closed line; smaller rings are noise
_DIGITS = 4  # of coordinates [m]
_MAJOR = 5  # every so many levels, as maps have it


def contour_lines(maps: Maps, interval: float, progress: Progress) -> Features:
    """Lines of equal height of the DSM, with columns `height` [m] and `major` (every fifth level).

    The heights are smoothed over a cell; no line crosses a cell without a height.

    Args:
        maps: with the DSM.
        interval: between two levels [m].
        progress: told the share done.

    Raises:
        InputError: an interval that would make tens of thousands of levels.
    """
    import shapely

    pieces: dict[int, list[Any]] = defaultdict(list)
    total = sum(1 for _ in maps.blocks())
    for k, (rows, cols) in enumerate(maps.blocks()):
        progress(k / total, "contours")
        for level, lines in _lines_of_block(maps, rows, cols, interval).items():
            pieces[level] += lines
    levels, lines = [], []
    cell = maps.grid.cell_size
    for level in sorted(pieces):
        merged = shapely.line_merge(shapely.MultiLineString(pieces[level]))
        for line in shapely.get_parts(merged):
            if not (line.is_closed and line.length < _SHORTEST * cell):
                levels.append(level)
                lines.append(line.simplify(0.1 * cell))
    numbers = np.array(levels, dtype=np.int64)
    heights = np.round(numbers * interval, _DIGITS)  # -24.6, as people write it
    return Features(lines, {"height": heights, "major": numbers % _MAJOR == 0}, maps.grid.crs)


def write_contours(path: Path, maps: Maps, interval: float, progress: Progress, datum: str = ELLIPSOID) -> int:
    """Write `contour_lines` as a GeoPackage, whose layer's description says what heights are above; how many lines.

    Args:
        path: to write.
        maps: with the DSM.
        interval: between two levels [m].
        progress: told the share done.
        datum: what the heights are above.
    """
    lines = contour_lines(maps, interval, progress)
    write_bytes(path, geopackage(lines, "contours", "LineString", f"heights [m] above the {datum}"))
    return len(lines)


def _lines_of_block(maps: Maps, rows: slice, cols: slice, interval: float) -> dict[int, list[Any]]:
    """Lines between the centres of a block's cells and the first ones of the next blocks, by level."""
    import contourpy

    height, width = maps.grid.shape
    wide = [
        slice(max(0, part.start - _REACH), min(size, part.stop + 1 + _REACH))
        for part, size in ((rows, height), (cols, width))
    ]
    smooth = _smoothed(maps.read("dsm", *wide)[0])
    own = tuple(slice(p.start - w.start, p.stop + 1 - w.start) for p, w in zip((rows, cols), wide))
    values = smooth[own]
    known = np.isfinite(values)
    if min(values.shape) < 2 or not known.any():
        return {}
    grid = maps.grid.part(
        slice(rows.start, rows.start + values.shape[0]), slice(cols.start, cols.start + len(values[0]))
    )
    low, high = float(values[known].min()), float(values[known].max())
    first, last = math.ceil(low / interval), math.floor(high / interval)
    if last - first > _MOST_LEVELS:
        raise InputError(
            f"--contours: found {last - first} levels of {interval:g} m between {low:.0f} and {high:.0f} m, expected "
            f"at most {_MOST_LEVELS}"
        )
    generator = contourpy.contour_generator(grid.x(), grid.y(), np.ma.masked_invalid(values), corner_mask=False)
    found = {}
    for level in range(first, last + 1):
        lines = [np.round(np.asarray(line), _DIGITS) for line in generator.lines(level * interval)]
        found[level] = [line for line in lines if len(line) > 1 and (np.ptp(line, axis=0) > 0).any()]
    return found


def _smoothed(height: np.ndarray) -> np.ndarray:
    """Heights ``[H, W]`` [m] without the noise of single cells; NaN stays NaN and does not spread."""
    known = np.isfinite(height)
    blurred = (
        gaussian_filter(layer, SMOOTH, mode="constant", radius=_REACH)
        for layer in (np.where(known, height, 0.0).astype(np.float64), known.astype(np.float64))
    )
    total, weight = blurred
    # beside cells without a height the mean leans to one side: there the cell's own height counts for more
    share = np.clip(2.0 * weight - 1.0, 0.0, 1.0)
    return np.where(known, share * total / np.maximum(weight, 1e-9) + (1.0 - share) * height, np.nan)


__all__ = ["contour_lines", "write_contours"]

"""The shift that brings the files of a surface onto a raster of heights; memory does not grow with the area."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sattools.align.estimate import Method, chosen
from sattools.align.far import LEAST_COMMON, shift_within
from sattools.align.means import LEAST_PARTS
from sattools.align.options import AlignOptions
from sattools.align.reference import heights_around
from sattools.align.shift import Shift
from sattools.errors import InputError, SceneError
from sattools.progress import Progress, silent, subprogress
from sattools.scene.grid import Grid
from sattools.scene.raster import block_means, raster_grid, read_raster
from sattools.scene.validity import MEASURED

log = logging.getLogger(__name__)
MOST_CELLS = 4_000_000  # of the surface, which take a hundred bytes each; of larger ones a part is looked at
PARTS = ((0.5, 0.5), (0.2, 0.2), (0.2, 0.8), (0.8, 0.2), (0.8, 0.8))  # middles of squares, as shares of the area
PART_CELLS = 600  # along an edge of a square
_STRIP_CELLS = 2_000_000


@dataclass(frozen=True)
class SurfaceFiles:
    """A surface that is to be moved.

    Attributes:
        dsm: heights [m].
        validity: what is measured, on the same grid; None = all.
        error: what 95 % of the heights' errors are below [m], if it is on the same grid; None = not known.
    """

    dsm: Path
    validity: Path | None
    error: Path | None

    def read(self, part: Grid, step: int = 1) -> tuple[np.ndarray, np.ndarray | None, Grid]:
        """Heights [m], NaN where nothing was measured, their errors [m] or None, and their grid.

        Args:
            part: of the files' grid.
            step: cells along an axis of which means are taken; rows and columns left over at the end are dropped.

        Raises:
            InputError: as `sattools.scene.raster.read_raster`.
        """
        known = self.error is not None and raster_grid(self.error) == raster_grid(self.dsm)
        shape = part.height // step, part.width // step
        height, errors = np.empty(shape, np.float32), np.empty(shape, np.float32)
        at_once = max(1, _STRIP_CELLS // (part.width * step))
        for first in range(0, shape[0], at_once):
            last = min(first + at_once, shape[0])
            strip = part.part(slice(first * step, last * step), slice(0, shape[1] * step))
            heights = read_raster(self.dsm, strip)[0][0].astype(np.float32)
            if self.validity is not None:
                heights = np.where(read_raster(self.validity, strip)[0][0] == MEASURED, heights, np.float32(np.nan))
            height[first:last] = _means(heights, step)
            if known and self.error is not None:
                errors[first:last] = _means(read_raster(self.error, strip)[0][0].astype(np.float32), step)
        larger = Grid(part.crs, part.left, part.top, part.cell_size * step, shape[1], shape[0])
        return height, errors if known else None, larger


def _means(values: np.ndarray, step: int) -> np.ndarray:
    """Means ``[H / step, W / step]``; NaN where fewer than half of the cells are known."""
    if step == 1:
        return values
    rows, cols = values.shape
    return block_means(values.reshape(1, rows // step, step, cols // step, step))[0]


def shift_to_raster(
    surface: SurfaceFiles, reference: Path, options: AlignOptions, progress: Progress = silent
) -> tuple[Shift, Method]:
    """`shift_within` of files.

    Of a surface of many cells five squares are looked at, and the median of what they say is taken. Where a tilt is
    asked for, or height alone, or where the reference's cells are large enough, all of it is looked at on larger cells.

    Args:
        surface: to be moved.
        reference: raster of heights [m].
        options: of the stage.
        progress: told the share done and what is being done.

    Returns:
        The shift, and the method that has found it.

    Raises:
        InputError: nothing of the surface was measured; as `heights_around` and `shift_within`.
    """
    grid = raster_grid(surface.dsm)
    step = math.ceil(math.sqrt(grid.width * grid.height / MOST_CELLS))
    if step > 1 and not options.tilt and options.method != "z":
        found = _of_parts(surface, grid, reference, options, step, progress)
        if found is not None:
            return found
    height, error, own = surface.read(grid, step)
    if not np.isfinite(height).any():
        raise InputError(
            f"found nothing measured in {surface.dsm}, expected heights to register by: filled ones and water that was "
            "laid level say nothing (`validity`)"
        )
    onto = heights_around(reference, grid, options.max_shift, step)
    try:
        return _shift(height, error, own, onto, options, progress)
    except InputError as wrong:
        measured = float(np.isfinite(height).mean())
        if measured >= LEAST_COMMON:
            raise
        raise InputError(
            f"{wrong} ({100 * measured:.1f} % of the surface is measured: filled ground and water that was laid level "
            "say nothing)"
        ) from None


def _shift(
    height: np.ndarray,
    error: np.ndarray | None,
    grid: Grid,
    onto: tuple[np.ndarray, Grid],
    options: AlignOptions,
    progress: Progress,
) -> tuple[Shift, Method]:
    method = chosen(options.method, grid, onto[1])
    reach = options.max_shift
    tilt = options.tilt
    found = shift_within(height, grid, *onto, method, tilt=tilt, error=error, reach=reach, progress=progress)
    return found, method


def _of_parts(
    surface: SurfaceFiles, grid: Grid, reference: Path, options: AlignOptions, step: int, progress: Progress
) -> tuple[Shift, Method] | None:
    """The median of what squares of the area say; None where most say nothing, or the whole says it as well."""
    shifts: list[Shift] = []
    method: Method = "z"
    for k, (down, right) in enumerate(PARTS):
        own_share = subprogress(progress, k / len(PARTS), (k + 1) / len(PARTS))
        part = _square(grid, down, right)
        try:
            onto = heights_around(reference, part, options.max_shift)
            if onto[1].cell_size >= LEAST_PARTS * step * grid.cell_size:
                return None
            height, error, own = surface.read(part)
            shift, method = _shift(height, error, own, onto, options, own_share)
        except (InputError, SceneError) as reason:
            log.info("%s: a part tells nothing: %s", surface.dsm, reason)
            continue
        shifts.append(shift)
    if 2 * len(shifts) <= len(PARTS):
        return None
    x, y = grid.middle
    names = ("east", "north", "up", "before", "after", "left")
    middle = {name: float(np.median([getattr(shift, name) for shift in shifts])) for name in names}
    count = sum(shift.count for shift in shifts)
    return replace(shifts[0], **middle, count=count, x=x, y=y), method


def _square(grid: Grid, down: float, right: float) -> Grid:
    """Cells around a place of a grid."""
    rows, cols = (
        slice(first := max(0, round(share * count) - PART_CELLS // 2), min(count, first + PART_CELLS))
        for share, count in ((down, grid.height), (right, grid.width))
    )
    return grid.part(rows, cols)


__all__ = ["SurfaceFiles", "shift_to_raster"]

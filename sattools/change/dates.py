"""Two dates on one grid: the later one registered onto the earlier one, read by rows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sattools.change.surfaces import Surface, order_of_bands
from sattools.compare.doubts import FAR_M, check_metres, in_other_unit, of_registration, worse_than_none
from sattools.compare.registration import Method, Registration, register, search_margin, shifted
from sattools.compare.tally import Median
from sattools.errors import InputError
from sattools.scene.grid import Grid
from sattools.scene.opening import opened
from sattools.scene.stored import cut, new_map, pieces
from sattools.scene.values import says_metres

SAMPLED = 1_000_000  # cells of which brightness and contrast are told


@dataclass(frozen=True)
class Dates:
    """Both dates.

    Attributes:
        old, new: earlier and later.
        difference: ``[H, W]`` height, later minus earlier, on the earlier one's grid [m]; NaN = unknown. Like all maps
            here it is read by rows (`sattools.scene.stored`).
        found: how the later one was moved.
        shift_m: the same as (east, north, up) [m].
        margin: cells by which the later one's maps reach beyond the grid.
        folder: for temporary files.
        notes: what speaks against the shift.
    """

    old: Surface
    new: Surface
    difference: np.ndarray
    found: Registration
    shift_m: tuple[float, float, float]
    margin: int
    folder: Path
    notes: tuple[str, ...] = ()

    def moved(self, layer: str) -> list[np.ndarray]:
        """Bands ``[H, W]`` of a layer of the later date, in its unit, on the earlier one's grid.

        Args:
            layer: one that it has.
        """
        wide = _wide(self.new, layer, self.old, self.margin, self.folder)
        grid = self.old.grid
        bands = [new_map(grid.shape, np.float32, self.folder) for _ in wide]
        for rows in pieces(grid.shape):
            for band, source in zip(bands, wide, strict=True):
                band[rows] = shifted(source, self.found.columns, self.found.rows, self.margin, rows)
        return bands

    def together(self, layer: str, how: np.ufunc) -> np.ndarray | None:
        """Both dates' maps ``[H, W]`` of a layer in one; what only one of them has; None where neither has it.

        Args:
            layer: of one band.
            how: of two numbers.
        """
        grid = self.old.grid
        new = self.moved(layer)[0] if layer in self.new.layers else None
        if layer not in self.old.layers:
            return new
        both = new_map(grid.shape, np.float32, self.folder)
        for rows in pieces(grid.shape):
            own = self.old.on(layer, grid.part(rows, slice(0, grid.width)))[0]
            both[rows] = own if new is None else how(own, new[rows])
        return both

    def albedo_change(self, labels: np.ndarray) -> Callable[[slice], np.ndarray]:
        """Gives later minus earlier albedo ``[C, h, W]`` of some rows, the later one's brightness and contrast matched.

        Haze, season and exposure change all colours alike. They are told where nothing has changed. Bands are those of
        the same names, in the earlier date's order.

        Args:
            labels: ``[H, W]``, 0 where nothing has changed.
        """
        grid, moved = self.old.grid, self.moved("albedo")
        later = [moved[number] for number in order_of_bands(self.old, self.new)]
        step = math.ceil(math.sqrt(grid.width * grid.height / SAMPLED))
        olds, news = [], []
        for rows in pieces(grid.shape):
            some = slice(-rows.start % step, None, step), slice(None, None, step)
            old, new = self._earlier(rows)[:, *some], np.stack([band[rows] for band in later])[:, *some]
            same = (labels[rows][some] == 0) & np.isfinite(old).all(axis=0) & np.isfinite(new).all(axis=0)
            olds.append(old[:, same])
            news.append(new[:, same])
        before, after = np.concatenate(olds, axis=1), np.concatenate(news, axis=1)
        if not before.size:
            return lambda rows: np.full_like(self._earlier(rows), np.nan)
        scales = []
        for old, new in zip(before, after, strict=True):
            low = np.percentile(old, [16, 50, 84]), np.percentile(new, [16, 50, 84])
            scales.append((low[1][1], (low[0][2] - low[0][0]) / max(low[1][2] - low[1][0], 1e-6), low[0][1]))

        def change(rows: slice) -> np.ndarray:
            earlier = self._earlier(rows)
            return np.stack(
                [(band[rows] - m) * gain + to - old for band, (m, gain, to), old in zip(later, scales, earlier)]
            )

        return change

    def _earlier(self, rows: slice) -> np.ndarray:
        grid = self.old.grid
        return self.old.on("albedo", grid.part(rows, slice(0, grid.width)))


def register_dates(old: Surface, new: Surface, method: Method, folder: Path) -> Dates:
    """Bring a later date onto an earlier one's grid.

    A horizontal shift with which most of the area agrees less than without is none of the surfaces: large
    changes, which have nothing to correlate with, have drawn it. It is left out, and a note says so.

    Args:
        old: earlier one.
        new: later one.
        method: of the registration.
        folder: for temporary files.

    Raises:
        InputError: nothing in common, or heights of one date that are in feet or centimetres without saying so.
    """
    grid = old.grid
    margin = search_margin(grid.shape) if method in ("ncc", "nuth-kaab") else 0
    (wide,) = _wide(new, "height", old, margin, folder)
    if not any(np.isfinite(wide[rows]).any() for rows in pieces((wide.shape[0], wide.shape[1]))):
        raise InputError(f"{new.name}: found no height within {old.name}, expected overlap")
    before = new_map(grid.shape, np.float32, folder)
    for rows, cols in cut(grid.shape):
        before[rows, cols] = old.on("height", grid.part(rows, cols))[0]
    found, notes = _registered(wide, before, method, margin, new, grid)
    unit = in_other_unit(wide, before, found, margin, throughout=True)
    names = {"surface": new.layers["height"], "reference": old.layers["height"]}
    # ground may have grown to three times its height, and then its file can say so
    if unit is not None and not _says_metres(names[unit[0]]):
        check_metres(unit, str(names["surface"]), str(names["reference"]), ", or -units m if they are")
    difference = new_map(grid.shape, np.float32, folder)
    common = 0
    for rows in pieces(grid.shape):
        apart = shifted(wide, found.columns, found.rows, margin, rows) - before[rows]
        common += int(np.isfinite(apart).sum())
        difference[rows] = apart
    if not common:
        raise InputError(f"{new.name}: found no measured height in common with {old.name}, expected overlap")
    # the mean height difference, which registration takes out, contains the changes; the median does not
    offset = _median(difference) if method != "none" else 0.0
    if abs(offset) > FAR_M:
        what = f"found heights {offset:+.1f} m from those of {old.layers['height']}, which is taken out"
        notes += (f"{new.layers['height']}: {what}: are both in metres above the same datum?",)
    for rows in pieces(grid.shape):
        difference[rows] = shifted(wide, found.columns, found.rows, margin, rows) - offset - before[rows]
    east, north, _ = found.metres(grid.cell_size)
    return Dates(old, new, difference, found, (east, north, 0.0 - offset), margin, folder, notes)


def _says_metres(path: Path) -> bool:
    with opened(path) as data:
        return says_metres(data.units[0])


def _registered(
    wide: np.ndarray, before: np.ndarray, method: Method, margin: int, new: Surface, grid: Grid
) -> tuple[Registration, tuple[str, ...]]:
    """The shift of the later date, and notes on it."""
    found = register(wide, before, method, margin)
    worse = worse_than_none(wide, before, found, margin) if found.columns or found.rows else {}
    if "median" not in worse:
        return found, tuple(of_registration(wide, before, found, margin, grid))
    east, north, _ = found.metres(grid.cell_size)
    where = f"registration by {method} moves it {east:+.1f} m east and {north:+.1f} m north"
    note = f"{new.layers['height']}: {where}, where {worse['median']}: left where it is, but for its height"
    return register(wide, before, "z", margin), (note,)


def _median(values: np.ndarray) -> float:
    median = Median()
    for show in (median.first, median.again):
        for rows in pieces((values.shape[0], values.shape[1])):
            part = values[rows]
            show(part[np.isfinite(part)])
    return median.value()


def _wide(new: Surface, layer: str, old: Surface, margin: int, folder: Path) -> list[np.ndarray]:
    """Bands of a layer of the later date on the earlier one's grid and a margin around it."""
    around = old.grid.widened(margin)
    bands = [new_map(around.shape, np.float32, folder) for _ in range(1 if layer == "height" else new.bands(layer))]
    for rows, cols in cut(around.shape):
        for band, values in zip(bands, new.on(layer, around.part(rows, cols)), strict=True):
            band[rows, cols] = values
    return bands


__all__ = ["Dates", "register_dates"]

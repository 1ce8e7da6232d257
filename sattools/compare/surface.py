"""A surface against a reference: registered and scored by rows, so that neither has to fit into memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from sattools.compare.doubts import check_heights, in_other_unit, of_registration
from sattools.compare.heights import Rows, errors_of
from sattools.compare.holes import fill_holes
from sattools.compare.registration import Registration, register, search_margin, shifted
from sattools.compare.truth import Truth, known_heights, warped_heights
from sattools.errors import InputError, SceneError
from sattools.scene.grid import Grid
from sattools.scene.placement import has_grid
from sattools.scene.raster import raster_grid, read_around, read_raster
from sattools.scene.regrid import reproject_map, window_around
from sattools.scene.stored import cut, new_map, pieces
from sattools.scene.validity import MEASURED

Method = Literal["ncc", "nuth-kaab", "z", "none"]


@dataclass(frozen=True)
class Comparison:
    """A scored DSM.

    Attributes:
        figures: the table, keys as `sattools compare` prints them.
        difference: [H, W] registered prediction minus reference in metres, on `grid`; NaN = not scored.
        grid: grid of the reference.
        registration: how the prediction was moved.
        notes: what speaks against that.
        unit: "surface" or "reference", and in which unit that one is by its looks; None = metres.
    """

    figures: dict[str, Any]
    difference: np.ndarray
    grid: Grid
    registration: Registration
    notes: tuple[str, ...] = ()
    unit: tuple[str, str] | None = None


class Surface(Protocol):
    """Heights that can be had on any grid."""

    @property
    def name(self) -> str:
        """For messages."""

    def on(self, where: Grid) -> tuple[np.ndarray, np.ndarray | None]:
        """Heights ``[h, w]`` [m] on a grid, NaN = none, and only those that images show; None = all of them."""


@dataclass(frozen=True)
class HeldSurface:
    """Heights ``[H, W]`` [m] of a grid, and which of them images show, or None."""

    heights: np.ndarray
    grid: Grid
    measured: np.ndarray | None = None
    name: str = "prediction"

    def __post_init__(self) -> None:
        for what, array in ((self.name, self.heights), ("measured cells", self.measured)):
            if array is not None and array.shape != self.grid.shape:
                raise InputError(f"{what}: found shape {array.shape}, expected {self.grid.shape} as the grid has")

    def on(self, where: Grid) -> tuple[np.ndarray, np.ndarray | None]:
        """See `Surface`."""
        found = window_around(self.grid, where)
        if found is None:
            return _nothing(where, self.measured is not None)
        measured = None if self.measured is None else self.measured[found]
        return _both(self.heights[found], self.grid.part(*found), measured, where)


@dataclass(frozen=True)
class FiledSurface:
    """Heights [m] of a file, and the file on the same grid that says which of them images show, or None."""

    path: Path
    validity: Path | None = None

    @property
    def name(self) -> str:
        """The file's."""
        return str(self.path)

    def check(self) -> None:
        """Raises InputError where a file is no raster of heights on Earth, or the two are on different grids."""
        check_heights(self.path, one_band=True)
        if self.validity is None:
            has_grid(self.path)  # turned and oblong cells are warped, but they have to lie somewhere
        elif raster_grid(self.validity) != raster_grid(self.path):
            raise InputError(f"{self.validity}: found another grid than the DSM's, expected the same")

    def on(self, where: Grid) -> tuple[np.ndarray, np.ndarray | None]:
        """See `Surface`."""
        if self.validity is None and not has_grid(self.path):
            return warped_heights(self.path, where, means=True), None
        found = read_around(self.path, where)
        if found is None:
            return _nothing(where, self.validity is not None)
        array, grid = found
        measured = None if self.validity is None else read_raster(self.validity, grid)[0][0] == MEASURED
        return _both(known_heights(array[0]), grid, measured, where)


def _nothing(where: Grid, measured: bool) -> tuple[np.ndarray, np.ndarray | None]:
    nothing = np.full(where.shape, np.nan, np.float32)
    return nothing, nothing if measured else None


def _both(
    heights: np.ndarray, grid: Grid, measured: np.ndarray | None, where: Grid
) -> tuple[np.ndarray, np.ndarray | None]:
    """Heights on a grid; over larger cells their means, or a DSM would be charged with the blur of a wide kernel."""
    only = None
    if measured is not None:
        only = reproject_map(np.where(measured, heights, np.float32(np.nan)), grid, where, means=True)
    return reproject_map(heights, grid, where, means=True), only


def compare_surface(surface: Surface, truth: Truth, method: Method = "ncc", folder: Path | None = None) -> Comparison:
    """Register and score a surface.

    Args:
        surface: the prediction.
        truth: the reference.
        method: of the registration.
        folder: for temporary files; None = the system's.

    Returns:
        The comparison, whose differences are a map that is read by rows (`sattools.scene.stored`).

    Raises:
        InputError: nothing can be compared.
    """
    grid = truth.grid
    reference = truth.scored()
    if not any(np.isfinite(reference[rows]).any() for rows in pieces(grid.shape)):
        raise InputError(f"{truth.source}: found no height to score by, expected some ({truth.mask_text()})")
    margin = search_margin(grid.shape) if method in ("ncc", "nuth-kaab") else 0
    around = grid.widened(margin)
    wide, only, found = new_map(around.shape, np.float32, folder), None, False
    for rows, cols in cut(around.shape):
        try:
            heights, measured = surface.on(around.part(rows, cols))
        except SceneError as error:  # CRS of different worlds
            raise InputError(f"{surface.name}: {error}") from error
        wide[rows, cols] = heights
        found = found or bool(np.isfinite(heights).any())
        if measured is not None:
            only = new_map(around.shape, np.float32, folder) if only is None else only
            only[rows, cols] = measured
    if not found:
        raise InputError(f"{surface.name}: found no height where the reference {truth.name} lies, expected overlap")
    try:
        shift = register(wide, reference, method, margin)
    except InputError as error:
        raise InputError(_named(str(error), surface.name, truth.source)) from None
    complete = fill_holes(wide)

    def moved(rows: slice) -> Rows:
        by = (shift.columns, shift.rows, margin, rows)
        known = None if only is None else np.isfinite(shifted(only, *by))
        return shifted(wide, *by) + shift.up, shifted(complete, *by, beyond=True) + shift.up, known

    figures, difference = errors_of(moved, reference, truth.classes, grid.cell_size, limited=method != "none")
    figures |= {
        "shift_m": [round(value, 4) for value in shift.metres(grid.cell_size)],
        "registration": {"method": shift.method, "correlation": shift.correlation, "peak_cells": shift.peak},
        "protocol": truth.protocol,
        "reference": truth.name,
        "mask": truth.mask_text(),
    }
    notes = of_registration(wide, reference, shift, margin, grid)
    return Comparison(figures, difference, grid, shift, tuple(notes), in_other_unit(wide, reference, shift, margin))


def _named(text: str, surface: str, reference: str) -> str:
    """What is said of "prediction" and "reference" with their files' names."""
    for what, name in (("prediction:", f"{surface}:"), ("reference:", f"{reference}:")):
        if text.startswith(what):
            return text.replace(what, name, 1).replace("the reference,", f"{reference},")
    return text


__all__ = ["Comparison", "FiledSurface", "HeldSurface", "Method", "Surface", "compare_surface"]

"""Surfaces of scenes that overlap, joined into one."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from sattools.compare.metrics import nmad
from sattools.errors import InputError, SceneError
from sattools.progress import Progress, silent
from sattools.scene.cog import CogWriter
from sattools.scene.document import Scene
from sattools.scene.files import write_text
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import datum_tag, raster_grid, raster_vertical, read_on, read_raster

log = logging.getLogger(__name__)
HEIGHTS = "dsm"
MAPS = (HEIGHTS, "dsm_std", "dsm_error95")  # where all scenes have them
SEAMS = "seams.json"
FILES = (*(f"{name}.tif" for name in MAPS), SEAMS)  # at most
ROWS = 256  # of the whole that are put together at a time
LARGE_STEP_M = 0.5  # between two scenes that should know the same ground


@dataclass(frozen=True)
class Part:
    """A scene that is joined with others.

    Attributes:
        scene: its document, with a DSM.
        grid: of the DSM.
    """

    scene: Scene
    grid: Grid

    def weights(self, where: Grid) -> np.ndarray:
        """``[h, w]`` of cells of a grid in the same CRS: the distance to the border [m], 0 outside.

        They pass from one scene to the next over the whole of what the two share.
        """
        west, south, east, north = self.grid.bounds
        x, y = where.x(), where.y()
        return np.maximum(
            np.minimum(np.minimum(x - west, east - x)[None, :], np.minimum(y - south, north - y)[:, None]), 0.0
        )


def join(scenes: Sequence[Scene], out: Path, progress: Progress = silent) -> JsonObject:
    """Write the surfaces of scenes as one, and how far they are from each other where they overlap.

    Args:
        scenes: exported ones in the same CRS, on cells of any lattice.
        out: folder for ``dsm.tif``, the other maps that all of them have, and ``seams.json``.
        progress: told the share done and what is being done.

    Returns:
        ``scenes``, ``maps`` and ``seams``: of every pair that overlaps ``a``, ``b``, ``cells``, ``median_m`` and
        ``nmad_m`` of the height of b above that of a.

    Raises:
        SceneError: a scene without a DSM.
        InputError: CRS or vertical datums that differ.
    """
    parts = [_part(scene) for scene in scenes]
    whole = _whole(parts)
    vertical = _vertical(parts)
    seams = [found for a, b in combinations(parts, 2) if (found := seam(a, b)) is not None]
    names = [name for name in MAPS if all(name in part.scene.products for part in parts)]
    datum = datum_tag(_file(parts[0], HEIGHTS))
    with ExitStack() as stack:
        writers = {
            name: stack.enter_context(
                CogWriter(
                    out / f"{name}.tif", whole, units="m",
                    tags={"VERTICAL_DATUM": datum} if datum and name == HEIGHTS else None,
                    vertical=vertical if name == HEIGHTS else None,
                )
            )
            for name in names
        }  # fmt: skip
        for first in range(0, whole.height, ROWS):
            progress(first / whole.height, "joining")
            rows = slice(first, min(first + ROWS, whole.height))
            strip = whole.part(rows, slice(0, whole.width))
            for name, writer in writers.items():
                writer.write(_strip(parts, name, strip), rows)
    result = {"scenes": [part.scene.id for part in parts], "maps": names, "seams": seams}
    write_text(out / SEAMS, json.dumps(result, indent=1) + "\n")
    return result


def seam(a: Part, b: Part) -> JsonObject | None:
    """How far two scenes are from each other where both know a height; None where nowhere. See `join`."""
    low, high = np.maximum(a.grid.bounds[:2], b.grid.bounds[:2]), np.minimum(a.grid.bounds[2:], b.grid.bounds[2:])
    if (high <= low).any():
        return None
    rows, cols = a.grid.window(Grid.from_bounds(a.grid.crs, (*low, *high), a.grid.cell_size))
    shared = a.grid.part(rows, cols)
    heights, _ = read_raster(_file(a, HEIGHTS), shared)
    difference = read_on(_file(b, HEIGHTS), shared)[0] - heights[0]
    known = difference[np.isfinite(difference)]
    if not known.size:
        return None
    median = float(np.median(known))
    if abs(median) > LARGE_STEP_M:
        log.warning(
            "%s lies %+.2f m above %s where they overlap: a table [align] in the configuration brings both onto one "
            "reference", b.scene.id, median, a.scene.id,
        )  # fmt: skip
    return {"a": a.scene.id, "b": b.scene.id, "cells": int(known.size), "median_m": median, "nmad_m": nmad(known)}


def _part(scene: Scene) -> Part:
    if HEIGHTS not in scene.products:
        raise SceneError(f"scene {scene.id}: found no DSM, expected one made by `sattools export`")
    return Part(scene, raster_grid(scene.path(scene.products[HEIGHTS])))


def _file(part: Part, name: str) -> Path:
    return part.scene.path(part.scene.products[name])


def _whole(parts: Sequence[Part]) -> Grid:
    """The grid around all, on the smallest of their cells."""
    others = [part for part in parts if part.grid.crs != parts[0].grid.crs]
    if others:
        raise InputError(
            f"scene {others[0].scene.id}: found {others[0].grid.crs}, expected {parts[0].grid.crs} as of "
            f"{parts[0].scene.id}: only scenes in one CRS are joined (`prep --crs`)"
        )
    bounds = np.array([part.grid.bounds for part in parts])
    box = (*bounds[:, :2].min(axis=0).tolist(), *bounds[:, 2:].max(axis=0).tolist())
    return Grid.from_bounds(parts[0].grid.crs, box, min(part.grid.cell_size for part in parts))


def _vertical(parts: Sequence[Part]) -> str | None:
    """The vertical CRS that all share; None = heights above the ellipsoid."""
    found = [raster_vertical(_file(part, HEIGHTS)) for part in parts]
    for part, own in zip(parts, found, strict=True):
        if own != found[0]:
            raise InputError(
                f"scene {part.scene.id}: found heights above {own or 'the ellipsoid'}, expected "
                f"{found[0] or 'the ellipsoid'} as of {parts[0].scene.id}"
            )
    return found[0]


def _strip(parts: Sequence[Part], name: str, strip: Grid) -> np.ndarray:
    """A map of the whole on some of its rows ``[h, w]``; NaN where no scene knows it."""
    total, weight = np.zeros(strip.shape), np.zeros(strip.shape)
    for part in parts:
        share = part.weights(strip)
        if not share.any():
            continue
        values = read_on(_file(part, name), strip)[0]
        share = np.where(np.isfinite(values), share, 0.0)
        total += share * np.nan_to_num(values)
        weight += share
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0, total / weight, np.nan).astype(np.float32)


__all__ = ["MAPS", "SEAMS", "join", "seam"]

"""Surfaces of scenes that overlap, joined into one."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from sattools.compare.metrics import nmad
from sattools.errors import InputError, SceneError
from sattools.progress import Progress, silent
from sattools.scene.cog import CogWriter
from sattools.scene.document import Scene
from sattools.scene.files import write_text
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import datum_tag, raster_grid, raster_vertical, read_on, read_overview, read_raster
from sattools.scene.regrid import sample_map
from sattools.scene.validity import FILLED, LEVELLED, MEANING, MEASURED, UNSEEN, UNWANTED

log = logging.getLogger(__name__)
HEIGHTS, VALIDITY = "dsm", "validity"
MAPS = (HEIGHTS, "dsm_std", "dsm_error95")  # where all scenes have them
SEAMS = "seams.json"
FILES = (*(f"{name}.tif" for name in (*MAPS, VALIDITY)), SEAMS)  # at most
ROWS = 256  # of the whole that are put together at a time
LARGE_STEP_M = 0.5  # between two scenes that should know the same ground
# of weights, which are distances to the border [m]: the least, and the share that what is not measured has of its own;
# over 10 km that is still nothing beside the former
FAINT, UNMEASURED_SHARE = 1e-6, 1e-15


@dataclass(frozen=True)
class Part:
    """A scene that is joined with others.

    Attributes:
        scene: its document, with a DSM.
        grid: of the DSM.
        inside: ``[h, w]``, the distance to the border of what two images reach [m], which may end within the grid.
        looked_at: grid of ``inside``, whose cells may be larger than the DSM's.
    """

    scene: Scene
    grid: Grid
    inside: np.ndarray
    looked_at: Grid

    @classmethod
    def of(cls, scene: Scene) -> Part:
        """Raises SceneError where a scene has no DSM."""
        if HEIGHTS not in scene.products:
            raise SceneError(f"scene {scene.id}: found no DSM, expected one made by `sattools export`")
        heights = scene.path(scene.products[HEIGHTS])
        maps, looked_at = read_overview(heights)
        reached = np.isfinite(maps[0])
        if VALIDITY in scene.products:
            # `export --fill` has heights of what is unseen
            reached &= read_overview(scene.path(scene.products[VALIDITY]))[0][0] != UNSEEN
        return cls(scene, raster_grid(heights), inner_distance(reached, looked_at.cell_size), looked_at)

    def read(self, name: str, where: Grid) -> np.ndarray:
        """A map ``[h, w]`` on another grid in the same CRS; NaN where it is not known."""
        return read_on(self.file(name), where)[0]

    def measured(self, where: Grid) -> np.ndarray:
        """``[h, w]``, bool: which cells of a grid are measured; all, if the scene does not say."""
        if VALIDITY not in self.scene.products:
            return np.ones(where.shape, bool)
        return self.codes(where) == MEASURED

    def codes(self, where: Grid) -> np.ndarray:
        """Map ``validity`` ``[h, w]`` on another grid in the same CRS; NaN outside."""
        return read_on(self.file(VALIDITY), where, nearest=True)[0]

    def file(self, name: str) -> Path:
        """Where a map lies."""
        return self.scene.path(self.scene.products[name])

    def weights(self, where: Grid) -> np.ndarray:
        """``[h, w]`` of cells of a grid in the same CRS, above 0; they are for where the scene knows a height.

        The distance to the border of what two images reach [m], so that they pass from one scene to the next over the
        whole of what the two share; of cells that are filled or laid level as water so little that measured ones of
        another scene win, even those at its border.
        """
        inside = np.maximum(sample_map(self.inside, self.looked_at, where, outside=0.0), FAINT)
        return inside * np.where(self.measured(where), 1.0, UNMEASURED_SHARE)


def inner_distance(known: np.ndarray, cell_size: float) -> np.ndarray:
    """Distance ``[H, W]`` float32 of cells' centres to the edge of the nearest unknown cell or the border [m].

    Args:
        known: ``[H, W]``, bool.
        cell_size: edge of a cell [m].
    """
    import cv2

    around = np.pad(known, 1).astype(np.uint8)
    cells = cv2.distanceTransform(around, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    distance: np.ndarray = np.maximum(cells - np.float32(0.5), 0) * np.float32(cell_size)
    return distance


def join(scenes: Sequence[Scene], out: Path, progress: Progress = silent) -> JsonObject:
    """Write the surfaces of scenes as one, and how far they are from each other where they overlap.

    Args:
        scenes: exported ones in the same CRS, on cells of any lattice.
        out: folder for ``dsm.tif``, the other maps and the ``validity.tif`` that all of them have, and ``seams.json``.
        progress: told the share done and what is being done.

    Returns:
        ``scenes``, ``maps`` and ``seams``: of every pair that overlaps ``a``, ``b``, ``cells``, ``median_m`` and
        ``nmad_m`` of the height of b above that of a, where both have measured it.

    Raises:
        SceneError: a scene without a DSM.
        InputError: CRS or vertical datums that differ.
    """
    parts = [Part.of(scene) for scene in scenes]
    whole = _whole(parts)
    vertical = _vertical(parts)
    seams = [found for a, b in combinations(parts, 2) if (found := seam(a, b)) is not None]
    names = [name for name in MAPS if all(name in part.scene.products for part in parts)]
    datum = datum_tag(parts[0].file(HEIGHTS))
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
        validity = None
        if all(VALIDITY in part.scene.products for part in parts):
            tags, path = {"MEANING": MEANING}, out / f"{VALIDITY}.tif"
            validity = stack.enter_context(CogWriter(path, whole, dtype=np.uint8, nodata=None, tags=tags))
        for first in range(0, whole.height, ROWS):
            progress(first / whole.height, "joining")
            rows = slice(first, min(first + ROWS, whole.height))
            strip = whole.part(rows, slice(0, whole.width))
            for name, writer in writers.items():
                writer.write(_strip(parts, name, strip), rows)
            if validity is not None:
                validity.write(_codes(parts, strip), rows)
    maps = names if validity is None else [*names, VALIDITY]
    for name in {*MAPS, VALIDITY} - {*maps}:  # of an earlier surface
        (out / f"{name}.tif").unlink(missing_ok=True)
    result = {"scenes": [part.scene.id for part in parts], "maps": maps, "seams": seams}
    write_text(out / SEAMS, json.dumps(result, indent=1) + "\n")
    return result


def seam(a: Part, b: Part) -> JsonObject | None:
    """How far two scenes are from each other where both have measured a height; None where nowhere. See `join`."""
    low, high = np.maximum(a.grid.bounds[:2], b.grid.bounds[:2]), np.minimum(a.grid.bounds[2:], b.grid.bounds[2:])
    if (high <= low).any():
        return None
    rows, cols = a.grid.window(Grid.from_bounds(a.grid.crs, (*low, *high), a.grid.cell_size))
    shared = a.grid.part(rows, cols)
    heights, _ = read_raster(a.file(HEIGHTS), shared)
    difference = b.read(HEIGHTS, shared) - heights[0]
    known = difference[np.isfinite(difference) & a.measured(shared) & b.measured(shared)]
    if not known.size:
        return None
    median = float(np.median(known))
    if abs(median) > LARGE_STEP_M:
        log.warning(
            "%s lies %+.2f m above %s where they overlap: a table [align] in the configuration brings both onto one "
            "reference", b.scene.id, median, a.scene.id,
        )  # fmt: skip
    return {"a": a.scene.id, "b": b.scene.id, "cells": int(known.size), "median_m": median, "nmad_m": nmad(known)}


def check_crs(found: Mapping[str, str]) -> None:
    """Raise InputError where the CRS of scenes, by their ids, differ; documents may spell one in several ways."""
    first = next(iter(found), "")
    for name, crs in found.items():
        if crs != found[first] and not _alike(crs, found[first]):
            raise InputError(
                f"scene {name}: found {crs}, expected {found[first]} as of {first}: only scenes in one CRS are joined "
                "(`prep --crs`)"
            )


def _alike(a: str, b: str) -> bool:
    try:
        return bool(CRS.from_user_input(a) == CRS.from_user_input(b))
    except CRSError:
        return False


def _whole(parts: Sequence[Part]) -> Grid:
    """The grid around all, on the smallest of their cells."""
    check_crs({part.scene.id: part.grid.crs for part in parts})
    bounds = np.array([part.grid.bounds for part in parts])
    box = (*bounds[:, :2].min(axis=0).tolist(), *bounds[:, 2:].max(axis=0).tolist())
    return Grid.from_bounds(parts[0].grid.crs, box, min(part.grid.cell_size for part in parts))


def _vertical(parts: Sequence[Part]) -> str | None:
    """The vertical CRS that all share; None = heights above the ellipsoid."""
    found = [raster_vertical(part.file(HEIGHTS)) for part in parts]
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
        values = part.read(name, strip)
        known = np.isfinite(values)
        if not known.any():
            continue
        share = np.where(known, part.weights(strip), 0.0)
        total += share * np.nan_to_num(values)
        weight += share
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0, total / weight, np.nan).astype(np.float32)


def _codes(parts: Sequence[Part], strip: Grid) -> np.ndarray:
    """Validity of the whole on some of its rows ``[h, w]``: the best that any scene says, nobody's cells unseen."""
    ranks = (UNWANTED, UNSEEN, FILLED, LEVELLED, MEASURED)
    best = np.full(strip.shape, -1, np.int8)
    for part in parts:
        own = part.codes(strip)
        for rank, code in enumerate(ranks):
            best[(own == code) & (best < rank)] = rank
    return np.array([*ranks, UNSEEN], np.uint8)[best]


__all__ = ["FILES", "MAPS", "SEAMS", "Part", "check_crs", "inner_distance", "join", "seam"]

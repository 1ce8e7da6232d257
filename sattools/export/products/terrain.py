"""Terrain model: the bare ground under the exported surface, where it was seen, and what stands how high on it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sattools.export.blocks import Block, blocks
from sattools.export.ground import ALIGNED, BareGround, bare_ground
from sattools.export.products.maps import Maps
from sattools.progress import Progress
from sattools.scene.cog import CogWriter
from sattools.scene.jsonio import JsonObject
from sattools.scene.validity import LEVELLED, MEASURED, UNSEEN, UNWANTED

EDGE = 1024  # cells of a block: as much again is looked at around it, which costs smaller ones twice the time
TRUSTED = 0.4  # least probability of less than 1 m of error that makes a height worth taking for the ground's
SEEN, INTERPOLATED = 1, 2
MEANING = (
    "1 = the surface is the ground; 2 = interpolated: under trees or buildings, beside them, or where matching is not "
    "to be trusted; 0 = unseen; 3 = outside the area that was asked for"
)
_SOFTWARE = {"SOFTWARE": "sattools"}


def write_terrain(
    files: Mapping[str, Path], maps: Maps, width: float, vertical: tuple[str | None, str], progress: Progress
) -> JsonObject:
    """Write `dtm`, `dtm_validity` and `ndsm`, block by block; figures for the history.

    Args:
        files: to write, by product.
        maps: with the DSM; validity and probability are used where they are known.
        width: of the widest building [m].
        vertical: CRS of the heights, None = above the ellipsoid; what they are above in words.
        progress: told the share done.
    """
    crs, datum = vertical
    about: dict[str, dict[str, Any]] = {
        "dtm": {
            "units": "m",
            "tags": {"VERTICAL_DATUM": datum, "METHOD": f"bare ground, objects up to {width:g} m wide", **_SOFTWARE},
            "descriptions": ["height of the ground"],
            "vertical": crs,
        },
        "dtm_validity": {
            "dtype": np.uint8,
            "nodata": None,
            "tags": {"MEANING": MEANING, **_SOFTWARE},
            "descriptions": ["validity of the ground"],
        },
        "ndsm": {"units": "m", "tags": dict(_SOFTWARE), "descriptions": ["height above the ground"]},
    }
    counts = np.zeros(4, np.int64)
    with ExitStack() as stack:
        writers = {name: stack.enter_context(CogWriter(files[name], maps.grid, **about[name])) for name in about}
        pieces = blocks(maps.grid, edge=EDGE)
        for k, block in enumerate(pieces):
            progress(k / len(pieces), "ground")
            surface, ground, validity = terrain_of(maps, block, width)
            writers["dtm"].write(ground, block.rows, block.cols)
            writers["dtm_validity"].write(validity, block.rows, block.cols)
            writers["ndsm"].write(surface - ground, block.rows, block.cols)
            counts += np.bincount(validity.ravel(), minlength=4)
    shown = max(int(counts[[SEEN, INTERPOLATED]].sum()), 1)
    return {
        "seen": round(float(counts[SEEN] / shown), 4),
        "interpolated": round(float(counts[INTERPOLATED] / shown), 4),
    }


def terrain_of(
    maps: Maps, block: Block, width: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Surface, ground [m] and its validity ``[h, w]`` of a block; no-data where the surface has none.

    Args:
        maps: see `write_terrain`.
        block: of the surface.
        width: of the widest building [m].
    """
    reach = 2 * math.ceil(width / maps.grid.cell_size)  # of an erosion and a dilation, and as much to interpolate from
    rows, cols = (
        slice(max(0, (part.start - reach) // ALIGNED * ALIGNED), min(size, part.stop + reach))
        for part, size in zip((block.rows, block.cols), maps.grid.shape, strict=True)
    )
    own = tuple(slice(b.start - w.start, b.stop - w.start) for b, w in zip((block.rows, block.cols), (rows, cols)))
    surface, found = _ground(maps, rows, cols, width)
    height = surface[own]
    known = np.isfinite(height)
    validity = np.where(known, np.where(found.seen[own], SEEN, INTERPOLATED), UNSEEN).astype(np.uint8)
    if "validity" in maps.paths:
        of_surface = maps.read("validity", block.rows, block.cols)[0]
        validity[(of_surface == LEVELLED) & known] = INTERPOLATED
        validity[of_surface == UNWANTED] = UNWANTED
    return height, np.where(known, found.height[own], np.float32(np.nan)), validity


def _ground(maps: Maps, rows: slice, cols: slice, width: float) -> tuple[NDArray[np.float32], BareGround]:
    surface = maps.read("dsm", rows, cols)[0].astype(np.float32)
    trusted = np.isfinite(surface)
    if "validity" in maps.paths:
        # water is ground: without it, what lies between its shores would be a continuation of what rises from them
        trusted &= np.isin(maps.read("validity", rows, cols)[0], (MEASURED, LEVELLED))
    if "probability" in maps.paths:
        trusted &= ~(maps.read("probability", rows, cols)[0] < TRUSTED)
    return surface, bare_ground(surface, trusted, maps.grid.cell_size, width)


__all__ = ["INTERPOLATED", "SEEN", "terrain_of", "write_terrain"]

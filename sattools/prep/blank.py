"""Images that show one number all over the area, as saturated ones do: nothing could be matched in them."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np

from sattools.camera.ground import project
from sattools.camera.rpc import RPC
from sattools.errors import InputError
from sattools.prep.images import SourceImage
from sattools.prep.large import GrayImages
from sattools.scene.grid import Grid

SAMPLED = 250_000  # cells that are looked at
LEAST = 100  # of them that an image has to show; so few others may be alike by chance


def check_contents(
    sources: Sequence[SourceImage],
    rpcs: Sequence[RPC],
    whole: GrayImages,
    area: tuple[Grid, float],
    used: Collection[str],
) -> None:
    """Raise InputError for an image in which all of the area is one number, whatever there is around it.

    Args:
        sources: the images.
        rpcs: their cameras.
        whole: their pixels.
        area: its grid, and the height of its ground [m].
        used: ids of the images that will be trained on; others may show what they like.
    """
    grid, height = area
    step = math.ceil(math.sqrt(grid.width * grid.height / SAMPLED))
    x, y = np.meshgrid(grid.x()[::step], grid.y()[::step])
    for source, rpc, gray in zip(sources, whole.cameras(rpcs), whole.grays, strict=True):
        if source.id not in used:
            continue
        col, row = (np.nan_to_num(np.round(place), nan=-1.0) for place in project(rpc, grid.crs, x, y, height))
        inside = (col >= 0) & (col < gray.shape[1]) & (row >= 0) & (row < gray.shape[0])
        shown = gray[row[inside].astype(int), col[inside].astype(int)]
        known = shown[np.isfinite(shown)]
        if known.size >= LEAST and known.min() == known.max():
            raise InputError(
                f"{source.path}: found {known[0]:g} everywhere in the area, expected an image of it (leave it out)"
            )


__all__ = ["check_contents"]

"""Reading a scene's images with their cameras and suns."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sattools.camera.rpc import RPC
from sattools.errors import SceneError
from sattools.radiometry import item_bits, linear_radiance
from sattools.scene import Grid, Item, Scene
from sattools.scene.raster import read_image
from sattools.views.resample import View, make_view

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Source:
    """One image with its camera: radiance ``[C, h, w]`` float32 (NaN = invalid), sun (azimuth, elevation) or None."""

    id: str
    radiance: np.ndarray
    rpc: RPC
    sun: tuple[float, float] | None
    linear: bool = True


def load_sources(scene: Scene, items: Sequence[Item]) -> list[Source]:
    """Read the radiance (asset `radiance`, else the normalised `image`) and the camera of every item.

    Raises:
        SceneError: an item without image or camera, or images with different numbers of bands.
        InputError: a file that cannot be read.
    """
    sources = []
    for item in items:
        if "rpc" not in item.assets:
            raise SceneError(f"scene {scene.id}: item {item.id} has no asset 'rpc', expected a corrected camera")
        rpc = RPC.from_file(scene.path(item.assets["rpc"].href))
        if "radiance" in item.assets:
            radiance = read_image(scene.path(item.assets["radiance"].href))
        elif "image" in item.assets:
            numbers = read_image(scene.path(item.assets["image"].href))
            radiance = linear_radiance(numbers, item_bits(item.properties))
        else:
            raise SceneError(f"scene {scene.id}: item {item.id} has no asset 'image' or 'radiance'")
        if item.sun is None:
            log.warning("%s: sun unknown: no cast shadows for this image", item.id)
        # `normalise` says so where it left a tone-mapped image as it was
        toned = item.properties.get("sattools:tone") == "tone-mapped"
        linear = not toned and ("radiance" in item.assets or item_bits(item.properties) > 8)
        sources.append(Source(item.id, radiance, rpc, item.sun, linear))
    bands = {s.radiance.shape[0] for s in sources}
    if len(bands) > 1:
        raise SceneError(f"scene {scene.id}: found images of {sorted(bands)} bands, expected the same number in all")
    return sources


def views_on(sources: Sequence[Source], grid: Grid, z_ref: float, z_range: tuple[float, float]) -> list[View]:
    """All sources resampled to a grid; see `make_view`.

    Raises:
        SceneError: an image shows nothing of the grid.
    """
    views = [make_view(s.id, s.radiance, s.rpc, grid, z_ref, z_range, s.sun) for s in sources]
    for view in views:
        check_seen(view.id, view.mask)
    return views


def check_seen(item_id: str, mask: np.ndarray) -> None:
    """Raise SceneError if an image shows nothing of the grid (an all-zero ``mask`` of any shape)."""
    if not mask.any():
        raise SceneError(
            f"image {item_id}: found no valid pixel on the scene's grid, expected an image of this place "
            "(hold it out to go on without it)"
        )


__all__ = ["Source", "check_seen", "load_sources", "views_on"]

"""Rendered views of a scene against the images themselves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sattools.compare.metrics import WINDOW_PX, ImageErrors, image_errors
from sattools.errors import InputError, MissingProductError
from sattools.radiometry.bands import BANDS_MEMBER, chosen_bands
from sattools.radiometry.linear import linear_radiance, shared_bits
from sattools.scene.document import Item, Scene
from sattools.scene.jsonio import JsonObject
from sattools.scene.pixels import image_part
from sattools.scene.raster import image_shape, read_image
from sattools.scene.stored import pieces

AT_ONCE = 4_000_000  # pixels of images that are compared as a whole
SCORED = "rendered_scored"  # asset: where a view may be scored, that took its gain and offset from the image elsewhere
FIGURES = ("psnr", "ssim", "lpips", "avg", "avg_geometric")


def compare_views(scene: Scene, weights: Sequence[str] = ()) -> JsonObject:
    """Image figures of every item with a `rendered` asset against its radiance, and their means.

    The radiance is the asset `radiance`, else the linear numbers of `image`. Raises SceneError where there is none.

    Args:
        scene: holds the items.
        weights: files with those of LPIPS.
    """
    views: dict[str, dict[str, float | None]] = {}
    check_views(scene)
    for item in scene.items:
        if _is_rendered(item):
            figures = _figures(scene, item, weights)
            role = "test" if item.held_out else "train"
            views[item.id] = {"role": role, **figures}  # type: ignore[dict-item]
    held_out = [figures for figures in views.values() if figures["role"] == "test"] or list(views.values())
    means: dict[str, Any] = {}
    for key in FIGURES:
        values = [figures[key] for figures in held_out]
        known = [value for value in values if value is not None]
        means[key] = float(np.mean(known)) if len(known) == len(values) else None
    return {**means, "views": views}


def check_views(scene: Scene) -> None:
    """Raise SceneError where no item has a rendered view to score."""
    if not any(_is_rendered(item) for item in scene.items):
        expected = "expected some made by `sattools export --view ID`"
        raise MissingProductError(f"scene {scene.id}: found no rendered view, {expected}")


def _is_rendered(item: Item) -> bool:
    return "rendered" in item.assets and bool({"radiance", "image"} & item.assets.keys())


def _figures(scene: Scene, item: Item, weights: Sequence[str]) -> dict[str, float | None]:
    """Figures of an item's rendered image; of a large one by rows, without LPIPS unless weights are given."""
    shown = item.assets["rendered"]
    path, own = scene.path(shown.href), image_part(scene, item, "radiance" if "radiance" in item.assets else "image")
    height, width = own.shape
    if image_shape(path) != own.shape:
        found = " x ".join(map(str, image_shape(path)))
        raise InputError(f"{path}: found {found} pixels, expected {height} x {width} as the image has")
    scored = scene.path(item.assets[SCORED].href) if SCORED in item.assets else None
    if scored is not None and image_shape(scored) != own.shape:
        raise InputError(f"{scored}: found another size than the image's, expected {height} x {width} pixels")
    bands = [number - 1 for number in chosen_bands(item, shown.extra.get(BANDS_MEMBER, []), own.bands)]

    def read(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        window = rows, slice(0, width)
        radiance = own.read(window)
        if "radiance" not in item.assets:
            radiance = linear_radiance(radiance, shared_bits(item, scene.items))
        picture = read_image(path, window)
        if scored is not None:
            picture = np.where(np.isfinite(read_image(scored, window)), picture, np.float32(np.nan))
        return picture, radiance[bands]

    if weights or height * width <= AT_ONCE:
        return image_errors(*read(slice(0, height)), weights=weights)
    errors = ImageErrors()
    for rows in pieces(own.shape):
        around = slice(max(0, rows.start - WINDOW_PX), min(height, rows.stop + WINDOW_PX))
        errors.add(*read(around), slice(rows.start - around.start, rows.stop - around.start))
    return errors.figures()


__all__ = ["FIGURES", "check_views", "compare_views"]

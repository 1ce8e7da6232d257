"""Rendered views of a scene against the images themselves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sattools.compare.metrics import image_errors
from sattools.errors import SceneError
from sattools.radiometry.bands import BANDS_MEMBER, chosen_bands
from sattools.scene.document import Item, Scene
from sattools.scene.jsonio import JsonObject
from sattools.scene.pixels import image_part
from sattools.scene.raster import read_image

FIGURES = ("psnr", "ssim", "lpips", "avg", "avg_geometric")


def compare_views(scene: Scene, weights: Sequence[str] = ()) -> JsonObject:
    """Image figures of every item with a `rendered` asset against its radiance, and their means.

    The radiance is the asset `radiance`, else the linear numbers of `image`. Raises SceneError where there is none.

    Args:
        scene: holds the items.
        weights: files with those of LPIPS.
    """
    views: dict[str, dict[str, float | None]] = {}
    for item in scene.items:
        if "rendered" in item.assets and {"radiance", "image"} & item.assets.keys():
            shown = item.assets["rendered"]
            rendered, radiance = read_image(scene.path(shown.href)), _radiance(scene, item)
            fitted = chosen_bands(item, shown.extra.get(BANDS_MEMBER, []), len(radiance))
            radiance = radiance[[number - 1 for number in fitted]]
            role = "test" if item.held_out else "train"
            views[item.id] = {"role": role, **image_errors(rendered, radiance, weights=weights)}  # type: ignore[dict-item]
    if not views:
        raise SceneError(f"scene {scene.id}: found no rendered view, expected some made by `sattools export --view ID`")
    held_out = [figures for figures in views.values() if figures["role"] == "test"] or list(views.values())
    means: dict[str, Any] = {}
    for key in FIGURES:
        values = [figures[key] for figures in held_out]
        known = [value for value in values if value is not None]
        means[key] = float(np.mean(known)) if len(known) == len(values) else None
    return {**means, "views": views}


def _radiance(scene: Scene, item: Item) -> np.ndarray:
    from sattools.radiometry.linear import item_bits, linear_radiance

    if "radiance" in item.assets:
        return read_image(scene.path(item.assets["radiance"].href))
    return linear_radiance(image_part(scene, item).read(), item_bits(item.properties))


__all__ = ["FIGURES", "compare_views"]

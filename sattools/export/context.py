"""What every part of `export` needs: the scene, its fitted model, and where that may be shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sattools.fit.described import Description, Sun
from sattools.radiometry.bands import chosen_bands
from sattools.scene import Scene
from sattools.scene.dependencies import current_entry
from sattools.scene.jsonio import JsonObject

RELIT = "export/relit.tif"


@dataclass(frozen=True)
class Exported:
    """A fitted model and where it may be shown.

    Attributes:
        scene: gets the files.
        about: what the model is.
        valid: ``[H, W]`` bool, cells that get values; all others are no-data.
    """

    scene: Scene
    about: Description
    valid: np.ndarray

    def shown(self, maps: np.ndarray) -> np.ndarray:
        """Maps ``[..., H, W]`` of any unit, with NaN in cells of no data."""
        return np.where(self.valid, maps, np.nan)

    def band_names(self, name: str, count: int) -> tuple[list[str], dict[str, str]]:
        """Descriptions of a map's spectral bands, and tags with their wavelengths where `normalise` knew the bands.

        Args:
            name: of the map.
            count: its bands.

        Returns:
            ``["albedo red", ...]``, or the numbers of the images' bands from 1; ``{"WAVELENGTHS_UM": "0.66 ..."}`` or
            nothing.
        """
        return band_names(self.scene, self.about, name, count)


def band_names(scene: Scene, model: Description, name: str, count: int) -> tuple[list[str], dict[str, str]]:
    """See `Exported.band_names`.

    Args:
        scene: with the images.
        model: of the fit.
        name: of the map.
        count: its bands.
    """
    bands = _bands_of(scene, model)
    if len(bands) != count:
        own = model.bands if len(model.bands) == count else range(1, count + 1)
        return [f"{name} {band}" for band in own], {}
    words = [str(band.get("common_name", band.get("name"))) for band in bands]
    lengths = [band.get("center_wavelength") for band in bands]
    known = all(isinstance(length, int | float) for length in lengths)
    tags = {"WAVELENGTHS_UM": " ".join(f"{length:g}" for length in lengths)} if known else {}
    return [f"{name} {word}" for word in words], tags


def radiance_scale(model: Description) -> str:
    """What the numbers of a fit's albedo and of the scene under another sun are."""
    return (
        f"absolute: {model.radiance}"
        if model.absolute
        else "relative: radiance of the first training image in full sun"
    )


def _bands_of(scene: Scene, model: Description) -> list[JsonObject]:
    """STAC `eo:bands` of a model's bands, where those of the images are known."""
    for item in scene.items:
        asset = (item.assets.get("radiance") or item.assets.get("image")) if item.id in model.items else None
        if asset is not None and (bands := asset.extra.get("eo:bands")):
            return [bands[number - 1] for number in chosen_bands(item, model.bands, len(bands))]
    return []


def follows_prior(scene: Scene) -> bool:
    """Whether the fit has used the scene's prior: what that says of its heights says nothing of others."""
    options = (current_entry(scene, "fit") or {}).get("options")
    if not isinstance(options, dict):
        return True
    begun = options.get("field") != "surface" and options.get("start") == "prior"
    return begun or options.get("prior_weight") != 0


def view_href(name: str, item_id: str) -> str:
    """Where a map or picture of an image goes."""
    return f"export/{name}/{item_id}.tif"


def shadow_suns(model: Description) -> list[tuple[str, Sun]]:
    """Ids and suns (unit vectors) of the images whose shadows are known."""
    if model.shadow == "none":
        return []
    return [(name, sun) for name, sun in zip(model.items, model.suns, strict=True) if sun is not None]


__all__ = ["RELIT", "Exported", "band_names", "follows_prior", "radiance_scale", "shadow_suns", "view_href"]

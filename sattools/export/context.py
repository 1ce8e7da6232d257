"""What every part of `export` needs: the scene, its fitted model, and where that may be shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sattools.fit.model import FittedModel, Sun
from sattools.scene import Scene


@dataclass(frozen=True)
class Exported:
    """A fitted model and where it may be shown.

    Attributes:
        scene: gets the files.
        model: of the fit.
        valid: ``[H, W]`` bool, cells that get values; all others are no-data.
    """

    scene: Scene
    model: FittedModel
    valid: np.ndarray

    def shown(self, maps: np.ndarray) -> np.ndarray:
        """Maps ``[..., H, W]`` of any unit, with NaN in cells of no data."""
        return np.where(self.valid, maps, np.nan)


def shadow_suns(model: FittedModel) -> list[tuple[str, Sun]]:
    """Ids and suns (unit vectors) of the images whose shadows are known."""
    if model.shadow == "none":
        return []
    return [(name, sun) for name, sun in zip(model.items, model.suns, strict=True) if sun is not None]


__all__ = ["Exported", "shadow_suns"]

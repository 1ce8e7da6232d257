"""What the tiles of an area share: colours, light and poses of the images, and the surface around a tile.

All of it comes from a coarse fit of the whole area (see `sattools.fit.tiles.stage`), whose model file a tile's scene
names as its product ``coarse``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from sattools.errors import SceneError
from sattools.fit.described import COLOURS
from sattools.fit.model import FittedModel
from sattools.fit.resume import IlluminationOptions
from sattools.fit.surface.scene import SurfaceScene
from sattools.render.around import Around
from sattools.scene import Grid, Scene

PRODUCT = "coarse"


@dataclass(frozen=True)
class Coarse:
    """A coarse fit, as a tile sees it.

    Attributes:
        colours: gain, offset and ambient ``[V, C]`` and pose ``[V, 2]`` of the tile's images.
        illumination: how the light is modelled.
        height: ``[H, W]`` heights of the whole area [m]; grid: theirs.
        tile: the tile's grid.
    """

    colours: dict[str, Tensor]
    illumination: IlluminationOptions
    height: Tensor
    grid: Grid
    tile: Grid

    def hold(self, surface: SurfaceScene) -> SurfaceScene:
        """The surface with the colours and poses that all tiles share, fixed."""
        for name, value in self.colours.items():
            getattr(surface, name).copy_(value)
        surface.held = True
        return surface

    def around(self, own: Around | None) -> Around:
        """The whole area as what stands around the tile, with what its own prior knows better."""
        layers = ((self.height.numpy(), self.grid), *(own.layers if own else ()))
        return Around(layers, self.tile)


def read_coarse(scene: Scene, ids: Sequence[str]) -> Coarse | None:
    """The coarse fit of the area that a scene is a tile of; None where it is no tile.

    Raises:
        SceneError: it does not know one of the images.
        InputError: the model file is missing or damaged.
    """
    if PRODUCT not in scene.products:
        return None
    path = scene.path(scene.products[PRODUCT])
    model = FittedModel.load(path)
    unknown = [name for name in ids if name not in model.items]
    if unknown:
        raise SceneError(f"{path}: found no image {unknown[0]!r}, expected those of scene {scene.id}")
    which = [model.items.index(name) for name in ids]
    colours = {name: getattr(model, name)[which] for name in COLOURS}
    return Coarse(colours, model.illumination, model.height, model.grid, scene.require_grid())


__all__ = ["PRODUCT", "Coarse", "read_coarse"]

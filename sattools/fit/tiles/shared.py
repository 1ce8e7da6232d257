"""What the tiles of an area share: colours, light and poses of the images, and the surface around a tile.

All of it comes from a coarse fit of the whole area (see `sattools.fit.tiles.stage`), whose model file a tile's scene
names as its product ``coarse``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sattools.errors import SceneError
from sattools.fit.described import COLOURS
from sattools.fit.model import FittedModel
from sattools.fit.resume import IlluminationOptions
from sattools.fit.surface.scene import SurfaceScene
from sattools.render import sun_visibility
from sattools.scene import Grid, Scene
from sattools.scene.regrid import sample_map

PRODUCT = "coarse"


@dataclass(frozen=True)
class Coarse:
    """A coarse fit, as a tile sees it.

    Attributes:
        colours: gain, offset and ambient ``[V, C]`` and pose ``[V, 2]`` of the tile's images.
        illumination: how the light is modelled.
        height: ``[H, W]`` heights of the whole area [m]; grid: theirs.
        tile: the tile's grid; no shadow is looked for further away than its edge.
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

    def cast(self, height: Tensor, cell_size: float, sun: tuple[float, float, float]) -> Tensor:
        """`sun_visibility` of the tile's heights, with the coarse surface around them to cast shadows, too.

        Args:
            height: ``[H, W]`` [m].
            cell_size: edge of a cell [m].
            sun: unit vector (east, north, up) to the sun.
        """
        top, bottom = float(self.height.max()), min(float(self.height.min()), float(height.min()))
        across = math.hypot(sun[0], sun[1])
        if sun[2] <= 0 or across < 1e-6:
            return sun_visibility(height, cell_size, sun)
        longest = self.tile.cell_size * max(self.tile.shape)
        reach = min((top - bottom) * across / sun[2], longest) / across / cell_size
        east, north = math.ceil(abs(sun[0]) * reach), math.ceil(abs(sun[1]) * reach)
        rows, cols = height.shape
        # only what lies towards the sun can stand in its way
        up, left = (north if sun[1] > 0 else 0), (east if sun[0] < 0 else 0)
        wide = Grid(
            self.tile.crs, self.tile.left - left * cell_size, self.tile.top + up * cell_size, cell_size,
            cols + east, rows + north,
        )  # fmt: skip
        around = torch.from_numpy(sample_map(self.height.numpy(), self.grid, wide, outside=bottom))
        around[up : up + rows, left : left + cols] = height.detach().cpu()
        lit = sun_visibility(around, cell_size, sun)[up : up + rows, left : left + cols]
        return lit.contiguous().to(height.device)


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

"""How bright the images show the ground, on wide blocks of cells: what is plain there, as water is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sattools.camera.ground import crop_window
from sattools.prior.tones import LINEAR_TONE, toned
from sattools.prior.water import Looks, block_of
from sattools.scene import Grid, Item, Scene
from sattools.views import Opened, load_sources, make_view


def brightness_of_blocks(scene: Scene, items: Sequence[Item], images: Opened, grid: Grid) -> Looks:
    """What tells the mean brightness of blocks of `block_of` cells in every image, read from their files when asked.

    Args:
        scene: of the images.
        items: the images.
        images: what has been found of their files.
        grid: of the cells.

    Returns:
        A function of rows and columns of blocks and the height at which they are looked for [m above the ellipsoid]:
        ``[V, h, w]`` float32, linear images with a tone curve, NaN where an image does not show a block.
    """
    size = block_of(grid.cell_size)

    def looks(rows: slice, cols: slice, height: float) -> np.ndarray:
        cells = grid.part(slice(size * rows.start, size * rows.stop), slice(size * cols.start, size * cols.stop))
        blocks = replace(cells, cell_size=grid.cell_size * size, height=cells.height // size, width=cells.width // size)
        z_range = height, height + 1.0
        there = [
            k
            for k, (rpc, part) in enumerate(zip(images.cameras, images.parts, strict=True))
            if min(crop_window(rpc, grid.crs, blocks.bounds, z_range, part.shape, 0)[2:]) > 0
        ]
        opened = replace(
            images,
            names=[images.names[k] for k in there],
            cameras=[images.cameras[k] for k in there],
            parts=[images.parts[k] for k in there],
        )
        found = np.full((len(items), blocks.height, blocks.width), np.nan, np.float32)
        sources = load_sources(replace(scene, grid=blocks), [items[k] for k in there], opened)
        for k, source in zip(there, sources, strict=True):
            radiance = source.complete().radiance
            view = make_view(source.id, radiance, source.rpc, blocks, height, z_range, sun=None)
            grey = toned(view.target, LINEAR_TONE if source.linear else 1.0).mean(axis=-1)
            found[k] = np.where(view.mask > 0, grey, np.nan)
        return found

    return looks


__all__ = ["brightness_of_blocks"]

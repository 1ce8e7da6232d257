"""Which cells of a surface the images have really shown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from sattools.camera.ground import to_geographic
from sattools.render import sun_visibility
from sattools.scene import Grid, Scene
from sattools.views import Source, line_of_sight, load_sources

UNSEEN, MEASURED, FILLED = 0, 1, 2
MEANING = "1 = measured: two images see it; 2 = filled from neighbours: hidden from all but one; 0 = unseen"
NEEDED = 2  # images that a height takes
_STRIP_CELLS = 1_000_000


def validity_of(scene: Scene, ids: Sequence[str], grid: Grid, height: NDArray[np.float32]) -> NDArray[np.uint8] | None:
    """How every cell of a surface came by its height.

    Args:
        scene: with the images.
        ids: the images that the surface was made from.
        grid: of the surface.
        height: ``[H, W]`` [m above the ellipsoid], NaN = none.

    Returns:
        ``[H, W]``: 0 unseen = fewer than two images reach the cell; 2 filled = two reach it, but it is hidden from
        all of them but one by what stands around it; 1 measured = two see it. None where the scene does not name the
        images or cameras any more.

    Raises:
        InputError: an image or camera that cannot be read.
    """
    used = [item for item in scene.items if item.id in ids]
    if len(used) < len(ids) or not all("rpc" in i.assets and {"radiance", "image"} & i.assets.keys() for i in used):
        return None
    reached = np.zeros(grid.shape, np.uint16)
    seen = np.zeros(grid.shape, np.uint16)
    known = np.isfinite(height)
    level = np.where(known, height, np.nanmin(height)).astype(np.float32) if known.any() else np.zeros_like(height)
    surface = torch.from_numpy(level)
    low, high = float(level.min()), float(level.max())
    for item in used:
        (source,) = load_sources(scene, [item])
        shown = _shown(source, grid, level)
        slope, _ = line_of_sight(source.rpc, grid, low, (low, max(high, low + 1.0)))
        open_ = sun_visibility(surface, grid.cell_size, slope.unit()).numpy() >= 0.5
        reached += shown
        seen += shown & open_
    of_reached = np.where(seen >= NEEDED, MEASURED, FILLED)
    return np.where(known & (reached >= NEEDED), of_reached, UNSEEN).astype(np.uint8)


def _shown(source: Source, grid: Grid, height: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether an image has a valid pixel of a cell's surface point, hidden or not; every ray by the RPC itself."""
    valid = valid_pixels(source.radiance)
    rows, cols = valid.shape
    shown = np.zeros(grid.shape, bool)
    strip = max(1, _STRIP_CELLS // grid.width)
    for first in range(0, grid.height, strip):
        part = slice(first, min(first + strip, grid.height))
        x, y = np.meshgrid(grid.x(), grid.y()[part])
        lon, lat = to_geographic(grid.crs, x, y)
        col, row = source.rpc.projection(lon, lat, height[part].astype(np.float64))
        inside = (col >= -0.5) & (row >= -0.5) & (col < cols - 0.5) & (row < rows - 0.5)
        c, r = (np.where(inside, np.round(a), 0).astype(np.intp) for a in (col, row))
        shown[part] = inside & valid[r, c]
    return shown


def valid_pixels(image: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels ``[h, w]`` bool of an image ``[C, h, w]`` that show something.

    They are finite, and not of the frame of zeros in all bands that vendors put around an image without saying so.
    """
    from scipy.ndimage import label

    valid = np.isfinite(image).all(axis=0)
    frame, _ = label(~valid | (image == 0).all(axis=0))
    border = np.concatenate([frame[0], frame[-1], frame[:, 0], frame[:, -1]])
    valid &= ~np.isin(frame, np.unique(border[border > 0]))
    return np.asarray(valid)


__all__ = ["FILLED", "MEANING", "MEASURED", "UNSEEN", "valid_pixels", "validity_of"]

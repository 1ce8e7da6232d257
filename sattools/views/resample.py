"""Images as the fit wants them: resampled to the ground grid at one reference height, with parallel rays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sattools.camera.cells import project_plane
from sattools.camera.ground import grid_sun, ground_rays, project
from sattools.camera.rpc import RPC
from sattools.camera.view_direction import ViewDirection
from sattools.scene.grid import Grid

ENOUGH = 100_000  # pixels that tell an image's brightness and spread to 0.3 % of the spread


@dataclass(frozen=True)
class View:
    """One image on the ground grid.

    Attributes:
        id: item id.
        target: ``[H, W, C]`` float32 linear radiance where the cell's ray crosses the reference height; 0 where masked.
        mask: ``[H, W]`` uint8, 1 where the image has a value.
        slope: line of sight.
        z_ref: reference height [m].
        sun: unit vector (east, north, up) in the grid's frame, or None if unknown.
        parallel_ray_error_m: largest deviation of a true line of sight from the parallel one within the height range
            [m].
    """

    id: str
    target: np.ndarray
    mask: np.ndarray
    slope: ViewDirection
    z_ref: float
    sun: tuple[float, float, float] | None
    parallel_ray_error_m: float


def line_of_sight(rpc: RPC, grid: Grid, z_ref: float, z_range: tuple[float, float]) -> tuple[ViewDirection, float]:
    """Common slope of a view's rays over the grid, and how far a ray strays from it [m].

    Args:
        rpc: the camera.
        grid: ground grid.
        z_ref: reference height [m].
        z_range: lowest and highest height [m].

    Returns:
        (east, north) metres per metre of height, and the largest deviation within ``z_range``.
    """
    west, south, east, north = grid.bounds
    x, y = np.meshgrid(np.linspace(west, east, 5), np.linspace(south, north, 5))
    col, row = project(rpc, grid.crs, x.ravel(), y.ravel(), np.full(x.size, z_ref))
    low, high = z_range
    start, end = ground_rays(rpc, grid.crs, col, row, low, high)
    slopes = (end - start) / (high - low)  # [25, 2]
    slope = slopes.mean(axis=0)
    reach = max(high - z_ref, z_ref - low)
    spread = float(np.abs(slopes - slope).max() * reach)
    return ViewDirection(float(slope[0]), float(slope[1])), spread


def read_at(image: np.ndarray, col: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An image at the pixel positions of a raster's cells, averaged over a cell.

    Args:
        image: ``[C, h, w]`` float32, NaN where invalid.
        col: ``[H, W]`` positions of the cells' centres [pixels]; neighbours in the raster are neighbours here.
        row: ``[H, W]`` positions of the cells' centres [pixels]; neighbours in the raster are neighbours here.

    Returns:
        ``[H, W, C]`` float32, 0 where there is no valid pixel, and ``[H, W]`` uint8, 1 where there is.
    """
    import cv2

    valid = np.isfinite(image).all(axis=0)
    whole = bool(valid.all())
    filled = image.astype(np.float32, copy=False) if whole else np.where(valid, image, 0.0).astype(np.float32)
    blur = _cell_blur(col, row)
    # normalised convolution: masked pixels neither darken their neighbours nor spread; a whole image has none
    weight = valid.astype(np.float32)
    if max(blur) > 0.3:
        layers = [_smoothed(band, blur) for band in filled]
        if not whole:
            weight = _smoothed(weight, blur)
            layers = [layer / np.maximum(weight, 1e-6) for layer in layers]
    else:
        layers = list(filled)
    map_col, map_row = col.astype(np.float32), row.astype(np.float32)
    # three or four bands at once take half the time of one by one; other numbers OpenCV interpolates less exactly
    if len(layers) in (3, 4):
        layers = [cv2.merge(layers)]
    target = np.dstack(
        [cv2.remap(layer, map_col, map_row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for layer in layers]
    )
    height, width = image.shape[1:]
    mask = (col >= 0) & (row >= 0) & (col <= width - 1) & (row <= height - 1)
    if not whole:
        mask &= (
            cv2.remap(weight, map_col, map_row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0.9
        )
    target[~mask] = 0.0
    return target, mask.astype(np.uint8)


def _smoothed(layer: np.ndarray, sigma: tuple[float, float]) -> np.ndarray:
    """A layer ``[h, w]`` float32 through a Gaussian (columns, rows) [pixels]."""
    import cv2

    return cv2.GaussianBlur(
        layer, (0, 0), max(sigma[0], 1e-3), sigmaY=max(sigma[1], 1e-3), borderType=cv2.BORDER_REPLICATE
    )


def make_view(
    item_id: str,
    image: np.ndarray,
    rpc: RPC,
    grid: Grid,
    z_ref: float,
    z_range: tuple[float, float],
    *,
    sun: tuple[float, float] | None,
) -> View:
    """Resample an image to the grid at height ``z_ref``, averaged over a cell.

    Args:
        item_id: name.
        image: ``[C, h, w]`` float32 linear radiance, NaN where invalid.
        rpc: its camera.
        grid: ground grid of the wanted cell size.
        z_ref: reference height [m].
        z_range: lowest and highest height [m].
        sun: (azimuth, elevation) from true north and horizon [degrees], or None.
    """
    target, mask = read_at(image, *project_plane(rpc, grid, z_ref))
    slope, spread = line_of_sight(rpc, grid, z_ref, z_range)
    direction = grid_sun(grid, *sun) if sun is not None else None
    return View(item_id, target, mask, slope, z_ref, direction, spread)


def _cell_blur(col: np.ndarray, row: np.ndarray) -> tuple[float, float]:
    """Gaussian sigma in pixels (columns, rows) that brings an image's resolution to the grid's."""
    h, w = col.shape
    if h < 2 or w < 2:
        return 0.0, 0.0
    top, left = min(h // 2, h - 2), min(w // 2, w - 2)
    middle = (slice(top, top + 2), slice(left, left + 2))
    c, r = col[middle], row[middle]
    along_col = math.hypot(c[0, 1] - c[0, 0], c[1, 0] - c[0, 0])
    along_row = math.hypot(r[0, 1] - r[0, 0], r[1, 0] - r[0, 0])
    # a pixel and a cell are boxes: sigma^2 of a box of width f is f^2 / 12
    return tuple(math.sqrt(max(0.0, f * f - 1) / 12) for f in (along_col, along_row))  # type: ignore[return-value]


def shown_on(
    view: View, height: np.ndarray, cell_size: float, pose: tuple[float, float] = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """What a view shows at the surface points of the grid, occlusion ignored.

    Args:
        view: image on the reference plane.
        height: ``[H, W]`` [m].
        cell_size: [m].
        pose: (east, north) shift of the view's rays [m].

    Returns:
        ``[H, W, C]`` radiance and ``[H, W, 1]`` float32, 1 where the view has a value.
    """
    import cv2

    rows, cols = height.shape
    dz = height - view.z_ref
    col = (np.arange(cols)[None, :] - (pose[0] + view.slope.east * dz) / cell_size).astype(np.float32)
    row = (np.arange(rows)[:, None] + (pose[1] + view.slope.north * dz) / cell_size).astype(np.float32)
    picture = cv2.remap(view.target, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    seen = cv2.remap(view.mask, col, row, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return picture.reshape(*height.shape, -1), seen[..., None].astype(np.float32)


def match_colours(views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset (radiance) per view and band that bring each image's mean and spread to the first one's.

    Returns:
        gain ``[V, C]`` and offset ``[V, C]`` with target = gain * reference + offset.
    """
    means, spreads = [], []
    for view in views:
        every = max(1, int(view.mask.sum(dtype=np.int64)) // ENOUGH)
        while math.gcd(every, view.mask.shape[1]) > 1:  # not some columns alone
            every += 1
        shown = view.mask.ravel()[::every] > 0
        pixels = view.target.reshape(-1, view.target.shape[-1])[::every][shown]
        low, middle, high = np.percentile(pixels, [16, 50, 84], axis=0)
        means.append(middle)
        spreads.append(np.maximum(high - low, 1e-4))
    gain = np.array(spreads) / spreads[0]
    offset = np.array(means) - gain * means[0]
    return gain.astype(np.float32), offset.astype(np.float32)


__all__ = ["View", "line_of_sight", "make_view", "match_colours", "read_at", "shown_on"]

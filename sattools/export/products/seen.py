"""What every image of a fit shows at the points of a surface: its pixels, which it sees, which are in the sun."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from sattools.camera.ground import ground_sample_distance, middle_lon_lat, project
from sattools.camera.rpc import RPC
from sattools.camera.view_direction import ViewDirection
from sattools.errors import SceneError
from sattools.export.validity import valid_pixels
from sattools.fit.described import Sun
from sattools.fit.model import FittedModel
from sattools.radiometry.bands import chosen_bands
from sattools.radiometry.linear import linear_radiance, shared_bits
from sattools.render import sun_visibility
from sattools.render.visibility import plate_slopes
from sattools.scene import Grid, Item, Scene
from sattools.scene.pixels import ImagePart, image_part
from sattools.views import line_of_sight

log = logging.getLogger(__name__)
_SPARE = 3  # pixels around what is read of an image
_FARTHEST = 1024  # cells: of what may hide a cell or shade it


class Colours(NamedTuple):
    """The multispectral image of an acquisition.

    Attributes:
        part: its pixels.
        rpc: its camera.
    """

    part: ImagePart
    rpc: RPC


@dataclass(frozen=True)
class Camera:
    """An image of the fit.

    Attributes:
        item: its item.
        part: its pixels.
        bits: significant ones of digital numbers; None = the pixels are radiance.
        rpc: its camera.
        pose: (east, north) shift of its rays that the fit found [m].
        sun: unit vector (east, north, up) to the sun, or None.
        slope: line of sight.
        colours: pixels and camera of the multispectral image of the same acquisition, or None.
        bands: places of the model's bands among the image's; None = all of them, in their order.
    """

    item: Item
    part: ImagePart
    bits: int | None
    rpc: RPC
    pose: tuple[float, float]
    sun: Sun | None
    slope: ViewDirection
    colours: Colours | None = None
    bands: list[int] | None = None


class Patch(NamedTuple):
    """A block of the surface, finer than its cells where asked for.

    Attributes:
        grid: of the points ``[h, w]``.
        height: ``[h, w]`` ellipsoidal heights [m]; NaN where there is none.
        wide: ``[H, W]`` heights of the DSM's cells around it [m], gaps filled with the lowest.
        inner: rows and columns of `wide` that the block is made of.
        cell: edge of a cell of `wide` [m].
        fine: points along a cell's edge.
    """

    grid: Grid
    height: np.ndarray
    wide: np.ndarray
    inner: tuple[slice, slice]
    cell: float
    fine: int


class Shown(NamedTuple):
    """What an image shows at the points of a patch.

    Attributes:
        value: ``[C, h, w]`` radiance; anything where it shows nothing.
        visible: ``[h, w]`` in [0, 1], 0 where it shows nothing.
        lit: ``[h, w]`` in [0, 1], 1 = in the sun.
        ratio: ``[K, h, w]`` multispectral bands over their mean, None without a multispectral image.
    """

    value: np.ndarray
    visible: np.ndarray
    lit: np.ndarray
    ratio: np.ndarray | None = None


def cameras_of(scene: Scene, model: FittedModel, heights: tuple[float, float]) -> list[Camera]:
    """The images of a fit that are still there.

    Args:
        scene: with the images.
        model: of the fit.
        heights: lowest and highest of the surface [m].

    Raises:
        SceneError: there is none.
    """
    items = {item.id: item for item in scene.items}
    cameras = []
    for name, pose, sun in zip(model.items, model.pose.tolist(), model.suns, strict=True):
        item = items.get(name)
        if item is None or "rpc" not in item.assets or not {"radiance", "image"} & item.assets.keys():
            log.warning("scene %s: image %s is not there any more: an orthophoto goes without it", scene.id, name)
            continue
        asset = "radiance" if "radiance" in item.assets else "image"
        rpc = RPC.from_file(scene.path(item.assets["rpc"].href))
        low, high = heights
        slope, _ = line_of_sight(rpc, model.grid, low, (low, max(high, low + 1.0)))
        bits = shared_bits(item, scene.items) if asset == "image" else None
        colours = None
        if {"colours", "colours_rpc"} <= item.assets.keys():
            own = RPC.from_file(scene.path(item.assets["colours_rpc"].href))
            colours = Colours(image_part(scene, item, "colours"), own)
        part = image_part(scene, item, asset)
        places = [number - 1 for number in chosen_bands(item, model.bands, part.bands)] if model.bands else None
        cameras.append(Camera(item, part, bits, rpc, (pose[0], pose[1]), sun, slope, colours, places))
    if not cameras:
        raise SceneError(f"scene {scene.id}: found no image with a camera, expected those of the fit for an orthophoto")
    return cameras


def pixel_size(cameras: Sequence[Camera], grid: Grid, height: float) -> float:
    """Edge of a pixel on the ground of the image that shows most [m].

    Args:
        cameras: of the images.
        grid: of the ground.
        height: of the ground [m].
    """
    lon, lat = middle_lon_lat(grid)
    sizes = [ground_sample_distance(camera.rpc, lon, lat, height) for camera in cameras]
    return min((size for size in sizes if math.isfinite(size)), default=grid.cell_size)


def reach_of(cameras: Sequence[Camera], relief: float, cell: float) -> int:
    """Cells around a block within which something may hide its cells from an image or its sun.

    Args:
        cameras: of the images.
        relief: from the lowest to the highest height [m].
        cell: edge of a cell [m].
    """
    runs = [math.hypot(*camera.slope) for camera in cameras]
    runs += [math.hypot(c.sun[0], c.sun[1]) / max(c.sun[2], 1e-3) for c in cameras if c.sun is not None]
    return min(_FARTHEST, 2 + math.ceil(max(runs) * relief / cell))


def make_patch(wide: np.ndarray, grid: Grid, inner: tuple[slice, slice], fine: int) -> Patch:
    """A patch of a DSM: cells are plates with steps between them, as the shadows have it.

    Args:
        wide: ``[H, W]`` heights [m], NaN = none.
        grid: of these.
        inner: rows and columns of the block.
        fine: points along a cell's edge.
    """
    known = np.isfinite(wide)
    level = np.where(known, wide, np.nanmin(wide) if known.any() else 0.0).astype(np.float32)
    east, south = (slope.numpy() for slope in plate_slopes(torch.from_numpy(level)))
    offset = (np.arange(fine) + 0.5) / fine - 0.5
    rows, cols = inner
    part = np.where(known, level, np.nan)[inner]
    height = np.repeat(np.repeat(part, fine, axis=0), fine, axis=1)
    height += np.repeat(np.repeat(east[inner], fine, axis=0), fine, axis=1) * np.tile(offset, part.shape[1])[None]
    height += np.repeat(np.repeat(south[inner], fine, axis=0), fine, axis=1) * np.tile(offset, part.shape[0])[:, None]
    own = grid.part(rows, cols)
    points = Grid(own.crs, own.left, own.top, own.cell_size / fine, own.width * fine, own.height * fine)
    return Patch(points, height, level, inner, grid.cell_size, fine)


def shown_at(camera: Camera, patch: Patch) -> Shown | None:
    """What an image shows at the points of a patch; None where it shows nothing of it."""
    import cv2

    grid = patch.grid
    x, y = np.meshgrid(grid.x() - camera.pose[0], grid.y() - camera.pose[1])
    level = np.where(np.isfinite(patch.height), patch.height, float(patch.wide.min()))
    col, row = project(camera.rpc, grid.crs, x.ravel(), y.ravel(), level.ravel())
    col, row = np.asarray(col).reshape(grid.shape), np.asarray(row).reshape(grid.shape)
    rows, cols = (
        slice(max(0, math.floor(at.min()) - _SPARE), min(size, math.ceil(at.max()) + _SPARE + 1))
        for at, size in ((row, camera.part.shape[0]), (col, camera.part.shape[1]))
    )
    if rows.start >= rows.stop or cols.start >= cols.stop:
        return None
    image = camera.part.read((rows, cols))
    valid = valid_pixels(image).astype(np.float32)
    image = image if camera.bands is None else image[camera.bands]
    if camera.bits is not None:
        image = linear_radiance(image, camera.bits)
    at = (col - cols.start).astype(np.float32), (row - rows.start).astype(np.float32)
    bands = [cv2.remap(np.nan_to_num(band), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for band in image]
    there = cv2.remap(valid, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0.99
    if not there.any():
        return None
    surface = torch.from_numpy(patch.wide)
    visible = _finer(sun_visibility(surface, patch.cell, camera.slope.unit()).numpy(), patch)
    lit = np.ones(grid.shape, np.float32)
    if camera.sun is not None:
        lit = _finer(sun_visibility(surface, patch.cell, camera.sun).numpy(), patch)
    ratio = None
    if camera.colours is not None:
        ratio, coloured = _ratio(camera.colours, grid, (x, y, level))
        there &= coloured
    return Shown(np.stack(bands), np.where(there & np.isfinite(patch.height), visible, np.float32(0)), lit, ratio)


def _ratio(
    colours: Colours, grid: Grid, points: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Multispectral bands over their mean ``[K, h, w]`` at points (x, y, height) ``[h, w]``, and where there are."""
    import cv2

    x, y, level = points
    part = colours.part
    col, row = (
        np.asarray(v).reshape(x.shape) for v in project(colours.rpc, grid.crs, x.ravel(), y.ravel(), level.ravel())
    )
    rows, cols = (
        slice(max(0, math.floor(at.min()) - _SPARE), min(size, math.ceil(at.max()) + _SPARE + 1))
        for at, size in ((row, part.shape[0]), (col, part.shape[1]))
    )
    if rows.start >= rows.stop or cols.start >= cols.stop:
        return np.ones((part.bands, *x.shape), np.float32), np.zeros(x.shape, bool)
    image = part.read((rows, cols))
    at = (col - cols.start).astype(np.float32), (row - rows.start).astype(np.float32)
    valid = valid_pixels(image).astype(np.float32)
    there = cv2.remap(valid, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0.99
    bands = [cv2.remap(np.nan_to_num(band), *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for band in image]
    # as they are: without the darkest ground's numbers, which are the air's, simulated colours came out worse
    values = np.maximum(np.stack(bands), 0)
    mean = values.mean(axis=0)
    ratio = np.where(mean > 0, values / np.maximum(mean, 1e-6), 1.0)  # what is as dark as the air has no colour
    return ratio.astype(np.float32), there


def _finer(ramp: np.ndarray, patch: Patch) -> np.ndarray:
    """A map of the DSM's cells around a patch at the patch's points, bilinear."""
    import cv2

    if patch.fine == 1:
        return np.asarray(ramp[patch.inner])
    rows, cols = patch.inner
    offset = (np.arange(patch.fine) + 0.5) / patch.fine - 0.5
    row, col = (
        (np.arange(part.start, part.stop)[:, None] + offset).ravel().astype(np.float32) for part in (rows, cols)
    )
    at_col, at_row = np.meshgrid(col, row)
    return np.asarray(cv2.remap(ramp, at_col, at_row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


__all__ = ["Camera", "Patch", "Shown", "cameras_of", "make_patch", "pixel_size", "reach_of", "shown_at"]

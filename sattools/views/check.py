"""Do a scene's document, cameras and images go together? Asked once, before any work is done with them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sattools.camera.ground import check_projected, check_scale, ground_sample_distance, middle_lon_lat, view_direction
from sattools.camera.rpc import RPC
from sattools.errors import InputError, SceneError, counted
from sattools.radiometry.linear import item_bits
from sattools.scene import Grid, Item, Scene
from sattools.scene.members import FINEST, LEAST_CELLS
from sattools.scene.memory import check_memory

_HEIGHTS_APART_M = 1000.0  # of a scene from those that a camera was made for
_FEWEST_CELLS = 2  # of a fit along each side
_TURNED_DEG = 3.0  # a camera from what the document says of it
_GRID_SHARE = 100.0  # area of the grid over that of the images together
_COPIES = 3  # of an image's array that work holds at a time


def check_scene(scene: Scene, items: Sequence[Item], cameras: Sequence[RPC], shapes: Sequence[tuple[int, int]]) -> None:
    """Raise SceneError where the items, their cameras and the (rows, columns) of their images contradict the document.

    A scene without grid or height range is left to those who need them.

    Args:
        scene: the scene.
        items: the images.
        cameras: of the images.
        shapes: (rows, columns) of the images [px].
    """
    for item, shape in zip(items, shapes, strict=True):
        _check_item(scene, item, shape)
    if scene.grid is None or scene.height_range_m is None:
        return
    grid, (low, high) = scene.grid, scene.height_range_m
    west, south, east, north = grid.bounds
    try:
        check_projected(grid.crs)
        lon, lat = middle_lon_lat(grid)
        if not (math.isfinite(lon) and math.isfinite(lat)):
            raise InputError(f"found corner {west:g} {south:g}, which {grid.crs} does not have, expected one on Earth")
        check_scale(grid.crs, lon, lat)
    except InputError as error:
        raise SceneError(f"scene {scene.id}: grid: {error}") from None
    if min(grid.shape) < LEAST_CELLS:
        raise SceneError(
            f"scene {scene.id}: found a grid of {grid.width} x {grid.height} cells, expected at least {LEAST_CELLS} "
            "along each side"
        )
    shown = 0.0
    for item, rpc, shape in zip(items, cameras, shapes, strict=True):
        bottom, top = rpc.altitude_range
        if max(low - top, bottom - high) > _HEIGHTS_APART_M:
            raise SceneError(
                f"scene {scene.id}: found heights from {low:g} to {high:g} m, expected some that the camera of "
                f"{item.id} was made for, {bottom:.0f} to {top:.0f} m"
            )
        _check_direction(scene, item, rpc, lon, lat, (low + high) / 2)
        size = ground_sample_distance(rpc, lon, lat, (low + high) / 2)
        if math.isfinite(size):
            shown += shape[0] * shape[1] * size**2
    area = (east - west) * (north - south)
    if shown > 0 and area > _GRID_SHARE * shown:
        raise SceneError(
            f"scene {scene.id}: found a grid of {grid.width} x {grid.height} cells of {grid.cell_size:g} m, "
            f"{area / shown:.0f} times what all images show, expected one that they cover"
        )


def _check_item(scene: Scene, item: Item, shape: tuple[int, int]) -> None:
    where = f"scene {scene.id}: item {item.id}"
    if item.sun is not None and item.sun[1] <= 0:
        raise SceneError(
            f"{where}: found view:sun_elevation {item.sun[1]:g}, expected a sun above the horizon (hold the image out, "
            "or leave its sun out where it is unknown)"
        )
    said = item.properties.get("proj:shape")
    if said is not None and tuple(said) != shape:
        raise SceneError(
            f"{where}: found an image of {shape[1]} x {shape[0]} pixels, expected {said[1]} x {said[0]} as proj:shape "
            "has: the image of another item?"
        )
    highest = (item.properties.get("sattools:value_range") or [None, None])[1]
    bits = item_bits(item.properties)
    if highest is not None and item.properties.get("sattools:bits") and highest >= 2.0**bits:
        raise SceneError(f"{where}: found sattools:bits {bits} for numbers of up to {highest:g}, expected more bits")


def _check_direction(scene: Scene, item: Item, rpc: RPC, lon: float, lat: float, height: float) -> None:
    """The camera looks from where the document says that the sensor was."""
    azimuth, incidence = (item.properties.get(f"view:{name}") for name in ("azimuth", "incidence_angle"))
    if azimuth is None or incidence is None:
        return
    tilt, turn = math.radians(incidence), math.radians(azimuth)
    said = np.array([math.sin(tilt) * math.sin(turn), math.sin(tilt) * math.cos(turn), math.cos(tilt)])
    with np.errstate(all="ignore"):
        direction = view_direction(rpc, lon, lat, height)
    apart = (
        math.degrees(math.acos(max(-1.0, min(1.0, float(direction @ said)))))
        if np.isfinite(direction).all()
        else math.nan
    )
    if apart > _TURNED_DEG:
        raise SceneError(
            f"scene {scene.id}: item {item.id}: found a camera that looks {apart:.1f} degrees away from view:azimuth "
            "and view:incidence_angle, expected its own"
        )


def check_extent(grid: Grid) -> None:
    """Raise SceneError where cells are as large as the area."""
    if min(grid.shape) < _FEWEST_CELLS:
        raise SceneError(
            f"grid: found {grid.width} x {grid.height} cells of {grid.cell_size:g} m for the whole area, expected at "
            f"least {_FEWEST_CELLS} along each side (--resolution)"
        )


def check_cells(grid: Grid, pixel_m: float, bands: int, images: int) -> None:
    """Raise SattoolsError where images resampled to a grid have absurdly many cells, or more than memory holds.

    Args:
        grid: ground grid.
        pixel_m: edge of a pixel on the ground [m].
        bands: of an image.
        images: number of images.
    """
    if math.isfinite(pixel_m) and grid.cell_size < FINEST * pixel_m:
        raise SceneError(
            f"grid: found cells of {grid.cell_size:g} m for pixels of {pixel_m:.2g} m, expected at least "
            f"{FINEST * pixel_m:.2g} m"
        )
    cells = grid.width * grid.height
    check_memory(
        4.0 * cells * (bands + 2) * images * _COPIES,
        f"{counted(images, 'images')} on {grid.width} x {grid.height} cells of {grid.cell_size:g} m",
        "give coarser cells with --resolution, or fit with --tile",
    )


__all__ = ["check_cells", "check_extent", "check_scene"]

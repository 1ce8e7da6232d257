"""Where images lie on the ground: footprints, which belong together, the default area, the grid's cells."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import MultiPoint, Polygon
from shapely.geometry.polygon import orient

from sattools.camera import RPC
from sattools.camera.ground import from_geographic, ground_sample_distance, to_geographic, view_direction
from sattools.scene.grid import SURROUNDINGS_M

Array = NDArray[np.float64]
Bounds = tuple[float, float, float, float]
ALL_OF_IT = 0.98  # of an image with data: what is missing moves no area's border
COUNTED = 400  # cells along the longer side of the raster that counts who shows a place
Window = tuple[int, int, int, int]  # col0, row0, width, height


def outline(rpc: RPC, window: Window, height: float) -> Array:
    """Longitudes and latitudes `[n, 2]` of a window's outer edge at a height; NaN where the camera does not reach.

    Args:
        rpc: the camera.
        window: (column, row, width, height) [px].
        height: of the ground [m].
    """
    col, row, width, rows = window
    t = np.arange(4) / 4  # points along a side
    edge = np.concatenate([[t, 0 * t], [1 + 0 * t, t], [1 - t, 1 + 0 * t], [0 * t, 1 - t]], axis=1)
    return np.stack(rpc.localization(col - 0.5 + edge[0] * width, row - 0.5 + edge[1] * rows, height), -1)


def data_edge(gray: NDArray[np.float32]) -> Array | None:
    """Corners (column, row) ``[n, 2]`` [px] of the convex outline of pixels with data; None where it is the image's.

    A frame without data makes an image larger than what it shows.

    Args:
        gray: ``[H, W]``; NaN = no data.
    """
    hull = convex_outline(np.isfinite(gray))
    if hull.is_empty or hull.area > ALL_OF_IT * gray.size:
        return None
    return np.asarray(hull.exterior.coords, np.float64)


def convex_outline(known: NDArray[np.bool_]) -> Polygon:
    """Convex outline of the marked pixels in (column, row), a pixel's middle at whole numbers; empty where none is.

    Args:
        known: ``[H, W]``.
    """
    rows = np.flatnonzero(known.any(axis=1))
    if not rows.size:
        return Polygon()
    first = known[rows].argmax(axis=1)
    last = known.shape[1] - 1 - known[rows, ::-1].argmax(axis=1)
    ends = [(cols + side, rows + end) for cols, side in ((first, -0.5), (last, 0.5)) for end in (-0.5, 0.5)]
    return MultiPoint(np.concatenate([np.stack(end, axis=-1) for end in ends])).convex_hull.simplify(0.5)


def footprint(rpc: RPC, window: Window, height: float) -> Polygon:
    """Footprint polygon in longitude and latitude, counter-clockwise as GeoJSON wants it.

    Args:
        rpc: the camera.
        window: (column, row, width, height) [px].
        height: of the ground [m].
    """
    return orient(Polygon(outline(rpc, window, height)))


def ground_polygon(rpc: RPC, window: Window, height: float, crs: str, edge: Array | None = None) -> Polygon:
    """Footprint in the ground CRS [m]; empty where the camera does not reach it.

    Args:
        rpc: the camera.
        window: (column, row, width, height) [px].
        height: of the ground [m].
        crs: projected ground CRS [m].
        edge: corners (column, row) ``[n, 2]`` of what counts of the window, where that is not all (`data_edge`).
    """
    if edge is None:
        points = outline(rpc, window, height)
    else:
        points = np.stack(rpc.localization(window[0] + edge[:, 0], window[1] + edge[:, 1], height), -1)
    if not np.isfinite(points).all():
        return Polygon()
    x, y = from_geographic(crs, points[:, 0], points[:, 1])
    polygon = Polygon(np.stack([x, y], -1)) if np.isfinite(x).all() and np.isfinite(y).all() else Polygon()
    return polygon if polygon.is_valid else Polygon()


def groups(polygons: Sequence[Polygon]) -> list[list[int]]:
    """Indices of polygons that overlap, directly or through others; the largest group first."""
    left, result = set(range(len(polygons))), []
    while left:
        seed = min(left)
        group, border = {seed}, [seed]
        while border:
            k = border.pop()
            touching = {j for j in left - group if polygons[k].intersects(polygons[j])}
            group |= touching
            border += sorted(touching)
        left -= group
        result.append(sorted(group))
    return sorted(result, key=lambda g: (-len(g), g))


def common_bounds(polygons: Sequence[Polygon], share: float = 0.5) -> Bounds | None:
    """Bounding box (west, south, east, north) of what at least `share` of the polygons (and two of them) cover.

    Args:
        polygons: footprints [m].
        share: of the polygons.
    """
    from affine import Affine
    from rasterio.features import geometry_mask

    boxes = np.array([p.bounds for p in polygons if not p.is_empty])
    if len(boxes) == 0:
        return None
    west, south, east, north = boxes[:, 0].min(), boxes[:, 1].min(), boxes[:, 2].max(), boxes[:, 3].max()
    cell = max(east - west, north - south) / COUNTED
    x = np.arange(west + cell / 2, east, cell)
    y = np.arange(south + cell / 2, north, cell)
    count, to_ground = np.zeros((len(y), len(x)), int), Affine(cell, 0, west, 0, cell, south)
    for polygon in polygons:
        if not polygon.is_empty:
            count += geometry_mask([polygon], count.shape, to_ground, invert=True)
    enough = count >= max(2, math.ceil(share * len(polygons)))
    if not enough.any():
        return None
    cols, rows = np.flatnonzero(enough.any(0)), np.flatnonzero(enough.any(1))
    half = cell / 2
    return (
        float(x[cols[0]] - half),
        float(y[rows[0]] - half),
        float(x[cols[-1]] + half),
        float(y[rows[-1]] + half),
    )


def left_out(covered: Bounds, polygons: Sequence[Polygon], crs: str) -> list[str]:
    """A line where the area that half of the images show is less than half of what two of them show, as in mosaics.

    Args:
        covered: the former (west, south, east, north) [m].
        polygons: footprints [m].
        crs: projected ground CRS [m].
    """
    shown = common_bounds(polygons, share=0.0)
    if shown is None:
        return []
    share = _size(covered) / _size(shown)
    if share >= 0.5:
        return []
    lon, lat = to_geographic(crs, np.array(shown)[[0, 0, 2, 2]], np.array(shown)[[1, 3, 1, 3]])
    degrees = f"{lon.min():.5f} {lat.min():.5f} {lon.max():.5f} {lat.max():.5f}"
    return [
        f"the area is where half of the images have data, {100 * share:.0f} % of where two of them do: for all of that "
        f"--bounds {degrees} (degrees; with --crs its metres)"
    ]


def with_rim(bounds: Bounds) -> Bounds:
    """Bounds with a rim, so that the surface still covers the area when it is moved by some metres onto a reference."""
    west, south, east, north = bounds
    rim = 0.02 * max(east - west, north - south)
    return west - rim, south - rim, east + rim, north + rim


def with_surroundings(bounds: Bounds) -> Bounds:
    """Bounds of an area with what stands beside it."""
    west, south, east, north = bounds
    return west - SURROUNDINGS_M, south - SURROUNDINGS_M, east + SURROUNDINGS_M, north + SURROUNDINGS_M


def cut_to_shown(asked: Bounds, outlines: Sequence[Sequence[Polygon]]) -> Bounds:
    """The area asked for, or its part that two images show where that is less than half of it.

    Args:
        asked: (west, south, east, north) [m].
        outlines: footprints of all images, at the lowest and at the highest height [m].
    """
    shown = [box for polygons in outlines if (box := common_bounds(polygons, share=0.0)) is not None]
    if not shown:
        return asked
    lowest, highest = np.min(shown, axis=0), np.max(shown, axis=0)
    box = with_rim((float(lowest[0]), float(lowest[1]), float(highest[2]), float(highest[3])))
    west, south, east, north = (
        *(max(a, b) for a, b in zip(asked[:2], box[:2], strict=True)),
        *(min(a, b) for a, b in zip(asked[2:], box[2:], strict=True)),
    )
    if not (west < east and south < north):
        return asked
    left = (west, south, east, north)
    return left if _size(left) < 0.5 * _size(asked) else asked


def _size(bounds: Bounds) -> float:
    return (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])


def pixels_on_ground(
    cameras: Sequence[RPC], shapes: Sequence[tuple[int, int]], height: float
) -> tuple[list[float], list[float]]:
    """Edge of every image's pixels on the ground [m], and upward part of the unit vector towards its camera.

    Args:
        cameras: of the images.
        shapes: their rows and columns; it is asked in the middle.
        height: of the ground [m].
    """
    middles = [((columns - 1) / 2, (rows - 1) / 2) for rows, columns in shapes]
    places = [camera.localization(*at, height) for camera, at in zip(cameras, middles, strict=True)]
    both = list(zip(cameras, places, strict=True))
    sizes = [ground_sample_distance(camera, *place, height) for camera, place in both]
    return sizes, [float(view_direction(camera, *place, height)[2]) for camera, place in both]


__all__ = [
    "Bounds",
    "common_bounds",
    "convex_outline",
    "cut_to_shown",
    "data_edge",
    "footprint",
    "ground_polygon",
    "groups",
    "left_out",
    "outline",
    "pixels_on_ground",
    "with_rim",
    "with_surroundings",
]

"""Coarse looks at the ground on horizontal planes, as images show it there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sattools.camera.ground import project, to_geographic
from sattools.camera.rpc import RPC

Array = NDArray[np.float64]
Bounds = tuple[float, float, float, float]
_NODES = 5  # along an axis, between which a camera is affine


@dataclass(frozen=True)
class GroundPlanes:
    """The cells of an area at several heights, and where images show them.

    Attributes:
        shape: rows and columns.
        heights: ``[D]`` of the planes [m].
        nodes: ``[V, D, 25, 2]`` pixels (column, row) of places that are spread over the area.
        to_pixels: ``[3, 25]``, which makes the affine map from cells to pixels of those of a plane.
    """

    shape: tuple[int, int]
    heights: Array
    nodes: Array
    to_pixels: Array

    @classmethod
    def of(cls, rpcs: Sequence[RPC], crs: str, bounds: Bounds, cell: float, heights: Array) -> GroundPlanes:
        """Those of square cells.

        Args:
            rpcs: cameras of the images.
            crs: projected ground CRS [m].
            bounds: (west, south, east, north) [m].
            cell: edge of a cell [m].
            heights: ``[D]`` of the planes [m].
        """
        west, south, east, north = bounds
        width, height = max(8, int((east - west) / cell)), max(8, int((north - south) / cell))
        x, y = west + (np.arange(width) + 0.5) * cell, north - (np.arange(height) + 0.5) * cell
        nodes_x, nodes_y = np.linspace(x[0], x[-1], _NODES), np.linspace(y[0], y[-1], _NODES)
        lon, lat = to_geographic(crs, *(g.ravel() for g in np.meshgrid(nodes_x, nodes_y)))
        nodes = np.stack([np.stack(rpc.projection(lon, lat, heights[:, None]), axis=-1) for rpc in rpcs])
        return cls((height, width), heights, nodes, _to_affine(nodes_x, nodes_y, x, y))

    def to_image(self, view: int, plane: int) -> Array:
        """Affine map ``[2, 3]`` from a plane's cells (column, row) to an image's pixels.

        Args:
            view: number of the image.
            plane: number of the plane.
        """
        return np.asarray((self.to_pixels @ self.nodes[view, plane]).T)

    def shown(self, image: NDArray[np.float32], view: int, plane: int) -> NDArray[np.float32]:
        """An image ``[H, W]`` laid over the cells of a plane; NaN where it shows nothing.

        Args:
            image: pixels of the view; NaN = no data.
            view: its number.
            plane: number of the plane.
        """
        import cv2

        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = self.shape[::-1]
        return np.asarray(cv2.warpAffine(image, self.to_image(view, plane), size, flags=flags, borderValue=np.nan))


def blurred(
    gray: NDArray[np.float32], rpc: RPC, crs: str, bounds: Bounds, z: float, cell: float
) -> NDArray[np.float32]:
    """Image smoothed to a cell size, NaN where it has no value.

    Args:
        gray: ``[H, W]``; NaN = no data.
        rpc: its camera.
        crs: projected ground CRS [m].
        bounds: (west, south, east, north) of the area that matters [m].
        z: height of the ground [m].
        cell: edge of a cell [m].
    """
    import cv2

    west, south, east, north = bounds
    x, y = (west + east) / 2, (south + north) / 2
    col, row = project(rpc, crs, [x, x + cell, x], [y, y, y + cell], z)
    pixels = float(np.sqrt(abs((col[1] - col[0]) * (row[2] - row[0]) - (col[2] - col[0]) * (row[1] - row[0]))))
    valid = np.isfinite(gray)
    mean = gray[valid].mean() if valid.any() else np.float32(0.0)
    smooth = cv2.GaussianBlur(np.where(valid, gray - mean, np.float32(0.0)), (0, 0), max(0.5 * pixels, 0.3))
    return np.where(valid, smooth + mean, np.float32(np.nan))


def _to_affine(nodes_x: Array, nodes_y: Array, x: NDArray[Any], y: NDArray[Any]) -> Array:
    """What makes the least squares map ``[3, 2]`` from cell (column, row) to pixel (col, row) of the nodes' pixels."""
    cell_x, cell_y = x[1] - x[0], y[1] - y[0]
    gx, gy = np.meshgrid((nodes_x - x[0]) / cell_x, (nodes_y - y[0]) / cell_y)
    return np.linalg.pinv(np.stack([gx.ravel(), gy.ravel(), np.ones(gx.size)], 1))


__all__ = ["Array", "Bounds", "GroundPlanes", "blurred"]

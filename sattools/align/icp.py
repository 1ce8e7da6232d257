"""Iterated closest points: one step of a surface towards the planes of another one."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from sattools.align.determined import slopes
from sattools.scene.grid import Grid

FAR_CELLS = 1.5  # pairs further apart than that sideways lie at a border or a hole
OUTLIER = 3.0  # deviations beyond which something was built or felled
PART = 0.25  # of a cell, within which walls that large cells have made slopes of still say how far to go


class Planes:
    """The cells of a surface as points, each with the plane that it lies in.

    Args:
        height: ``[H, W]`` [m]; NaN = unknown.
        grid: of it.
    """

    def __init__(self, height: np.ndarray, grid: Grid) -> None:
        east, north = slopes(height, grid.cell_size)
        known = np.isfinite(height) & np.isfinite(east) & np.isfinite(north)
        x, y = np.meshgrid(grid.x(), grid.y())
        self.middle = np.array([x.mean(), y.mean(), float(height[known].mean()) if known.any() else 0.0])
        self.points = np.stack([x[known], y[known], height[known]], axis=1).astype(np.float64) - self.middle
        normal = np.stack([-east[known], -north[known], np.ones(int(known.sum()))], axis=1)
        self.normals = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        self.cell_size = grid.cell_size
        self.tree = cKDTree(self.points)

    def step(self, places: np.ndarray, tilt: bool) -> tuple[np.ndarray, int]:
        """What to add to points so that they come nearer to the planes of their closest points.

        Args:
            places: ``[N, 3]`` x, y, height in the grid's CRS [m].
            tilt: whether heights may rise along x and y.

        Returns:
            (east, north, up [m], rise along x, along y [m/m]), the rise about the `middle` of the planes; and the
            number of pairs that it rests on, 0 where there are fewer than 2 an unknown.
        """
        points = places - self.middle
        _, nearest = self.tree.query(points)
        apart, normal = self.points[nearest] - points, self.normals[nearest]
        near = np.abs(apart[:, :2]).max(axis=1) <= FAR_CELLS * self.cell_size
        apart, normal, points = apart[near], normal[near], points[near]
        distance = np.einsum("ij,ij->i", apart, normal)
        if distance.size:
            middle = np.median(distance)
            spread = 1.4826 * np.median(np.abs(distance - middle))
            same = np.abs(distance - middle) <= max(OUTLIER * spread, PART * self.cell_size)
            normal, points, distance = normal[same], points[same], distance[same]
        reach = max(float(np.abs(self.points[:, :2]).max(initial=0.0)), self.cell_size)  # makes the unknowns alike
        design = np.column_stack([normal, normal[:, 2:] * points[:, :2] / reach])[:, : 5 if tilt else 3]
        if len(distance) < 2 * design.shape[1]:
            return np.zeros(5), 0
        found = np.linalg.lstsq(design, distance, rcond=None)[0]
        return np.concatenate([found[:3], found[3:] / reach if tilt else np.zeros(2)]), len(distance)


__all__ = ["Planes"]

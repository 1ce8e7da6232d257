"""The numerical core of bundle adjustment: robust Gauss-Newton on points and views with the points eliminated.

Ground points are offsets in metres (east, north, up) on linearly scaled longitude and latitude, which the RPC takes
without any map projection. View corrections are `[v, 6]`: shift (col, row) at the image's centre, then the derivatives
of the correction by normalised (col, row), in pixels at the edge of the image; zero for a pure shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sattools.camera.ground import metres_per_degree
from sattools.camera.rpc import RPC
from sattools.camera.tracks import Tracks

Array = NDArray[np.float64]

_LOSS_PX = 0.7  # width of the Cauchy loss once it is tight
_LINEAR_PRIOR_PX = 2.0  # expected size of affine terms at the image's edge; fixes what tie points cannot see
_SHIFT_PRIOR_PX = 1e4  # only to keep the normal equations solvable
_GAUGE_HEIGHT_M = 300.0  # movement in height worth half a pixel of one view's shift
_HEIGHT_PRIOR_M = 1e3  # likewise, for points on nearly parallel rays


@dataclass
class Solution:
    """Points `[n, 3]` (local metres) and view corrections `[v, 6]` (pixels)."""

    points: Array
    parameters: Array


class Block:
    """Views and tie points with all that does not change during the adjustment."""

    def __init__(self, rpcs: list[RPC], sizes: list[tuple[int, int]], tracks: Tracks) -> None:
        self.rpcs, self.sizes, self.tracks = rpcs, sizes, tracks
        middle = [r.localization((w - 1) / 2, (h - 1) / 2, r.alt_offset) for r, (h, w) in zip(rpcs, sizes, strict=True)]
        self.origin = np.array([*np.nanmedian(np.array(middle), axis=0), np.median([r.alt_offset for r in rpcs])])
        east, north = metres_per_degree(self.origin[1], self.origin[2])
        self.scale = np.array([1.0 / east, 1.0 / north, 1.0])
        self.by_view = [np.flatnonzero(tracks.view == v) for v in range(len(rpcs))]

    def kept(self, observation: NDArray[np.bool_], points: Array | None = None) -> tuple[Block, Array]:
        """The block with only the chosen observations ``[m]`` bool, and the points ``[n, 3]`` [m] that are left."""
        tracks, old, _ = self.tracks.kept(observation)
        block = Block(self.rpcs, self.sizes, tracks)
        return block, points[old] if points is not None else np.empty((0, 3))

    def geographic(self, points: Array) -> Array:
        """(lon, lat, h) [degrees, m] of local points ``[n, 3]`` [m]."""
        return self.origin + points * self.scale

    def start(self) -> Array:
        """Points ``[n, 3]`` [m] where the first view of each sees them at the origin's height."""
        first = np.r_[True, self.tracks.point[1:] != self.tracks.point[:-1]]
        geographic = np.tile(self.origin, (self.tracks.n_points, 1))
        for v, index in enumerate(self.by_view):
            mine = index[first[index]]
            lon, lat = self.rpcs[v].localization(self.tracks.pixel[mine, 0], self.tracks.pixel[mine, 1], self.origin[2])
            geographic[self.tracks.point[mine], 0] = lon
            geographic[self.tracks.point[mine], 1] = lat
        points = (geographic - self.origin) / self.scale
        return np.where(np.isfinite(points), points, 0.0)

    def linearised(self, points: Array, parameters: Array) -> tuple[Array, Array, Array]:
        """Residuals `[m, 2]`, derivatives of the prediction by the point `[m, 2, 3]`, correction basis `[m, 3]`."""
        n = len(self.tracks.point)
        residual, jacobian, basis = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty((n, 3))
        geographic = self.geographic(points)
        for v, index in enumerate(self.by_view):
            if index.size == 0:
                continue
            g = geographic[self.tracks.point[index]].T
            pixel, derivative = self.rpcs[v].projection_and_jacobian(*g)
            jacobian[index] = derivative * self.scale
            basis[index] = self._basis(v, pixel)
            residual[index] = self.tracks.pixel[index] - pixel - basis[index] @ parameters[v].reshape(3, 2)
        return residual, jacobian, basis

    def residuals(self, points: Array, parameters: Array) -> Array:
        """Observed minus predicted pixels `[m, 2]`."""
        residual = np.empty((len(self.tracks.point), 2))
        geographic = self.geographic(points)
        for v, index in enumerate(self.by_view):
            pixel = np.stack(self.rpcs[v].projection(*geographic[self.tracks.point[index]].T), axis=-1)
            residual[index] = self.tracks.pixel[index] - pixel - self._basis(v, pixel) @ parameters[v].reshape(3, 2)
        return residual

    def matrix(self, view: int, parameters: Array) -> Array:
        """The correction as an affine map `[2, 3]` from old (col, row, 1) to new (col, row)."""
        height, width = self.sizes[view]
        half = np.array([width, height]) / 2
        p = parameters[view].reshape(3, 2)
        linear = p[1:].T / half
        centre = (np.array([width, height]) - 1) / 2
        return np.concatenate([np.eye(2) + linear, (p[0] - linear @ centre)[:, None]], axis=1)

    def domain(self, view: int) -> tuple[float, float, float, float, float, float]:
        """Ground the view sees: west, south, east, north, lowest, highest; for refitting its RPC."""
        rpc, (height, width) = self.rpcs[view], self.sizes[view]
        low, high = rpc.altitude_range
        cols, rows = np.array([0, width, width, 0.0] * 2), np.array([0, 0, height, height] * 2)
        lon, lat = rpc.localization(cols, rows, np.repeat([low, high], 4))
        return float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max()), low, high

    def components(self, use: NDArray[np.bool_]) -> int:
        """Number of groups of views without common tie points; ``use`` is ``[V]`` bool."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        n = len(self.rpcs)
        pairs = (self.tracks.view, n + self.tracks.point)
        graph = coo_matrix((np.ones(len(pairs[0])), pairs), shape=(n + self.tracks.n_points,) * 2)
        labels = connected_components(graph, directed=False)[1]
        return len(np.unique(labels[:n][use]))

    def _basis(self, view: int, pixel: Array) -> Array:
        height, width = self.sizes[view]
        centre, half = (np.array([width, height]) - 1) / 2, np.array([width, height]) / 2
        return np.concatenate([np.ones((len(pixel), 1)), (pixel - centre) / half], axis=1)


def residual_norm(block: Block, points: Array, parameters: Array) -> Array:
    """Lengths of the residuals `[m]` in pixels.

    Args:
        block: tie points and cameras.
        points: ``[m, 3]`` ground points [m].
        parameters: ``[V, P]`` corrections [px].
    """
    residual = block.residuals(points, parameters)
    return np.hypot(residual[:, 0], residual[:, 1])


def solve(
    block: Block, affine: bool, initial: Solution | None = None, max_iterations: int = 30, least_gain: float = 2e-5
) -> Solution:
    """Points and corrections under a Cauchy loss that tightens (graduated non-convexity).

    The problem is nearly linear, so the wide loss finds the basin even when a view is tens of pixels off; from an
    `initial` solution of the same points the loss starts narrow.

    Args:
        block: tie points and cameras.
        affine: correct by an affine map instead of a shift.
        initial: where to begin, or None.
        max_iterations: Gauss-Newton steps.
        least_gain: share by which a step must lower the loss for another one to be taken.
    """
    if initial is None:
        parameters = np.zeros((len(block.rpcs), 6))
        # Heights as the raw cameras have them: the common movement that tie points cannot see starts near zero.
        points, width = triangulate(block, parameters), 30.0
    else:
        points, parameters, width = initial.points.copy(), initial.parameters.copy(), 1.5
    before = np.inf
    for iteration in range(max_iterations):
        first = initial is None and iteration == 0
        step_points, step_parameters, cost = _step(block, points, parameters, 1e6 if first else width, affine)
        points += step_points
        parameters += step_parameters
        # Not the step: along a common movement it may wander without any effect.
        if width <= _LOSS_PX and before - cost < least_gain * cost:
            break
        before = cost if width <= _LOSS_PX else np.inf
        width = width if first else max(_LOSS_PX, 0.5 * width)
    solution = _regauged(block, points, parameters)
    for _ in range(2):  # where the common movement was large, it was not quite a shift
        step_points, step_parameters, _ = _step(block, solution.points, solution.parameters, _LOSS_PX, affine)
        solution = Solution(solution.points + step_points, solution.parameters + step_parameters)
    return _regauged(block, solution.points, solution.parameters)


def triangulate(block: Block, parameters: Array, points: Array | None = None, iterations: int = 12) -> Array:
    """Points alone, cameras fixed, under the same loss.

    Args:
        block: tie points and cameras.
        parameters: ``[V, P]`` corrections [px].
        points: ``[m, 3]`` where to begin [m], or None.
        iterations: Gauss-Newton steps.
    """
    points = block.start() if points is None else points.copy()
    for iteration in range(iterations):
        residual, jacobian, _ = block.linearised(points, parameters)
        weight = _weights(residual, 1e6 if iteration < 2 else max(_LOSS_PX, 16.0 / 2**iteration))
        step = np.einsum("nij,nj->ni", *_point_blocks(block, residual, jacobian, weight))
        points += step
        if iteration > 6 and np.abs(step).max() < 1e-3:
            break
    return points


def _weights(residual: Array, width: float) -> Array:
    """Cauchy weights of residual lengths."""
    return 1.0 / (1.0 + (residual**2).sum(1) / width**2)


def _point_blocks(block: Block, residual: Array, jacobian: Array, weight: Array) -> tuple[Array, Array]:
    """Inverse 3x3 normal matrices `[n, 3, 3]` and right-hand sides `[n, 3]` of the points."""
    count, owner = block.tracks.n_points, block.tracks.point
    products = ((weight[:, None, None] * jacobian).transpose(0, 2, 1) @ jacobian).reshape(-1, 9)
    normal = np.stack([np.bincount(owner, p, count) for p in products.T], -1).reshape(-1, 3, 3)
    normal += np.diag([1e-12, 1e-12, _HEIGHT_PRIOR_M**-2])
    right = np.einsum("m,mki,mk->mi", weight, jacobian, residual)
    return np.linalg.inv(normal), np.stack([np.bincount(owner, r, count) for r in right.T], -1)


def _step(block: Block, points: Array, parameters: Array, width: float, affine: bool) -> tuple[Array, Array, float]:
    """One Gauss-Newton step by the Schur complement of the points, and the Cauchy loss before it."""
    n_views, size = len(block.rpcs), 6 if affine else 2
    residual, jacobian, basis = block.linearised(points, parameters)
    weight = _weights(residual, width)
    cost = -float(np.log(weight).sum())
    inverse, right = _point_blocks(block, residual, jacobian, weight)
    view, owner = block.tracks.view, block.tracks.point

    # Derivative of the prediction by the view's parameters: basis k moves col by parameter 2k, row by 2k + 1.
    by_view = np.zeros((len(view), 2, size))
    for k in range(size // 2):
        by_view[:, 0, 2 * k] = by_view[:, 1, 2 * k + 1] = basis[:, k]
    total = n_views * size
    normal, vector = np.zeros((total, total)), np.zeros(total)
    weighted = weight[:, None, None] * by_view
    own = weighted.transpose(0, 2, 1) @ by_view
    own_right = (residual[:, None, :] @ weighted)[:, 0]
    for v, index in enumerate(block.by_view):
        part = slice(v * size, (v + 1) * size)
        normal[part, part] = own[index].sum(0)
        vector[part] = own_right[index].sum(0)
    prior = np.full((n_views, size), _SHIFT_PRIOR_PX**-2.0)
    prior[:, 2:] = _LINEAR_PRIOR_PX**-2.0
    normal[np.arange(total), np.arange(total)] += prior.ravel()
    vector -= (prior * parameters[:, :size]).ravel()

    mixed = jacobian.transpose(0, 2, 1) @ weighted  # [m, 3, size]
    chunk = max(1, int(1e6 // (3 * total)))  # stays in the cache
    for first in range(0, block.tracks.n_points, chunk):
        last = min(first + chunk, block.tracks.n_points)
        rows = slice(*np.searchsorted(owner, [first, last]))
        blocks = np.zeros((last - first, 3, n_views, size))
        blocks[owner[rows] - first, :, view[rows]] = mixed[rows]
        wide = blocks.reshape(last - first, 3, total)
        solved = inverse[first:last] @ wide
        flat, other = wide.reshape(-1, total), solved.reshape(-1, total)
        normal -= flat.T @ other
        vector -= other.T @ right[first:last].ravel()
    values, vectors = np.linalg.eigh((normal + normal.T) / 2)
    # Directions that tie points cannot see have (nearly) no curvature: no step along them.
    seen = values > 1e-9 * values.max()
    step = (vectors[:, seen] @ ((vectors[:, seen].T @ vector) / values[seen])).reshape(n_views, size)
    pulled = np.einsum("mij,mj->mi", mixed, step[view])
    rest = right - np.stack([np.bincount(owner, p, block.tracks.n_points) for p in pulled.T], -1)
    full = np.zeros((n_views, 6))
    full[:, :size] = step
    return np.einsum("nij,nj->ni", inverse, rest), full, cost


def _regauged(block: Block, points: Array, parameters: Array) -> Solution:
    """The same adjustment moved as a whole so that the shifts' lengths have the least sum."""
    used = np.array([index.size > 0 for index in block.by_view])
    if not used.any():
        return Solution(points, parameters)
    _, jacobian, _ = block.linearised(points, parameters)
    design = np.array([jacobian[index].mean(0) if index.size else np.zeros((2, 3)) for index in block.by_view])
    move = robust_gauge(parameters[used, :2], design[used])
    parameters = parameters.copy()
    parameters[:, :2] -= design @ move
    parameters[~used] = 0.0
    return Solution(points + move, parameters)


def robust_gauge(shift: Array, design: Array) -> Array:
    """Movement m `[3]` (east, north, up) that makes sum |shift_v - design_v m| least (reweighted least squares).

    Args: shift `[v, 2]`; design `[v, 2, 3]`, change of view v's pixel by a movement of the ground.

    A sum of lengths, not of squares: one camera that is far off does not drag the others. Height is held back by a
    small ridge, as nearly parallel lines of sight do not tell it from a horizontal movement.
    """
    weight = np.ones(len(shift))
    move = np.zeros(3)
    for _ in range(60):
        normal = np.einsum("v,vki,vkj->ij", weight, design, design)
        normal += np.diag([1e-12, 1e-12, _GAUGE_HEIGHT_M**-2.0])
        move = np.linalg.solve(normal, np.einsum("v,vki,vk->i", weight, design, shift))
        left = shift - design @ move
        weight = 1.0 / np.maximum(np.hypot(left[:, 0], left[:, 1]), 0.05)
    return move


__all__ = ["Block", "Solution", "residual_norm", "robust_gauge", "solve", "triangulate"]

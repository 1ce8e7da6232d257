"""The numerical core of bundle adjustment: robust Gauss-Newton on points and views with the points eliminated.

Ground points are offsets in metres (east, north, up) on linearly scaled longitude and latitude, which the RPC takes
without any map projection. View corrections are `[v, 6]`: shift (col, row) at the image's centre, then the derivatives
of the correction by normalised (col, row), in pixels at the edge of the image; zero for a pure shift.

Inside, numbers of observations `[..., m]` and of points `[..., n]` lie in rows, one for each component: 3x3 matrices of
thousands of points are then a few operations on long rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sattools.camera.ground import metres_per_degree
from sattools.camera.rpc import RPC
from sattools.camera.tracks import Tracks

Array = NDArray[np.float64]

_MOST_STEPS = 30  # of Gauss and Newton
_LOSS_PX = 0.7  # width of the Cauchy loss once it is tight
_LINEAR_PRIOR_PX = 2.0  # expected size of affine terms at the image's edge; fixes what tie points cannot see
_SHIFT_PRIOR_PX = 10.0  # expected size of shifts: decides where tie points hardly see, as across a rim
_GAUGE_HEIGHT_M = 300.0  # movement in height worth half a pixel of one view's shift
_HEIGHT_PRIOR_M = 1e3  # likewise, for points on nearly parallel rays
_LEAST_PIVOT = 1e-14  # of a point's matrix: less than the priors leave, more than rounding does


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
        self.order = np.concatenate(self.by_view)
        self.back = np.argsort(self.order)
        self.first = np.flatnonzero(np.r_[True, tracks.point[1:] != tracks.point[:-1]][: len(tracks.point)])
        half = np.array([[w, h] for h, w in sizes]).T[:, tracks.view] / 2
        self.pixel, self.half, self.centre = np.ascontiguousarray(tracks.pixel.T), half, half - 0.5

    def kept(self, observation: NDArray[np.bool_], points: Array | None = None) -> tuple[Block, Array]:
        """The block with only the chosen observations ``[m]`` bool, and the points ``[n, 3]`` [m] that are left."""
        tracks, old = self.tracks.kept(observation)
        block = Block(self.rpcs, self.sizes, tracks)
        return block, points[old] if points is not None else np.empty((0, 3))

    def geographic(self, points: Array) -> Array:
        """(lon, lat, h) [degrees, m] of local points ``[n, 3]`` [m]."""
        return self.origin + points * self.scale

    def start(self) -> Array:
        """Points ``[n, 3]`` [m] where the first view of each sees them at the origin's height."""
        first = np.zeros(len(self.tracks.point), bool)
        first[self.first] = True
        geographic = np.tile(self.origin, (self.tracks.n_points, 1))
        for v, index in enumerate(self.by_view):
            mine = index[first[index]]
            lon, lat = self.rpcs[v].localization(self.tracks.pixel[mine, 0], self.tracks.pixel[mine, 1], self.origin[2])
            geographic[self.tracks.point[mine], 0] = lon
            geographic[self.tracks.point[mine], 1] = lat
        points = (geographic - self.origin) / self.scale
        return np.where(np.isfinite(points), points, 0.0)

    def linearised(self, points: Array, parameters: Array) -> tuple[Array, Array, Array]:
        """Residuals `[2, m]`, derivatives of the prediction by the point `[2, 3, m]`, correction basis `[3, m]`."""
        found = np.empty((8, len(self.order)))
        geographic = self.geographic(points).T[:, self.tracks.point[self.order]]
        end = 0
        for rpc, index in zip(self.rpcs, self.by_view, strict=True):
            part = slice(end, end := end + len(index))
            found[:2, part], slopes = rpc.projection_and_slopes(*geographic[:, part])
            found[2:, part] = slopes.reshape(6, -1)
        found = found[:, self.back]
        pixel, slopes = found[:2], found[2:].reshape(2, 3, -1)
        slopes *= self.scale[:, None]
        basis = self._basis(pixel)
        return self._residual(pixel, basis, parameters), slopes, basis

    def residuals(self, points: Array, parameters: Array) -> Array:
        """Observed minus predicted pixels `[m, 2]`."""
        pixel, geographic = np.empty_like(self.pixel), self.geographic(points)
        for v, index in enumerate(self.by_view):
            pixel[:, index] = self.rpcs[v].projection(*geographic[self.tracks.point[index]].T)
        return self._residual(pixel, self._basis(pixel), parameters).T

    def by_point(self, values: Array) -> Array:
        """Sums `[..., n]` over the observations of each point of ``values`` `[..., m]`."""
        return np.add.reduceat(values, self.first, axis=-1) if len(self.first) else values[..., :0]

    def summed_by_view(self, values: Array) -> Array:
        """Sums `[..., V]` over the observations of each view of ``values`` `[..., m]`."""
        flat = [np.bincount(self.tracks.view, row, len(self.rpcs)) for row in values.reshape(-1, values.shape[-1])]
        return np.array(flat, np.float64).reshape(*values.shape[:-1], len(self.rpcs))

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

    def _basis(self, pixel: Array) -> Array:
        basis = np.ones((3, pixel.shape[1]))
        basis[1:] = (pixel - self.centre) / self.half
        return basis

    def _residual(self, pixel: Array, basis: Array, parameters: Array) -> Array:
        residual = self.pixel - pixel
        for k, moved in enumerate(parameters.reshape(-1, 3, 2).transpose(1, 2, 0)):
            if moved.any():
                residual -= basis[k] * moved[:, self.tracks.view]
        return residual


def residual_norm(block: Block, points: Array, parameters: Array) -> Array:
    """Lengths of the residuals `[m]` in pixels.

    Args:
        block: tie points and cameras.
        points: ``[m, 3]`` ground points [m].
        parameters: ``[V, P]`` corrections [px].
    """
    residual = block.residuals(points, parameters)
    return np.hypot(residual[:, 0], residual[:, 1])


def solve(block: Block, affine: bool, initial: Solution | None = None, least_gain: float = 2e-5) -> Solution:
    """Points and corrections under a Cauchy loss that tightens (graduated non-convexity).

    The problem is nearly linear, so the wide loss finds the basin even when a view is tens of pixels off; from an
    `initial` solution of the same points the loss starts narrow.

    Args:
        block: tie points and cameras.
        affine: correct by an affine map instead of a shift.
        initial: where to begin, or None.
        least_gain: share by which a step must lower the loss for another one to be taken.
    """
    if initial is None:
        parameters = np.zeros((len(block.rpcs), 6))
        # Heights as the raw cameras have them: the common movement that tie points cannot see starts near zero.
        points, width = triangulate(block, parameters), 30.0
    else:
        points, parameters, width = initial.points.copy(), initial.parameters.copy(), 1.5
    before = np.inf
    for iteration in range(_MOST_STEPS):
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


def triangulate(block: Block, parameters: Array, points: Array | None = None) -> Array:
    """Points alone, cameras fixed, under the same loss.

    Args:
        block: tie points and cameras.
        parameters: ``[V, P]`` corrections [px].
        points: ``[m, 3]`` where to begin [m], or None.
    """
    points = block.start() if points is None else points.copy()
    for iteration in range(12):  # Gauss-Newton steps, most
        residual, jacobian, _ = block.linearised(points, parameters)
        weight = _weights(residual, 1e6 if iteration < 2 else max(_LOSS_PX, 16.0 / 2**iteration))
        root, right = _point_blocks(block, residual, jacobian, weight)
        step = _backward(root, _forward(root, right)).T
        points += step
        if iteration > 6 and np.abs(step).max() < 1e-3:
            break
    return points


def _weights(residual: Array, width: float) -> Array:
    """Cauchy weights `[m]` of residual lengths."""
    return 1.0 / (1.0 + (residual[0] ** 2 + residual[1] ** 2) / width**2)


def _point_blocks(block: Block, residual: Array, jacobian: Array, weight: Array) -> tuple[Array, Array]:
    """Cholesky roots `[6, n]` of the points' 3x3 normal matrices, by rows, and right-hand sides `[3, n]`."""
    weighted = weight * jacobian
    pairs = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]
    products = np.array([weighted[0, i] * jacobian[0, j] + weighted[1, i] * jacobian[1, j] for i, j in pairs])
    normal = block.by_point(products)
    normal += np.array([1e-12, 0.0, 1e-12, 0.0, 0.0, _HEIGHT_PRIOR_M**-2])[:, None]
    return _root(normal), block.by_point(weighted[0] * residual[0] + weighted[1] * residual[1])


def _root(normal: Array) -> Array:
    """Lower Cholesky roots of positive 3x3 matrices, both as `[6, n]` (00, 10, 11, 20, 21, 22)."""
    root = np.empty_like(normal)
    root[0] = np.sqrt(normal[0])
    root[1], root[3] = normal[1] / root[0], normal[3] / root[0]
    root[2] = np.sqrt(np.maximum(normal[2] - root[1] ** 2, _LEAST_PIVOT))
    root[4] = (normal[4] - root[3] * root[1]) / root[2]
    root[5] = np.sqrt(np.maximum(normal[5] - root[3] ** 2 - root[4] ** 2, _LEAST_PIVOT))
    return root


def _forward(root: Array, right: Array) -> Array:
    """Solve L x = b for roots `[6, k]` and right-hand sides `[3, k, ...]`."""
    a, b, c, d, e, f = root.reshape(*root.shape, *[1] * (right.ndim - 2))
    x = np.empty_like(right)
    x[0] = right[0] / a
    x[1] = (right[1] - b * x[0]) / c
    x[2] = (right[2] - d * x[0] - e * x[1]) / f
    return x


def _backward(root: Array, right: Array) -> Array:
    """Solve Lᵀ x = b for roots `[6, n]` and right-hand sides `[3, n]`."""
    a, b, c, d, e, f = root
    x = np.empty_like(right)
    x[2] = right[2] / f
    x[1] = (right[1] - e * x[2]) / c
    x[0] = (right[0] - b * x[1] - d * x[2]) / a
    return x


def _step(block: Block, points: Array, parameters: Array, width: float, affine: bool) -> tuple[Array, Array, float]:
    """One Gauss-Newton step by the Schur complement of the points, and the Cauchy loss before it."""
    n_views, terms = len(block.rpcs), 3 if affine else 1
    size, view, owner = 2 * terms, block.tracks.view, block.tracks.point
    total = n_views * size
    residual, jacobian, basis = block.linearised(points, parameters)
    weight = _weights(residual, width)
    cost = -float(np.log(weight).sum())
    root, right = _point_blocks(block, residual, jacobian, weight)

    # Basis k moves col by the view's parameter 2k and row by 2k + 1, so that no parameter moves both.
    basis = basis[:terms]
    weighted = weight * basis
    own = block.summed_by_view(weighted[:, None] * basis)  # [k, k, V]
    blocks, each = np.zeros((n_views, terms, 2, n_views, terms, 2)), np.arange(n_views)
    for axis in (0, 1):
        blocks[each, :, axis, each, :, axis] = np.moveaxis(own, -1, 0)
    normal = blocks.reshape(total, total)
    vector = np.moveaxis(block.summed_by_view(weighted[:, None] * residual), -1, 0).reshape(total)
    prior = np.full((n_views, size), _LINEAR_PRIOR_PX**-2.0)
    # Cauchy's, too: a camera that is far off is none the less free.
    prior[:, :2] = 1.0 / (_SHIFT_PRIOR_PX**2 + (parameters[:, :2] ** 2).sum(axis=1, keepdims=True))
    normal[np.arange(total), np.arange(total)] += prior.ravel()
    vector -= (prior * parameters[:, :size]).ravel()

    mixed = np.empty((3, len(view), size))
    for parameter in range(size):
        mixed[..., parameter] = weighted[parameter // 2] * jacobian[parameter % 2]
    left, above = _forward(root[:, owner], mixed), _forward(root, right)
    chunk = max(1, int(1e6 // (3 * total)))  # stays in the cache
    for start in range(0, block.tracks.n_points, chunk):
        end = min(start + chunk, block.tracks.n_points)
        rows = slice(*np.searchsorted(owner, [start, end]))
        wide = np.zeros((3, end - start, n_views, size))
        wide[:, owner[rows] - start, view[rows]] = left[:, rows]
        flat = wide.reshape(-1, total)
        normal -= flat.T @ flat
        vector -= flat.T @ above[:, start:end].ravel()
    values, vectors = np.linalg.eigh((normal + normal.T) / 2)
    # Directions that tie points cannot see have (nearly) no curvature: no step along them.
    seen = values > 1e-9 * values.max()
    step = (vectors[:, seen] @ ((vectors[:, seen].T @ vector) / values[seen])).reshape(n_views, size)
    pulled = block.by_point(np.einsum("ims,ms->im", left, step[view]))
    full = np.zeros((n_views, 6))
    full[:, :size] = step
    return _backward(root, above - pulled).T, full, cost


def _regauged(block: Block, points: Array, parameters: Array) -> Solution:
    """The same adjustment moved as a whole so that the shifts' lengths have the least sum."""
    used = np.array([index.size > 0 for index in block.by_view])
    if not used.any():
        return Solution(points, parameters)
    _, jacobian, _ = block.linearised(points, parameters)
    design = np.moveaxis(block.summed_by_view(jacobian), -1, 0)
    design /= np.maximum([index.size for index in block.by_view], 1)[:, None, None]
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

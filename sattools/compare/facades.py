"""Where a surface puts the walls of a reference: the place where it crosses half their height."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sattools.scene.jsonio import JsonObject

TREES = 5
STEP_M = 3.0  # a wall is at least so high between two neighbouring cells, and between its plateaus
REACH_M = 4.0  # from the wall, along its normal, within which a crossing is looked for
PLATEAU_M = (1.0, 3.0)  # from the wall, on both sides, where the reference has to be flat
FLAT_M = 1.0  # range of heights that is flat
LATERAL_M = 2.0  # along the wall, to both sides, where it has to go on: corners have no normal
SAMPLES_PER_CELL = 8
SHIFT_ROUNDS, SHIFT_SCALE_M = 10, 0.3  # of the shift that walls have in common; what is far off it counts little


class Walls(NamedTuple):
    """Pieces of wall, see `find_walls`.

    Attributes:
        offset: ``[N]`` float64 distance from where a prediction has it [m], outward positive; NaN = it has none.
        outward: ``[N, 2]`` unit vector (east, north) away from the building.
        rise: ``[N]`` between the plateaus [m].
    """

    offset: np.ndarray
    outward: np.ndarray
    rise: np.ndarray

    def between(self, heights: tuple[float, float]) -> Walls:
        """Those that rise by as much [m]."""
        chosen = (self.rise >= heights[0]) & (self.rise < heights[1])
        return Walls(*(values[chosen] for values in self))

    def without_shift(self) -> Walls:
        """The same where the whole prediction is moved by what walls to all sides have in common.

        A registration by whole cells leaves up to half a cell to every side, and more where single towers decide it:
        then walls that face one way are too far out by as much as those that face the other way are too far in.
        """
        known = np.isfinite(self.offset)
        if not known.any():
            return self
        design = np.column_stack([self.outward, np.ones(len(self.offset))])[known]  # and grown by as much to all sides
        weight, found = np.ones(len(design)), np.zeros(3)
        for _ in range(SHIFT_ROUNDS):
            found = np.linalg.lstsq(design * weight[:, None], self.offset[known] * weight, rcond=None)[0]
            weight = 1 / np.hypot(1.0, (self.offset[known] - design @ found) / SHIFT_SCALE_M)
        return self._replace(offset=self.offset - self.outward @ found[:2])


def find_walls(predicted: np.ndarray, reference: np.ndarray, cell: float, classes: np.ndarray | None = None) -> Walls:
    """Where a prediction has each piece of a reference's walls.

    A piece is an edge between two reference cells with a step of more than 3 m, on a straight wall between two
    plateaus that are flat from 1 to 3 m away. Both surfaces are cut along the wall's normal (bilinear between cells);
    each one's wall is where it rises through the middle of the reference's plateaus, the prediction's nearest such
    place within 4 m.

    Args:
        predicted: ``[H, W]`` registered heights [m], NaN = none.
        reference: ``[H, W]`` heights with vertical walls [m], NaN = unknown.
        cell: edge of a cell [m].
        classes: ``[H, W]`` class codes; walls with trees (5) on a plateau do not count.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    known = np.isfinite(reference)
    filled = np.where(known, reference, np.nanmin(reference) if known.any() else 0.0).astype(np.float64)
    rise = [gaussian_filter(filled, 1.0, order=order, mode="nearest") for order in ((1, 0), (0, 1))]
    step_row, step_col = (np.abs(np.diff(reference, axis=axis)) > STEP_M for axis in (0, 1))
    edges = np.array([0.5, 0.0]), np.array([0.0, 0.5])
    at = np.concatenate([np.argwhere(s) + e for s, e in zip((step_row, step_col), edges, strict=True)])  # [N, 2]
    slope = np.stack([map_coordinates(part, at.T, order=1, mode="nearest") for part in rise], axis=1)
    length = np.linalg.norm(slope, axis=1)
    at, normal = at[length > 0], (slope / np.maximum(length, 1e-12)[:, None])[length > 0]
    along = np.stack([-normal[:, 1], normal[:, 0]], axis=1)

    s = np.arange(-REACH_M, REACH_M + 1e-9, cell / SAMPLES_PER_CELL)

    def cut(surface: np.ndarray, aside: float = 0.0) -> np.ndarray:
        """Heights ``[N, S]`` along the normals, uphill, `aside` metres along the walls."""
        points = at[:, None] + (normal[:, None] * s[:, None] + along[:, None] * aside) / cell
        profile: np.ndarray = map_coordinates(
            surface.astype(np.float64), np.moveaxis(points, -1, 0), order=1, cval=np.nan
        )
        return profile

    low, high = (-s >= PLATEAU_M[0]) & (-s <= PLATEAU_M[1]), (s >= PLATEAU_M[0]) & (s <= PLATEAU_M[1])
    profile = cut(reference)
    bottom, top = (np.median(profile[:, part], axis=1) for part in (low, high))
    middle = 0.5 * (bottom + top)
    true_place = _rising(s, profile, middle, np.zeros(len(at)))
    good = top - bottom > STEP_M
    for aside in (-LATERAL_M, 0.0, LATERAL_M):
        beside = cut(reference, aside)
        good &= np.ptp(beside[:, low], axis=1) <= FLAT_M
        good &= np.ptp(beside[:, high], axis=1) <= FLAT_M
        good &= np.abs(_rising(s, beside, middle, true_place) - true_place) <= cell
    if classes is not None:
        trees = cut((classes == TREES).astype(np.float64))
        good &= ~(trees[:, low | high] > 0).any(axis=1)
    place = _rising(s, cut(predicted), middle, true_place)
    outward = np.column_stack([-normal[:, 1], normal[:, 0]])  # rows go south
    return Walls((true_place - place)[good], outward[good], (top - bottom)[good])


def wall_offsets(
    predicted: np.ndarray,
    reference: np.ndarray,
    cell: float,
    classes: np.ndarray | None = None,
    heights: tuple[float, float] = (0.0, np.inf),
) -> np.ndarray:
    """Signed distance of each piece of wall from where a prediction has it, see `find_walls`.

    Args:
        predicted: ``[H, W]`` registered heights [m], NaN = none.
        reference: ``[H, W]`` heights with vertical walls [m], NaN = unknown.
        cell: edge of a cell [m].
        classes: ``[H, W]`` class codes; walls with trees (5) on a plateau do not count.
        heights: between which the plateaus differ [m]; all walls of more than 3 m if not given.

    Returns:
        ``[N]`` float64 offsets [m], outward positive (the building is too large); NaN where the prediction has no wall.
    """
    return find_walls(predicted, reference, cell, classes).between(heights).offset


def _rising(s: np.ndarray, profiles: np.ndarray, level: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Place ``[N]`` nearest to `near` where each of `profiles` ``[N, S]`` rises through its level; NaN = nowhere."""
    above = profiles - level[:, None]
    before, after = above[:, :-1], above[:, 1:]
    rises = (before < 0) & (after >= 0)
    part = np.where(rises, before / np.where(rises, before - after, 1.0), 0.0)
    places = np.where(rises, s[:-1] + part * (s[1] - s[0]), np.inf)
    best = np.argmin(np.abs(places - near[:, None]), axis=1)
    nearest = np.take_along_axis(places, best[:, None], axis=1)[:, 0]
    return np.where(np.isfinite(nearest), nearest, np.nan)


def wall_figures(offsets: np.ndarray) -> JsonObject:
    """Figures [m] of `wall_offsets`: median and 90th percentile of the distance, mean outward; share without a wall."""
    known = offsets[np.isfinite(offsets)]
    figures: dict[str, Any] = {"pieces": int(offsets.size), "missing": None, "median": None, "p90": None, "mean": None}
    if offsets.size:
        figures["missing"] = 1.0 - known.size / offsets.size
    if known.size:
        distance = np.abs(known)
        figures |= {
            "median": float(np.median(distance)),
            "p90": float(np.quantile(distance, 0.9)),
            "mean": float(known.mean()),
        }
    return figures


__all__ = ["Walls", "find_walls", "wall_figures", "wall_offsets"]

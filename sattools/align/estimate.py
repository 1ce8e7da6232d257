"""The shift that brings a scene onto a reference: pure functions on arrays and cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sattools.camera.ground import project
from sattools.camera.rpc import RPC
from sattools.compare.registration import register, search_margin
from sattools.errors import InputError
from sattools.scene.grid import Grid
from sattools.scene.regrid import reproject_map

STEPS = 20
CONVERGED_CELLS = 0.005
LEAST_CELLS = 30
STEP_M = 0.5  # half the step of numerical derivatives
WORST_CONDITION = 1e6  # of the normal equations: beyond, one direction is not determined


@dataclass(frozen=True)
class Shift:
    """What has to be added to places on the ground, and what is left then.

    Attributes:
        east, north, up: [m].
        before, after: 1.4826 times the median absolute deviation (NMAD) of what is left without and with it [m],
            or [px] of control points.
        count: cells or coordinates that it rests on.
    """

    east: float
    north: float
    up: float
    before: float
    after: float
    count: int


@dataclass(frozen=True)
class ControlPoint:
    """A place on the ground and where an image shows it.

    Attributes:
        name: of the point.
        x, y, z: in the scene's CRS [m].
        item: id of the image.
        column, row: place in the image [px], 0 = centre of the first pixel.
    """

    name: str
    x: float
    y: float
    z: float
    item: str
    column: float
    row: float


def shift_to_dem(
    height: np.ndarray,
    grid: Grid,
    reference: np.ndarray,
    reference_grid: Grid,
    method: Literal["nuth-kaab", "z"] = "nuth-kaab",
) -> Shift:
    """The shift that brings a surface onto a reference, whose cells may be larger or smaller.

    Both are averaged to the larger cells. The surface's grid is moved and averaged anew until nothing is left to move,
    so that no interpolation of the large cells enters. Whole cells by correlation, then Nuth and Kaab (2011); the
    height by the median, which what has been built or felled in between does not move.

    Args:
        height: ``[H, W]`` [m]; NaN = unknown.
        grid: of the surface.
        reference: ``[h, w]`` [m]; NaN = unknown.
        reference_grid: of the reference.
        method: all three directions or height only.

    Raises:
        InputError: too few cells in common, or no slopes.
    """
    coarse = reference_grid.cell_size > grid.cell_size
    target = _around(reference_grid, grid) if coarse else grid
    onto = reproject_map(reference, reference_grid, target)
    if np.isfinite(onto).sum() < LEAST_CELLS:
        raise InputError(f"reference: found {int(np.isfinite(onto).sum())} cells there, expected {LEAST_CELLS} or more")
    east = north = 0.0
    first = onto - reproject_map(height, grid, target)
    if method == "nuth-kaab":
        margin = search_margin(target.shape)
        wide = reproject_map(height, grid, target.widened(margin))
        east, north, _ = register(wide, onto, "ncc", margin).metres(target.cell_size)
        for _ in range(STEPS):
            here = reproject_map(height, grid.moved(east, north), target)
            step_east, step_north, _ = register(here, onto, "nuth-kaab").metres(target.cell_size)
            east, north = east + step_east, north + step_north
            if np.hypot(step_east, step_north) < CONVERGED_CELLS * target.cell_size:
                break
    left = onto - reproject_map(height, grid.moved(east, north), target)
    left = left[np.isfinite(left)]
    if len(left) < LEAST_CELLS:
        raise InputError(f"reference: found {len(left)} cells in common, expected {LEAST_CELLS} or more")
    up = float(np.median(left))
    return Shift(east, north, up, _nmad(first), _nmad(left), len(left))


def shift_to_points(points: Sequence[ControlPoint], cameras: Mapping[str, RPC], crs: str) -> Shift:
    """The shift of all cameras under which control points fall where the images show them, by least squares.

    Args:
        points: ground and image places.
        cameras: RPC by id of the image.
        crs: of the points' x and y.

    Raises:
        InputError: a point of an unknown image, or points that leave a direction undetermined.
    """
    unknown = sorted({point.item for point in points} - set(cameras))
    if unknown:
        raise InputError(
            f"control point: found image {unknown[0]!r}, expected one of {', '.join(sorted(cameras))[:200]}"
        )
    shift = np.zeros(3)
    measured = np.array([(p.column, p.row) for p in points], dtype=np.float64)

    def left(moved: np.ndarray) -> np.ndarray:
        """Measured minus projected ``[N, 2]`` [px]; cameras moved by s see at p what they saw at p - s."""
        places = [project(cameras[p.item], crs, *(np.array([p.x, p.y, p.z]) - moved)) for p in points]
        return measured - np.array(places, dtype=np.float64).reshape(-1, 2)

    first = left(shift)
    for _ in range(STEPS):
        residual = left(shift).ravel()
        if not np.isfinite(residual).all():
            raise InputError("control point: found one that its camera cannot see, expected points on its ground")
        # d(residual)/d(shift) by central differences: cameras are smooth over a metre
        columns = [(left(shift + STEP_M * e) - left(shift - STEP_M * e)).ravel() / (2 * STEP_M) for e in np.eye(3)]
        design = np.stack(columns, axis=1)
        if len(residual) < 3 or np.linalg.cond(design.T @ design) > WORST_CONDITION:
            raise InputError("control points: found places that leave a direction open, expected them in two images")
        step = -np.linalg.lstsq(design, residual, rcond=None)[0]
        shift = shift + step
        if np.abs(step).max() < 1e-4:
            break
    last = left(shift)
    east, north, up = (float(v) for v in shift)
    return Shift(east, north, up, _nmad(first), _nmad(last), last.size)


def _around(large: Grid, grid: Grid) -> Grid:
    """The part of a grid of large cells that lies around another one, in its CRS; all of it where CRS differ."""
    if large.crs != grid.crs:
        return large
    return large.part(*large.window(grid))


def _nmad(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(1.4826 * np.median(np.abs(known - np.median(known)))) if known.size else float("nan")


__all__ = ["ControlPoint", "Shift", "shift_to_dem", "shift_to_points"]

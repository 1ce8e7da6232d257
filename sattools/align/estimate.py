"""The shift that brings a scene onto a reference: pure functions on arrays and cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sattools.align.determined import open_direction
from sattools.align.icp import Planes
from sattools.align.means import LEAST_KNOWN, CellMeans, shift_by_means
from sattools.align.shift import Shift
from sattools.camera.ground import project
from sattools.camera.rpc import RPC
from sattools.compare.metrics import nmad
from sattools.compare.registration import register, search_margin
from sattools.errors import InputError, counted
from sattools.progress import Progress, silent
from sattools.scene.grid import Grid
from sattools.scene.regrid import reproject_map, resize_map

STEPS = 20
WORSE = 1.1  # times what whole cells leave: steps that end there have led away
LEAST_WORSE_M = 0.1  # and at least so much worse: what is in place already is moved by its noise
UNLIKE = 0.65  # of the surface's relief is left: 0.02 to 0.2 on the same ground, up to 0.95 of bare ground under a town
FLATTER = 2.0  # what is left, times the relief of a reference that is doubtful already: at most 1.1 of bare ground
RELIEF_M = 1.0  # of a surface (mean deviation), from which what is left can be told from its noise
STEPS_ICP = 60  # pairs of closest points change from step to step, so that it takes more
MOST_PAIRS = 50_000  # of points and planes in a step
MOST_POINTS = 1_000_000  # of closest points; larger areas are looked at with larger cells
CONVERGED_CELLS = 0.005
LARGE = 2.0  # times the surface's cells: from there on means over the reference's cells say more than planes
LEAST_CELLS = 30
STEPS_POINTS = 50  # weights change with every step
LEAST_SPREAD_PX = 0.1  # of control points: nobody points more exactly
WRONG, LEAST_WRONG_PX = 5.0, 1.0  # times the median, and at least: control points beyond are mistakes
STEP_M = 0.5  # half the step of numerical derivatives
WORST_CONDITION = 1e6  # of the normal equations: beyond, one direction is not determined


Method = Literal["auto", "means", "icp", "nuth-kaab", "z"]


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
    method: Method = "auto",
    *,
    tilt: bool = False,
    error: np.ndarray | None = None,
    progress: Progress = silent,
) -> Shift:
    """The shift that brings a surface onto a reference, whose cells may be larger or smaller.

    Both are averaged to the larger cells. The surface's grid is moved and averaged anew until nothing is left to move,
    so that no interpolation of the large cells enters. Whole cells by correlation, then means over the reference's
    cells, pairs of points and planes, or Nuth and Kaab (2011); the height by the median, which what has been built or
    felled in between does not move.

    Args:
        height: ``[H, W]`` [m]; NaN = unknown.
        grid: of the surface.
        reference: ``[h, w]`` [m]; NaN = unknown.
        reference_grid: of the reference.
        method: all three directions (``auto``: means where the reference's cells are much larger, else planes), or
            height only.
        tilt: with ``means`` and ``icp``, a tilt as well.
        error: ``[H, W]`` how far the surface's cells may be off [m], by which ``means`` weighs them; None = all alike.
        progress: told what is being done, and the steps, which may take half a minute.

    Raises:
        InputError: too few cells in common, slopes that leave a direction open, steps that led away, or (but for
            ``z``) heights that have nothing in common with the surface's.
    """
    method = chosen(method, grid, reference_grid)
    coarse = reference_grid.cell_size > grid.cell_size
    target = _around(reference_grid, grid) if coarse else grid
    if method == "icp":
        while target.width * target.height > MOST_POINTS:
            target = target.resized(2 * target.cell_size)
    onto = reproject_map(reference, reference_grid, target)
    if np.isfinite(onto).sum() < LEAST_CELLS:
        raise InputError(
            f"reference: found {counted(int(np.isfinite(onto).sum()), 'cells')} there, expected {LEAST_CELLS} or more"
        )
    x, y = grid.middle
    shift = Shift(0.0, 0.0, 0.0, 0.0, 0.0, 0, x=x, y=y)
    first = onto - _on(target, height, grid)
    if method != "z":
        progress(0.0, "registering, whole cells")
        margin = search_margin(target.shape)
        wide = reproject_map(height, grid, target.widened(margin))
        east, north, up = register(wide, onto, "ncc", margin).metres(target.cell_size)
        shift = replace(shift, east=east, north=north, up=up)
        here = reproject_map(height, grid.moved(east, north), target)
        if (along := open_direction(here, onto, target.cell_size, tilt)) is not None:
            raise InputError(
                f"reference: found no slopes like the surface's along {along}, expected some: they leave open how far "
                "it is to be moved there; --method z moves in height only"
            )
        if method == "means":
            shift = shift_by_means(height, grid, onto, target, shift, error=error, tilt=tilt)
        elif method == "icp":
            shift = _by_planes(height, grid, onto, target, shift, tilt, progress=progress)
            if reference_grid.cell_size < LARGE * grid.cell_size:
                progress(1.0, "registering, the last part of a cell")
                shift = _between_cells(height, grid, (reference, reference_grid), shift, error, tilt)
        else:
            shift = _by_slopes(height, grid, onto, target, shift, progress)
    moved = (height + (shift.rise(grid) - shift.up)).astype(np.float32)
    here = _on(target, moved, grid.moved(shift.east, shift.north))
    both = np.isfinite(onto - here)
    left, here = (onto - here)[both], here[both]
    if len(left) < LEAST_CELLS:
        raise InputError(f"reference: found {counted(len(left), 'cells')} in common, expected {LEAST_CELLS} or more")
    before, after = nmad(first[np.isfinite(first)]), nmad(left)
    if method != "z" and after > WORSE * before + LEAST_WORSE_M:
        raise InputError(
            f"reference: found that the surface fits it worse once it is moved (NMAD {after:.2f} m, {before:.2f} m "
            "before), expected heights of the same ground in metres"
        )
    share = _share_left(left, here)
    if method != "z":
        _check_likeness(share, left, here)
    return replace(shift, up=float(np.median(left)), before=before, after=after, count=len(left), left=share)


def _check_likeness(share: float, left: np.ndarray, here: np.ndarray) -> None:
    """Raise InputError where a reference has nothing to say of a surface ``[N]`` [m], of which ``left [N]`` is left.

    What becomes of the NMAD does not tell: bare ground under a town that is in place already may leave a little more.
    """
    if share >= 1:
        raise InputError(
            f"reference: found that what is left between it and the surface varies {share:.1f} times as much as the "
            "surface itself, as from a level plane or more, expected heights of the same ground in metres"
        )
    relief, apart = nmad(left + here), nmad(left)
    if share > UNLIKE and apart > FLATTER * relief:
        raise InputError(
            f"reference: found hardly any relief (NMAD {relief:.2f} m, {apart:.2f} m between it and the surface), "
            "expected heights of the same ground in metres; --method z moves in height only"
        )


def _share_left(left: np.ndarray, here: np.ndarray) -> float:
    """What is left ``[N]`` as a share of how the surface ``[N]`` itself varies; 0 = it is too flat to tell.

    Mean deviations, in which the buildings of a level town count; the median's would know its streets alone.
    """
    apart, own = (float(np.abs(values - np.median(values)).mean()) for values in (left, here))
    return apart / own if own >= RELIEF_M else 0.0


def chosen(method: Method, grid: Grid, reference_grid: Grid) -> Method:
    """The method that ``auto`` stands for with these cells; any other as it is.

    Args:
        method: what was asked for.
        grid: of the surface.
        reference_grid: of the reference.

    Raises:
        InputError: means are asked for over cells that are no larger than the surface's.
    """
    large = reference_grid.crs == grid.crs and reference_grid.cell_size >= LARGE * grid.cell_size
    if method == "auto":
        return "means" if large else "icp"
    if method == "means" and reference_grid.crs != grid.crs:
        raise InputError(f"reference: found {reference_grid.crs[:80]}, expected {grid.crs[:80]} for --method means")
    if method == "means" and not large:
        raise InputError(
            f"reference: found cells of {reference_grid.cell_size:g} m, expected {LARGE * grid.cell_size:g} m or more "
            "for --method means; icp is for smaller ones"
        )
    return method


def _on(target: Grid, height: np.ndarray, grid: Grid) -> np.ndarray:
    """A surface ``[H, W]`` on another grid: means over its cells where they are much larger."""
    if target.crs != grid.crs or target.cell_size < LARGE * grid.cell_size:
        return reproject_map(height, grid, target)
    mean, share = CellMeans([height], grid).over(target, 0.0, 0.0)[0]
    return np.where(share >= LEAST_KNOWN, mean, np.nan)


def _by_slopes(
    height: np.ndarray, grid: Grid, onto: np.ndarray, target: Grid, start: Shift, progress: Progress
) -> Shift:
    """Steps east and north of Nuth and Kaab (2011) from a start; see `shift_to_dem`."""

    def apart(east: float, north: float) -> float:
        """Mean deviation from the median [m], in which walls that are out of place count."""
        left = onto - reproject_map(height, grid.moved(east, north), target)
        left = left[np.isfinite(left)]
        return float(np.abs(left - np.median(left)).mean()) if left.size else math.inf

    east, north = start.east, start.north
    for step in range(STEPS):
        progress(step / STEPS, f"registering, step {step + 1}")
        here = reproject_map(height, grid.moved(east, north), target)
        step_east, step_north, _ = register(here, onto, "nuth-kaab").metres(target.cell_size)
        east, north = east + step_east, north + step_north
        if np.hypot(step_east, step_north) < CONVERGED_CELLS * target.cell_size:
            break
    if (found := apart(east, north)) > WORSE * (whole := apart(start.east, start.north)):
        raise InputError(
            f"reference: found that its slopes lead away from it (mean deviation {found:.2f} m, without them "
            f"{whole:.2f} m), expected open ground: --method icp knows walls, too"
        )
    return replace(start, east=east, north=north)


def _by_planes(
    height: np.ndarray, grid: Grid, onto: np.ndarray, target: Grid, start: Shift, tilt: bool, *, progress: Progress
) -> Shift:
    """Steps in all directions by iterated closest points from a start; see `shift_to_dem`."""
    planes, shift = Planes(onto, target), start
    x, y = np.meshgrid(target.x(), target.y())
    for step in range(STEPS_ICP):
        progress(step / STEPS_ICP, f"registering, step {step + 1}")
        moved = (height + shift.rise(grid)).astype(np.float32)
        here = reproject_map(moved, grid.moved(shift.east, shift.north), target)
        known = np.flatnonzero(np.isfinite(here))
        some = known[:: max(1, len(known) // MOST_PAIRS)]
        found, pairs = planes.step(np.stack([x.flat[some], y.flat[some], here.flat[some]], axis=1), tilt)
        east, north, up, along_x, along_y = found.tolist()
        if not pairs:
            raise InputError(
                "reference: found too few cells near the surface's, expected a reference of the same place"
            )
        # the planes' middle is not the shift's
        middle_x, middle_y = planes.middle[:2].tolist()
        up += along_x * (shift.x + shift.east - middle_x) + along_y * (shift.y + shift.north - middle_y)
        shift = replace(
            shift, east=shift.east + east, north=shift.north + north, up=shift.up + up,
            tilt_east=shift.tilt_east + along_x, tilt_north=shift.tilt_north + along_y,
        )  # fmt: skip
        reach = max(target.width, target.height) * target.cell_size / 2
        if max(np.hypot(east, north), np.hypot(along_x, along_y) * reach) < CONVERGED_CELLS * target.cell_size:
            break
    return shift


def _between_cells(
    height: np.ndarray,
    grid: Grid,
    reference: tuple[np.ndarray, Grid],
    start: Shift,
    error: np.ndarray | None,
    tilt: bool,
) -> Shift:
    """The last part of a cell: closest points stay where whole cells lie on whole cells, as walls are steps there.

    Means over cells twice as large are exact wherever these lie. A start that they lead away from stays.
    """
    heights, own = reference
    if own.crs != grid.crs:
        return start
    rows, columns = own.window(grid.moved(start.east, start.north))
    own = own.part(rows, columns)
    large = own.resized(LARGE * grid.cell_size)
    try:
        onto = resize_map(heights[rows, columns], own, large)
        found = shift_by_means(height, grid, onto, large, start, error=error, tilt=tilt)
    except InputError:
        return start
    far = np.hypot(found.east - start.east, found.north - start.north) > large.cell_size
    return start if far else found


def point_residuals(
    points: Sequence[ControlPoint], cameras: Mapping[str, RPC], crs: str, moved: np.ndarray | None = None
) -> np.ndarray:
    """Measured minus projected places ``[N, 2]`` [px]; NaN where a camera cannot see a point.

    Args:
        points: ground and image places.
        cameras: RPC by id of the image.
        crs: of the points' x and y.
        moved: (east, north, up) by which all cameras are moved [m]; None = not.
    """
    back = np.zeros(3) if moved is None else moved  # cameras moved by s see at p what they saw at p - s
    places = [project(cameras[p.item], crs, *(np.array([p.x, p.y, p.z]) - back)) for p in points]
    measured = np.array([(p.column, p.row) for p in points], dtype=np.float64)
    return np.asarray(measured - np.array(places, dtype=np.float64).reshape(-1, 2))


def wrong_points(residuals: np.ndarray) -> np.ndarray:
    """Which control points ``[N]`` bool do not fit the others: mistaken in the image or in the list.

    Args:
        residuals: ``[N, 2]`` of `point_residuals` [px].
    """
    length = np.hypot(*residuals.T)
    return np.asarray(length > max(WRONG * float(np.median(length)), LEAST_WRONG_PX))


def shift_to_points(points: Sequence[ControlPoint], cameras: Mapping[str, RPC], crs: str) -> Shift:
    """The shift of all cameras under which control points fall where the images show them, by least squares.

    Points that do not fit the others lose their weight, so that one mistake among six moves nothing.

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

    def left(moved: np.ndarray) -> np.ndarray:
        return point_residuals(points, cameras, crs, moved)

    first = left(shift)
    for _ in range(STEPS_POINTS):
        residual = left(shift)
        if not np.isfinite(residual).all():
            raise InputError("control point: found one that its camera cannot see, expected points on its ground")
        # d(residual)/d(shift) by central differences: cameras are smooth over a metre
        columns = [(left(shift + STEP_M * e) - left(shift - STEP_M * e)).ravel() / (2 * STEP_M) for e in np.eye(3)]
        design = np.stack(columns, axis=1)
        if design.size < 9 or np.linalg.cond(design.T @ design) > WORST_CONDITION:
            east, north, up = _least_known(design)
            raise InputError(
                f"control points: found places that leave a direction open (east {east:.2f}, north {north:.2f}, up "
                f"{up:.2f}), expected them in two images or more"
            )
        length = np.hypot(*residual.T)
        weight = 1 / (1 + (length / (2 * max(float(np.median(length)), LEAST_SPREAD_PX))) ** 2)
        root = np.repeat(np.sqrt(weight), 2)
        step = -np.linalg.lstsq(root[:, None] * design, root * residual.ravel(), rcond=None)[0]
        shift = shift + step
        if np.abs(step).max() < 1e-4:
            break
    last = left(shift)
    east, north, up = (float(v) for v in shift)
    return Shift(east, north, up, nmad(first), nmad(last), last.size)


def _least_known(design: np.ndarray) -> np.ndarray:
    """The unit vector (east, north, up) of the shift that changes residuals least, pointing up."""
    axis = np.linalg.eigh(design.T @ design)[1][:, 0]
    return np.asarray(axis * (-1.0 if axis[2] < 0 else 1.0)) + 0.0


def _around(large: Grid, grid: Grid) -> Grid:
    """The part of a grid of large cells that lies around another one, in its CRS; all of it where CRS differ."""
    if large.crs != grid.crs:
        return large
    return large.part(*large.window(grid))


__all__ = [
    "RELIEF_M",
    "UNLIKE",
    "ControlPoint",
    "Method",
    "chosen",
    "point_residuals",
    "shift_to_dem",
    "shift_to_points",
    "wrong_points",
]

"""Bundle adjustment: image-space corrections of RPC cameras from tie points, together with the points themselves.

The correction of view v is a shift of its projections (the usual model for RPCs of one satellite scene: Fraser and
Hanley 2003, "Bias compensation in rational functions for IKONOS satellite imagery"), or an affine map of the pixel
where held-out tie points ask for it. Without ground control a common movement of everything cannot be seen; it is fixed
by making the sum of the shifts' lengths least, a robust mean of zero, so that one view that is far off does not drag
the block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sattools.camera.bundle import Block, Solution, residual_norm, solve, triangulate
from sattools.camera.heights import in_company
from sattools.camera.rpc import RPC
from sattools.camera.tracks import Tracks
from sattools.errors import InputError, counted
from sattools.progress import Progress, silent
from sattools.scene.jsonio import JsonObject

Array = NDArray[np.float64]

UNCHANGED = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))  # matrix of a view that is not corrected
CORRECTED = "; corrected"  # end of the note of a camera that was far off
_MANY = 30  # ground points of three views or more that tell the heights without those of two
_SURE = 12  # of two views, confirmed by neighbours, that do without the others
_ROUGHLY = 1e-3  # gain of a step at which cameras are good enough to tell false matches and to compare models
# pixels are those of the images
_LEAST_GAIN = 0.15  # share by which held-out squared residuals must fall for "affine"
_MAX_RESIDUAL_PX = 3.0  # larger residuals are no tie points, whatever the spread
_LEAST_POINTS = 12  # views with fewer tie points keep their camera
_OUTLIER_PX = 6.0  # a correction that long, and 5 times the median, makes a view an outlier


@dataclass(frozen=True)
class ViewAdjustment:
    """What was found for one view; residuals are lengths in pixels over its accepted tie points."""

    name: str
    shift_px: tuple[float, float]  # (col, row) added to the projection at the image's centre
    matrix: tuple[tuple[float, float, float], tuple[float, float, float]]  # old (col, row, 1) to new (col, row)
    tie_points: int
    median_before_px: float
    rms_before_px: float
    median_after_px: float
    rms_after_px: float
    outlier: bool
    note: str = ""
    weak: bool = False  # too few tie points: the camera is what the vendor says, right or wrong
    asked_px: tuple[float, float] = (0.0, 0.0)  # the shift that tie points ask for, which may not have been made


@dataclass(frozen=True)
class Adjustment:
    """Result of `adjust`.

    `points` are (lon, lat, h) `[n, 3]` of the accepted ground points, `tracks` their observations, `residuals` `[m, 2]`
    observed minus projected pixel of each observation with the corrected cameras, `residuals_before` `[m, 2]` the same
    with the cameras as they were.
    """

    rpcs: list[RPC]
    views: list[ViewAdjustment]
    model: str
    tracks: Tracks
    points: Array
    residuals: Array
    residuals_before: Array
    median_before_px: float
    median_after_px: float
    rms_after_px: float
    rejected: int  # observations dropped as false matches
    notes: list[str] = field(default_factory=list)

    @property
    def before_px(self) -> Array:
        """Lengths ``[m]`` of the residuals with the cameras as they were."""
        return np.hypot(*self.residuals_before.T)

    def left_alone(self, cameras: Sequence[RPC]) -> Adjustment:
        """What was found, where nothing of it is done: no camera is shifted, and residuals stay what they were.

        Args:
            cameras: as they were.
        """
        views = [
            replace(
                view, shift_px=(0.0, 0.0), matrix=UNCHANGED, median_after_px=view.median_before_px,
                rms_after_px=view.rms_before_px,
                note=view.note or "tie points ask for {:+.2f} {:+.2f} px".format(*view.asked_px),
            )
            for view in self.views
        ]  # fmt: skip
        return replace(
            self, rpcs=list(cameras), views=views, model="none", residuals=self.residuals_before,
            median_after_px=self.median_before_px, rms_after_px=_rms(self.before_px),
            notes=[note.replace(CORRECTED, "; left as it is") for note in self.notes],
        )  # fmt: skip

    def heights(self) -> Array:
        """Heights [m] of the ground points that are sure.

        Those seen by three views or more, of two views those that neighbours confirm; all where these are too few.
        """
        sure, enough = self.tracks.sizes() >= 3, _MANY
        if len(self.views) == 2:
            sure, enough = in_company(self.points), _SURE
        return self.points[sure if sure.sum() >= enough else slice(None), 2]

    def to_dict(self) -> JsonObject:
        """Plain types for JSON."""
        views = [
            {
                "id": v.name,
                "shift_px": list(v.shift_px),
                "matrix": [list(row) for row in v.matrix],
                "tie_points": v.tie_points,
                "median_before_px": v.median_before_px,
                "rms_before_px": v.rms_before_px,
                "median_after_px": v.median_after_px,
                "rms_after_px": v.rms_after_px,
                "outlier": v.outlier,
                "note": v.note,
            }
            for v in self.views
        ]
        return {
            "model": self.model,
            "ground_points": self.tracks.n_points,
            "observations": len(self.tracks.point),
            "rejected_observations": self.rejected,
            "median_before_px": self.median_before_px,
            "median_after_px": self.median_after_px,
            "rms_after_px": self.rms_after_px,
            "notes": self.notes,
            "views": views,
        }

    def to_text(self) -> str:
        """The residual report for people."""
        lines = [
            f"Bundle adjustment of {counted(len(self.views), 'views')}, correction per view: {self.model}",
            f"{self.tracks.n_points} ground points, {len(self.tracks.point)} observations, "
            f"{self.rejected} rejected as false matches",
            f"median residual {self.median_before_px:.2f} px before, {self.median_after_px:.2f} px after "
            f"(root mean square {self.rms_after_px:.2f} px)",
            "",
            "shift: pixels added to the projection (col, row) at the image's centre; residuals in pixels",
            f"{'view':24s} {'points':>6s} {'shift col':>9s} {'row':>8s} {'med before':>10s} {'after':>6s} "
            f"{'rms before':>10s} {'after':>6s}",
        ]
        for v in self.views:
            note = ("  OUTLIER VIEW" if v.outlier else "") + (f"  {v.note}" if v.note else "")
            lines.append(
                f"{v.name:24s} {v.tie_points:6d} {v.shift_px[0]:9.2f} {v.shift_px[1]:8.2f} "
                f"{v.median_before_px:10.2f} {v.median_after_px:6.2f} "
                f"{v.rms_before_px:10.2f} {v.rms_after_px:6.2f}{note}"
            )
        return "\n".join([*lines, *(f"note: {r}" for r in self.notes)]) + "\n"


def adjust(
    rpcs: Sequence[RPC],
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    tracks: Tracks,
    model: str = "auto",
    progress: Progress = silent,
) -> Adjustment:
    """Correct cameras from tie points.

    Args:
        rpcs: camera, name and (height, width) [px] of each view.
        names: camera, name and (height, width) [px] of each view.
        sizes: camera, name and (height, width) [px] of each view.
        tracks: tie points, false matches among them.
        model: ``shift``, ``affine``, or ``auto``: affine only where held-out tie points gain.
        progress: told the share done and what is being done.

    Raises: InputError when there are too few tie points to adjust anything.
    """
    if model not in ("auto", "shift", "affine"):
        raise InputError(f"adjustment: found model {model!r}, expected auto, shift or affine")
    if tracks.n_points < _LEAST_POINTS:
        raise InputError(
            f"tie points: found {tracks.n_points} between the images, expected at least {_LEAST_POINTS} "
            "(do the images overlap and show the same place?)"
        )
    notes: list[str] = []
    solved = _solve(Block(list(rpcs), list(sizes), tracks), model, notes, progress)
    block, solution, weak = solved.block, solved.solution, solved.weak
    raw = np.zeros_like(solution.parameters)
    residuals_before = block.residuals(triangulate(block, raw, solution.points), raw)
    before = np.hypot(*residuals_before.T)
    final_points = triangulate(block, solution.parameters, solution.points)
    final = block.residuals(final_points, solution.parameters)
    after = np.hypot(final[:, 0], final[:, 1])
    corrected, views = [], []
    for v, rpc in enumerate(rpcs):
        camera, misfit = rpc.with_affine(block.matrix(v, solution.parameters), block.domain(v))
        if misfit > 0.01:
            notes.append(f"{names[v]}: its affine correction is met by the RPC to {misfit:.3f} px only")
        corrected.append(camera)
        views.append(_describe(solved, v, names[v], (before, after), notes))
    parts = block.components(~weak)
    if parts > 1:
        notes.append(f"the views fall into {parts} groups without common tie points; each was adjusted by itself")
    progress(1.0, "adjusted")
    return Adjustment(
        corrected,
        views,
        solved.model,
        block.tracks,
        block.geographic(final_points),
        final,
        residuals_before,
        _median(before),
        _median(after),
        _rms(after),
        len(tracks.point) - len(block.tracks.point),
        notes,
    )


@dataclass(frozen=True)
class _Solved:
    """Cameras that agree with their tie points.

    Attributes:
        block: with the tie points that are kept.
        solution: of the block.
        model: ``shift`` or ``affine``.
        counts: ``[V]`` tie points of each view after the first pass.
        weak: ``[V]`` bool, views with too few.
    """

    block: Block
    solution: Solution
    model: str
    counts: NDArray[np.intp]
    weak: NDArray[np.bool_]


def _solve(block: Block, asked: str, notes: list[str], progress: Progress) -> _Solved:
    """Shifts first; they decide which observations are tie points at all. Then the model asked for."""
    views, tracks = len(block.rpcs), block.tracks
    progress(0.0, "adjusting shifts")
    solution = solve(block, affine=False, least_gain=_ROUGHLY)
    inlier = _inliers(block, solution)
    block, points = block.kept(inlier, solution.points)
    counts = np.bincount(block.tracks.view, minlength=views)
    matched = np.bincount(tracks.view, minlength=views)
    weak = _weak(counts, matched)
    if weak.any():
        block, points = block.kept(~weak[block.tracks.view], points)
    if block.tracks.n_points < _LEAST_POINTS:
        raise InputError(
            f"tie points: found {block.tracks.n_points} that agree with the cameras, expected at least "
            f"{_LEAST_POINTS} (do the RPCs belong to these images?)"
        )
    progress(0.4, "adjusting shifts again")
    solution = solve(block, False, Solution(points, solution.parameters))
    model = "shift"
    if asked == "affine" or (asked == "auto" and _affine_gains(block, solution, notes)):
        progress(0.7, "adjusting affine corrections")
        model = "affine"
        solution = solve(block, True, solution)
    inlier = _inliers(block, solution)
    block, points = block.kept(inlier, solution.points)
    weak |= np.bincount(block.tracks.view, minlength=views) == 0
    return _Solved(block, Solution(points, solution.parameters), model, counts, weak)


def _describe(solved: _Solved, v: int, name: str, residuals: tuple[Array, Array], notes: list[str]) -> ViewAdjustment:
    """What the adjustment has done to view ``v``: ``residuals`` of all observations before and after [px]."""
    before, after = residuals
    parameters, weak = solved.solution.parameters, solved.weak
    shifts = parameters[:, :2]
    length = np.hypot(shifts[:, 0], shifts[:, 1])
    limit = max(_OUTLIER_PX, 5.0 * float(np.median(length[~weak])) if (~weak).any() else 0.0)
    seen = solved.block.tracks.view == v
    note = ""
    if weak[v]:
        note = f"too few tie points ({solved.counts[v]} agree with the others): camera left as it is"
        notes.append(f"{name}: {note}")
    outlier = bool(length[v] > limit)
    if outlier:
        median = float(np.median(length))
        notes.append(f"{name}: camera was off by {length[v]:.1f} px (median view: {median:.1f} px){CORRECTED}")
    first, second = ((float(a), float(b), float(c)) for a, b, c in solved.block.matrix(v, parameters))
    return ViewAdjustment(
        name,
        (float(shifts[v, 0]), float(shifts[v, 1])),
        (first, second),
        int(seen.sum()),
        _median(before[seen]),
        _rms(before[seen]),
        _median(after[seen]),
        _rms(after[seen]),
        outlier,
        note,
        bool(weak[v]),
        (float(shifts[v, 0]), float(shifts[v, 1])),
    )


def _inliers(block: Block, solution: Solution) -> NDArray[np.bool_]:
    norm = residual_norm(block, solution.points, solution.parameters)
    # Rayleigh-distributed lengths: median = 1.177 sigma; 4 sigma keeps all but 3 in 10000 true ones.
    limit = min(_MAX_RESIDUAL_PX, max(1.0, 4.0 * float(np.median(norm)) / 1.177))
    return norm < limit


def _weak(counts: NDArray[np.intp], matched: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Views whose tie points may all be false: few, or a fraction of the others' and rejected more often than theirs.

    A mirrored image, or one of another place, has a dozen matches by chance. One that shows a corner of the area has
    few as well, but as many of them agree as elsewhere.
    """
    weak = counts < _LEAST_POINTS
    if weak.all():
        return weak
    share = counts / np.maximum(matched, 1)
    few = counts < 0.15 * np.median(counts[~weak])
    return np.asarray(weak | (few & (share < 0.8 * np.median(share[~weak]))))


def _affine_gains(block: Block, start: Solution, notes: list[str]) -> bool:
    """Whether affine corrections fitted on four fifths of the points predict the other fifth clearly better."""
    sizes = block.tracks.sizes()
    if int((sizes >= 3).sum()) < 20 * len(block.rpcs):
        return False
    held_point = (np.arange(block.tracks.n_points) % 5 == 2) & (sizes >= 3)
    held = held_point[block.tracks.point]
    scores = []
    train, train_points = block.kept(~held, start.points)
    test, test_points = block.kept(held, start.points)
    for affine in (False, True):
        fitted = solve(train, affine, Solution(train_points, start.parameters), least_gain=_ROUGHLY)
        points = triangulate(test, fitted.parameters, test_points)
        # Each view gets the same say, and a few false matches do not decide.
        norm2 = np.minimum(residual_norm(test, points, fitted.parameters), 2.0) ** 2
        per_view = np.bincount(test.tracks.view, norm2, len(block.rpcs)) / np.maximum(
            np.bincount(test.tracks.view, minlength=len(block.rpcs)), 1
        )
        scores.append(float(per_view[per_view > 0].mean()))
    gain = 1.0 - scores[1] / max(scores[0], 1e-12)
    chosen = gain >= _LEAST_GAIN
    notes.append(
        f"affine corrections change the mean squared residual of held-out tie points by {-100 * gain:+.1f} % "
        f"({scores[0]:.3f} to {scores[1]:.3f} px²): {'used' if chosen else 'not used'}"
    )
    return chosen


def _median(values: Array) -> float:
    return float(np.median(values)) if values.size else float("nan")


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


__all__ = ["Adjustment", "ViewAdjustment", "adjust"]

"""Does every view agree that it looks at this place? A left-right check on the ground grid, for any number of views.

A line of sight meets one surface. Matching chooses a height for every cell, without asking whether a ray that passes
there would rather end at another cell: a roof smeared over the ground beside it uses pixels that show the roof itself.
So every ray is asked where along it, over all cells and heights, the images agree best after aggregation. A cell stands
where most of the views that see it have their best place there; the others are filled from the lower side, as what is
not seen by enough views is more often ground behind a wall than roof.

What is small and high (a tree, a chimney, the rim of a tower) has a higher aggregated cost than the wide ground behind
it, which this view does not see and others do. So a view whose own pixel says otherwise is not counted against the
cell: where it looks like what the views see at the cell, and surely not like what they see at the ray's best place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from sattools.compiled import njit, spread
from sattools.prior.frame import Frame
from sattools.prior.neighbours import relief
from sattools.prior.visibility.occlusion import at_surface

SAME_PLANES = 3.0  # planes between a cell's height and its ray's best one that still count as the same place
UNLIKE = 0.07  # difference of brightness from which a pixel does not look like a place
LIKE = 0.25  # share of what it differs by beyond that from the best place, by which it may differ from the cell
FEWEST_LOOKS = 4  # views that say how a cell looks
REACH_M = 20.0  # distance within which a standing cell is looked for
SUPPORT_M = 3.0  # edge of the square around a cell that stands for a reason:
ALIKE, ALIKE_M = 0.45, 2.0  # this share of the cells there stand, too, within so many metres of its height
COMPANY = 0.5  # share of the cells there that stand, at any height, of what lies in shadow
CHANCE = 4  # views; fewer may agree by chance even where many pairs decide
RANK = 2  # of the heights found in eight directions, from the lowest: one or two may be holes themselves


@dataclass(frozen=True)
class RayMinima:
    """Where along every ray the images agree best.

    Attributes:
        cost: ``[V, Hf, Wf]`` float32 lowest aggregated cost on the ray through a frame position.
        height: ``[V, Hf, Wf]`` float32 height of that place [m]; NaN where no ray has been followed.
    """

    cost: np.ndarray
    height: np.ndarray

    @classmethod
    def unknown(cls, frame: Frame) -> RayMinima:
        """Nothing followed yet."""
        return cls(np.full(frame.images.shape, np.inf, np.float32), np.full(frame.images.shape, np.nan, np.float32))


def count_consistent_views(
    frame: Frame, first_hit_height: np.ndarray, minima: RayMinima, height: np.ndarray, tolerance: float, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Number of views whose rays have their best place at the surface, and number that see it: ``[H, W]`` uint8 each.

    Args:
        frame: the views.
        first_hit_height: ``[V, Hf, Wf]`` heights at which rays first meet the surface [m].
        minima: their best places.
        height: ``[H, W]`` [m].
        tolerance: depth below the visible surface that still counts as seen [m].
        step: distance of the height planes [m].
    """
    import cv2

    best, seen = at_surface(replace(frame, images=minima.height), first_hit_height, height, tolerance)
    near = np.float32(SAME_PLANES * step)
    agree = seen & (np.abs(best - height) <= near)
    smooth = np.stack([cv2.blur(image, (3, 3), borderType=cv2.BORDER_REPLICATE) for image in frame.images])
    value, _ = at_surface(replace(frame, images=smooth), first_hit_height, height, tolerance)
    look = np.empty_like(height)
    typical_look(value, seen, look)
    own_pixel_votes(value, seen, look, best, height, frame.parallax, near, agree)
    return agree.sum(axis=0, dtype=np.uint8), seen.sum(axis=0, dtype=np.uint8)


def standing(agreeing: np.ndarray, views: np.ndarray, taken: np.ndarray | bool = False) -> np.ndarray:
    """Cells ``[H, W]`` bool in which most of the views that see them have their best place.

    Args:
        agreeing: ``[H, W]`` views that have their best place there.
        views: ``[H, W]`` views that see it.
        taken: ``[H, W]`` bool cells that are taken to agree, whatever the views say.
    """
    return np.asarray((2 * agreeing.astype(np.int32) > views) | taken)


def supported(
    stands: np.ndarray,
    height: np.ndarray,
    agreeing: np.ndarray,
    cell: float,
    shaded: np.ndarray | None = None,
) -> np.ndarray:
    """Those of the cells that stand which do not do so by chance, ``[H, W]`` bool.

    In a place that is hidden from all views but two or three, or that looks different in all of them, now and then a
    cell is found where two agree, at any height; the heights of the whole place would be taken from such cells. They
    stand alone. Cells of one surface stand together, at one height.

    Where many pairs decide, four views hardly ever agree by chance, and what is small and high stays where they do;
    only in shadow, where every place looks like the next, such a cell needs others that stand around it.

    Args:
        stands: ``[H, W]`` bool.
        height: ``[H, W]`` float32 [m].
        agreeing: ``[H, W]`` views that have their best place there.
        cell: edge of a cell [m].
        shaded: ``[H, W]`` bool cells that lie in shadow, where many pairs decide; None = few do.
    """
    reach = max(1, round(SUPPORT_M / cell / 2))
    alike = np.zeros(stands.shape, bool)
    _alike(height, stands, reach, np.float32(ALIKE_M * relief(cell)), alike)
    if shaded is None:
        return alike
    alone = uniform_filter(stands.astype(np.float32), 2 * reach + 1, mode="nearest") < COMPANY
    return stands & (alike | (agreeing >= CHANCE)) & ~(shaded & alone)


def filled(height: np.ndarray, stands: np.ndarray, cell: float) -> np.ndarray:
    """Heights ``[H, W]`` in which cells that do not stand (``[H, W]`` bool) take one of the lower heights around.

    Of the nearest standing cells in eight directions the third lowest counts, or the highest of fewer; a cell without
    any within reach keeps its own.

    Args:
        height: ``[H, W]`` [m].
        stands: ``[H, W]`` bool.
        cell: edge of a cell [m].
    """
    result = height.copy()
    _fill(height, stands, max(1, round(REACH_M / cell)), result)
    return result


@spread(lambda total, parallax, *_: len(parallax))
@njit(cache=True, nogil=True)
def update_minima(total, parallax, heights, z_ref, row0, col0, cost, height, first_view, end_view):
    """Update the best places of all rays with the cells of a block.

    Args:
        total: ``[h, D, w]`` float32 aggregated cost.
        parallax: ``[V, 2]`` float64 (row, column) cells per metre of height.
        heights: ``[D]`` float64 [m].
        z_ref: reference height of the frame [m].
        row0: frame position of the block's first cell at that height.
        col0: frame position of the block's first cell at that height.
        cost: ``[V, Hf, Wf]`` float32, see `RayMinima`; changed.
        height: ``[V, Hf, Wf]`` float32, see `RayMinima`; changed.
        first_view: first view, from `spread`.
        end_view: the one after the last.
    """
    rows, depth, cols = total.shape
    for v in range(first_view, end_view):
        down, right = np.empty(depth, np.int64), np.empty(depth, np.int64)
        for k in range(depth):
            down[k] = row0 + round(parallax[v, 0] * (heights[k] - z_ref))
            right[k] = col0 + round(parallax[v, 1] * (heights[k] - z_ref))
        for row in range(rows):
            for k in range(depth):
                z = np.float32(heights[k])
                there = slice(right[k], right[k] + cols)
                here, least, best = total[row, k], cost[v, row + down[k], there], height[v, row + down[k], there]
                for col in range(cols):
                    best[col] = z if here[col] < least[col] else best[col]
                    least[col] = here[col] if here[col] < least[col] else least[col]


@njit(inline="always")
def _in_order(values, count, value):
    """Put a value among so many in ascending order; their new number. The compiler takes a second for numpy's sort."""
    at = count
    while at > 0 and values[at - 1] > value:
        values[at] = values[at - 1]
        at -= 1
    values[at] = value
    return count + 1


@spread(lambda value, *_: value.shape[1])
@njit(cache=True, nogil=True)
def typical_look(value, seen, look, first_row, end_row):
    """Median brightness of every cell in the views that see it.

    Args:
        value: ``[V, H, W]`` float32 what the views show of the surface.
        seen: ``[V, H, W]`` bool.
        look: ``[H, W]`` float32, filled; NaN where too few see it for their median not to be the pixel itself.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    views, _, cols = value.shape
    for row in range(first_row, end_row):
        shown = np.empty(views, np.float32)
        for col in range(cols):
            count = 0
            for v in range(views):
                if seen[v, row, col]:
                    count = _in_order(shown, count, value[v, row, col])
            look[row, col] = np.nan
            if count >= FEWEST_LOOKS:
                look[row, col] = (shown[(count - 1) // 2] + shown[count // 2]) / np.float32(2)


@spread(lambda value, *_: value.shape[1])
@njit(cache=True, nogil=True)
def own_pixel_votes(value, seen, look, best, height, parallax, near, agree, first_row, end_row):
    """Let views agree whose pixel looks like the cell and not like the best place of its ray, which lies below.

    Args:
        value: ``[V, H, W]`` float32 what the views show of the surface.
        seen: ``[V, H, W]`` bool.
        look: ``[H, W]`` float32, see `typical_look`.
        best: ``[V, H, W]`` float32 height of the best place on the ray through the cell [m]; NaN = none.
        height: ``[H, W]`` float32 [m].
        parallax: ``[V, 2]`` float64 (row, column) cells per metre of height.
        near: heights that differ by less are one place [m].
        agree: ``[V, H, W]`` bool; changed.
        first_row: first row, from `spread`.
        end_row: the one after the last.
    """
    views, rows, cols = value.shape
    for row in range(first_row, end_row):
        for col in range(cols):
            z = height[row, col]
            for v in range(views):
                below = best[v, row, col]
                # NaN compares false
                if agree[v, row, col] or not seen[v, row, col] or not below < z:
                    continue
                r, c = round(row + parallax[v, 0] * (z - below)), round(col + parallax[v, 1] * (z - below))
                if not (0 <= r < rows and 0 <= c < cols) or abs(height[r, c] - below) > near:
                    continue
                shown = value[v, row, col]
                agree[v, row, col] = abs(shown - look[row, col]) < LIKE * (abs(shown - look[r, c]) - UNLIKE)


@spread(lambda height, *_: len(height))
@njit(cache=True, nogil=True)
def _alike(height, stands, reach, dz, firm, first_row, end_row):
    """Set ``firm`` of standing cells to whether enough of the cells around stand and are as high."""
    rows, cols = height.shape
    for row in range(first_row, end_row):
        for col in range(cols):
            if not stands[row, col]:
                continue
            top, bottom = max(0, row - reach), min(rows, row + reach + 1)
            left, right = max(0, col - reach), min(cols, col + reach + 1)
            count = 0
            for r in range(top, bottom):
                for c in range(left, right):
                    count += stands[r, c] and abs(height[r, c] - height[row, col]) < dz
            firm[row, col] = count > ALIKE * (bottom - top) * (right - left)


@spread(lambda height, *_: len(height))
@njit(cache=True, nogil=True)
def _fill(height, stands, reach, result, first_row, end_row):
    rows, cols = height.shape
    for row in range(first_row, end_row):
        around = np.empty(8, np.float32)
        for col in range(cols):
            if stands[row, col]:
                continue
            count = 0
            for direction in range(9):
                dr, dc = direction // 3 - 1, direction % 3 - 1
                if dr == 0 and dc == 0:
                    continue
                for n in range(1, reach + 1):
                    r, c = row + n * dr, col + n * dc
                    if r < 0 or c < 0 or r >= rows or c >= cols:
                        break
                    if stands[r, c]:
                        count = _in_order(around, count, height[r, c])
                        break
            if count:
                result[row, col] = around[min(RANK, count - 1)]


__all__ = [
    "RayMinima",
    "count_consistent_views",
    "filled",
    "own_pixel_votes",
    "standing",
    "supported",
    "typical_look",
    "update_minima",
]

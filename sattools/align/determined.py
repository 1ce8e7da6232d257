"""Which parts of a shift two surfaces determine."""

from __future__ import annotations

import numpy as np

LEAST_SLOPE = 1e-3  # root mean square of what slopes of both have in common [m/m]
LEAST_CORRELATION = 0.1
CELLS_TOGETHER = 4  # cells whose slopes are alike, as central differences are
SIGNIFICANT = 3.0  # times the deviation of a correlation by chance
STEPS = 0.98  # slopes beyond this quantile are those of walls, which must not speak for the ground
ALONG = ("east and west", "north-east and south-west", "north and south", "north-west and south-east")


def slopes(height: np.ndarray, cell_size: float) -> np.ndarray:
    """Slopes eastwards and northwards ``[2, H, W]`` [m/m]; NaN beside unknown cells.

    Args:
        height: ``[H, W]`` [m], row 0 north; NaN = unknown.
        cell_size: edge of a cell [m].
    """
    south, east = np.gradient(height.astype(np.float64), cell_size)
    return np.stack([east, -south])


def open_direction(height: np.ndarray, reference: np.ndarray, cell_size: float, tilt: bool = False) -> str | None:
    """The horizontal direction in which slopes do not say how two surfaces lie; None where they say it in all.

    A shift along a direction changes heights by the slopes there, in so far as these differ from place to place
    (else it is a change of height; with a tilt, in so far as no plane explains them). What both surfaces have in
    common counts, so that noise is no relief.

    Args:
        height: ``[H, W]`` [m], about in place.
        reference: ``[H, W]`` [m].
        cell_size: edge of a cell [m].
        tilt: a tilt is looked for, too.
    """
    if min(height.shape) < 2:
        return "all directions"
    both = np.concatenate([slopes(height, cell_size), slopes(reference, cell_size)])
    known = np.isfinite(both).all(axis=0)
    count = int(known.sum())
    if not count:
        return "all directions"
    rows, cols = np.nonzero(known)
    plane = [np.ones(count), *([rows / height.shape[0], cols / height.shape[1]] if tilt else [])]
    design = np.stack(plane, axis=1)
    values = both[:, known].T
    own = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    largest = np.quantile(np.abs(own), STEPS, axis=0)
    here, there = np.split(np.clip(own, -largest, largest), 2, axis=1)
    common = here.T @ there / count
    _, axes = np.linalg.eigh((common + common.T) / 2)
    unknown = [axis for axis in axes.T if not _is_known(here @ axis, there @ axis)]
    if len(unknown) == 2:
        return "all directions"
    if not unknown:
        return None
    bearing = np.degrees(np.arctan2(unknown[0][1], unknown[0][0])) % 180
    return ALONG[round(bearing / 45) % 4]


def _is_known(here: np.ndarray, there: np.ndarray) -> bool:
    """Whether the slopes of two surfaces along one direction are those of one ground."""
    common = float((here * there).mean())
    if common < LEAST_SLOPE**2:
        return False
    correlation = common / float(np.sqrt((here**2).mean() * (there**2).mean()))
    by_chance = float(np.sqrt(CELLS_TOGETHER / here.size))
    return correlation > max(LEAST_CORRELATION, SIGNIFICANT * by_chance)


__all__ = ["open_direction", "slopes"]

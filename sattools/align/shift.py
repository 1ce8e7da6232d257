"""What a scene is moved by: a shift, and where it was asked for a tilt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sattools.scene.grid import Grid


@dataclass(frozen=True)
class Shift:
    """What has to be added to places on the ground, and what is left then.

    The tilt is a plane that heights are raised by. A turn of the whole would also move places sideways, by the tilt
    times their height above the middle: a centimetre where 100 m of relief are tilted by 0.0001.

    Attributes:
        east, north, up: [m].
        before, after: 1.4826 times the median absolute deviation (NMAD) of what is left without and with it [m],
            or [px] of control points.
        count: cells or coordinates that it rests on.
        tilt_east, tilt_north: rise of what is added to heights, along x and y [m/m].
        x, y: where the tilt adds nothing, before the move, in the ground's CRS [m].
        left: mean deviation of what is left, as a share of the surface's own: near 1, or above, where the reference
            has nothing in common with it; 0 = not known, as of control points and level ground.
    """

    east: float
    north: float
    up: float
    before: float
    after: float
    count: int
    tilt_east: float = 0.0
    tilt_north: float = 0.0
    x: float = 0.0
    y: float = 0.0
    left: float = 0.0

    @property
    def tilted(self) -> bool:
        """Whether there is a tilt."""
        return (self.tilt_east, self.tilt_north) != (0.0, 0.0)

    def text(self, unit: str) -> str:
        """What has been moved by how much, and what is left, in words; ``unit`` is that of `before` and `after`."""
        tilt = f", tilted by {1e3 * self.tilt_east:+.3f} and {1e3 * self.tilt_north:+.3f} mm/m along east and north"
        return (
            f"moved by {self.east:+.2f} m east, {self.north:+.2f} m north, {self.up:+.2f} m up"
            f"{tilt if self.tilted else ''}; NMAD {self.before:.2f} {unit} before, {self.after:.2f} {unit} after"
        )

    def rise(self, grid: Grid) -> np.ndarray:
        """What is added to the heights of a grid's cells, before the grid moves ``[H, W]`` [m]."""
        along_x, along_y = self.tilt_east * (grid.x() - self.x), self.tilt_north * (grid.y() - self.y)
        return np.asarray(self.up + along_x[None, :] + along_y[:, None], np.float64)

    def matrix(self) -> np.ndarray:
        """``[4, 4]`` that brings (x, y, height, 1) from before to after, in the ground's CRS [m]."""
        level = self.up - self.tilt_east * self.x - self.tilt_north * self.y
        return np.array(
            [[1, 0, 0, self.east], [0, 1, 0, self.north], [self.tilt_east, self.tilt_north, 1, level], [0, 0, 0, 1]],
            np.float64,
        )


__all__ = ["Shift"]

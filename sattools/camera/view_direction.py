"""The line of sight of a view, in one order and with one sign."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

SMALLEST_ANGLE = 1.0  # degrees between lines of sight; below it a height error of many cells moves nothing


class ViewDirection(NamedTuple):
    """Horizontal run of a view's parallel lines of sight per metre of height, from the ground to the sensor.

    Attributes:
        east: [m/m].
        north: [m/m].
    """

    east: float
    north: float

    def unit(self) -> tuple[float, float, float]:
        """Unit vector (east, north, up) to the sensor."""
        length = (self.east**2 + self.north**2 + 1) ** 0.5
        return self.east / length, self.north / length, 1 / length

    def in_cells(self, cell_size: float) -> tuple[float, float]:
        """(row, column) cells by which a line of sight moves per metre that it climbs; rows run south.

        Args:
            cell_size: [m].
        """
        return -self.north / cell_size, self.east / cell_size

    def parallax(self, cell_size: float) -> tuple[float, float]:
        """(row, column) cells by which a point is displaced in the view per metre that it stands higher.

        Args:
            cell_size: [m].
        """
        return self.north / cell_size, -self.east / cell_size


def angle_deg(a: Sequence[float], b: Sequence[float]) -> float:
    """Angle between two vectors [degrees]."""
    cosine = np.dot(a, b) / (np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


__all__ = ["SMALLEST_ANGLE", "ViewDirection", "angle_deg"]

"""The line of sight of a view, in one order and with one sign."""

from __future__ import annotations

from typing import NamedTuple


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


__all__ = ["ViewDirection"]

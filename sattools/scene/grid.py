"""The ground grid: a north-up raster of square cells in a projected CRS."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from affine import Affine

from sattools.errors import SceneError
from sattools.scene.jsonio import JsonObject

GRACE = 1.12  # times as wide as a pixel that a cell may be
FINE_ENOUGH_M = 0.5  # cells that nobody is given finer ones than for the sake of accuracy
SURROUNDINGS_M = 16.0  # around an area, in which things hide and shade parts of it
AROUND_TILE_M = 48.0  # the same around a tile without its overlap, whose neighbours the images show


@dataclass(frozen=True)
class Grid:
    """A north-up grid of square cells; row 0 is the northernmost row.

    Attributes:
        crs: projected CRS in metres, e.g. ``"EPSG:32617"``.
        left: easting of the left edge of the first column [m].
        top: northing of the upper edge of the first row [m].
        cell_size: edge of a cell [m].
        width: number of columns.
        height: number of rows.
    """

    crs: str
    left: float
    top: float
    cell_size: float
    width: int
    height: int

    def __post_init__(self) -> None:
        _check_cell(self.cell_size)
        if not (math.isfinite(self.left) and math.isfinite(self.top)):
            raise SceneError(f"grid: found its corner at {self.left}, {self.top}, expected finite numbers of metres")
        if self.width < 1 or self.height < 1:
            raise SceneError(f"grid: found {self.width} x {self.height} cells, expected at least 1 x 1")

    @classmethod
    def from_bounds(cls, crs: str, bounds: tuple[float, float, float, float], cell_size: float) -> Grid:
        """Smallest grid that covers ``bounds`` (west, south, east, north), edges on multiples of the cell size.

        Args:
            crs: projected ground CRS [m].
            bounds: (west, south, east, north) [m].
            cell_size: edge of a cell [m].

        Raises:
            SceneError: bounds the wrong way round, or a cell size that is none.
        """
        _check_cell(cell_size)
        west, south, east, north = bounds
        if not (east > west and north > south):
            raise SceneError(f"grid: found bounds {bounds}, expected west < east and south < north")
        # 1e-6 of a cell keeps bounds that already lie on the lattice from growing by a cell
        left = math.floor(west / cell_size + 1e-6) * cell_size
        top = math.ceil(north / cell_size - 1e-6) * cell_size
        width = max(1, math.ceil((east - left) / cell_size - 1e-6))
        height = max(1, math.ceil((top - south) / cell_size - 1e-6))
        return cls(crs, left, top, cell_size, width, height)

    @property
    def transform(self) -> Affine:
        """Affine transform from (column, row) corner coordinates to (easting, northing)."""
        return Affine(self.cell_size, 0.0, self.left, 0.0, -self.cell_size, self.top)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns), as numpy has them."""
        return self.height, self.width

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(west, south, east, north) [m]."""
        return (
            self.left,
            self.top - self.height * self.cell_size,
            self.left + self.width * self.cell_size,
            self.top,
        )

    @property
    def middle(self) -> tuple[float, float]:
        """(easting, northing) of the middle [m]."""
        west, south, east, north = self.bounds
        return (west + east) / 2, (south + north) / 2

    def x(self) -> np.ndarray:
        """Eastings of the cell centres, ``[W]`` float64."""
        return self.left + (np.arange(self.width) + 0.5) * self.cell_size

    def y(self) -> np.ndarray:
        """Northings of the cell centres, ``[H]`` float64, falling."""
        return self.top - (np.arange(self.height) + 0.5) * self.cell_size

    def resized(self, cell_size: float) -> Grid:
        """The same upper left corner with another cell size [m], covering at least the same area."""
        _check_cell(cell_size)
        width = math.ceil(self.width * self.cell_size / cell_size - 1e-6)
        height = math.ceil(self.height * self.cell_size / cell_size - 1e-6)
        return replace(self, cell_size=cell_size, width=max(1, width), height=max(1, height))

    def part(self, rows: slice, cols: slice) -> Grid:
        """The cells of these rows and columns, slices with both ends, which may lie beyond the grid."""
        return replace(
            self,
            left=self.left + cols.start * self.cell_size,
            top=self.top - rows.start * self.cell_size,
            width=cols.stop - cols.start,
            height=rows.stop - rows.start,
        )

    def widened(self, cells: int) -> Grid:
        """The same with that many more cells on every side."""
        return self.part(slice(-cells, self.height + cells), slice(-cells, self.width + cells))

    def moved(self, east_m: float, north_m: float) -> Grid:
        """The same cells elsewhere.

        Args:
            east_m: eastwards [m].
            north_m: northwards [m].
        """
        return replace(self, left=self.left + east_m, top=self.top + north_m)

    def window(self, other: Grid) -> tuple[slice, slice]:
        """Rows and columns of this grid that another one covers. Raises SceneError where it covers none."""
        west, south, east, north = other.bounds
        c0, c1 = (round((x - self.left) / self.cell_size) for x in (west, east))
        r0, r1 = (round((self.top - y) / self.cell_size) for y in (north, south))
        r0, r1, c0, c1 = max(0, r0), min(self.height, r1), max(0, c0), min(self.width, c1)
        if c0 >= c1 or r0 >= r1:
            raise SceneError(f"grid: found bounds {other.bounds} outside {self.bounds}, expected some within")
        return slice(r0, r1), slice(c0, c1)

    def to_dict(self) -> JsonObject:
        """JSON form."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Grid:
        """Inverse of `to_dict`; raises SceneError when a member is missing or of the wrong type."""
        try:
            return cls(
                str(data["crs"]),
                float(data["left"]),
                float(data["top"]),
                float(data["cell_size"]),
                int(data["width"]),
                int(data["height"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise SceneError(f"grid: found {dict(data)}, expected crs, left, top, cell_size, width, height") from error


def _check_cell(cell_size: float) -> None:
    if not (cell_size > 0 and math.isfinite(cell_size)):
        raise SceneError(f"grid: found cell size {cell_size}, expected a positive number of metres")


def default_cell_size(gsd: float) -> float:
    """The round cell size (0.5, 1, 2, 5, 10 ... m) that suits a ground sample distance [m]: the next one below it.

    Cells of one to two pixels cost a tenth to a half of the accuracy, on towns and on hills. But what stands in towns
    is as large whatever the pixels are: of less than half a metre, cells are the next ones above.

    Args:
        gsd: edge of a pixel on the ground [m].
    """
    exponent = math.floor(math.log10(gsd))
    sizes = [digit * 10.0**power for power in (exponent - 1, exponent, exponent + 1) for digit in (1.0, 2.0, 5.0)]
    above = next(size for size in sizes if size >= 0.9 * gsd)
    below = max(size for size in sizes if size <= GRACE * gsd)
    return round(max(below, min(above, FINE_ENOUGH_M)), 6)


def finer_pixel(sizes: Sequence[float]) -> float:
    """The pixel that cells are made for [m]: that of the finest quarter of the images, but of three at least.

    Args:
        sizes: edges of the images' pixels on the ground [m].
    """
    return float(sorted(sizes)[min(max(3, math.ceil(len(sizes) / 4)), len(sizes)) - 1])


__all__ = ["AROUND_TILE_M", "SURROUNDINGS_M", "Grid", "default_cell_size", "finer_pixel"]

"""Cars that stand elsewhere in every image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sattools.errors import InputError
from sattools.simulate.world import World

SIZE_M = (4.4, 1.8, 1.5)  # length, width, height
# white, silver, black, red, blue: what the eye finds on a car park
PAINTS = np.array([[0.8, 0.8, 0.78], [0.5, 0.5, 0.52], [0.04, 0.04, 0.045], [0.4, 0.05, 0.05], [0.07, 0.1, 0.3]])
TRIES = 60


def with_cars(world: World, count: int, half_size_m: float, rng: np.random.Generator) -> tuple[World, int]:
    """The world with `count` cars along its streets, within `half_size_m` of its middle; and how many found room.

    Raises InputError where there are no streets.

    Args:
        world: without cars.
        count: number of cars.
        half_size_m: see above [m].
        rng: random numbers.
    """
    if world.streets is None or not world.streets.any():
        raise InputError("--cars: found no streets in this terrain, expected --terrain city")
    height, albedo, wall = world.height.copy(), world.albedo.copy(), world.wall_albedo.copy()
    slope_x, slope_y, windows = world.slope_x.copy(), world.slope_y.copy(), world.windows.copy()
    free = world.streets.copy()
    rows, columns = world.shape
    reach = half_size_m / world.cell_size
    inside = np.zeros_like(free)
    middle_r, middle_c = rows / 2, columns / 2
    inside[
        max(0, int(middle_r - reach)) : int(middle_r + reach), max(0, int(middle_c - reach)) : int(middle_c + reach)
    ] = True
    places = np.argwhere(free & inside)
    long, wide = (max(1, round(v / world.cell_size)) for v in SIZE_M[:2])
    parked = 0
    for _ in range(TRIES * count if len(places) else 0):
        if parked == count:
            break
        row, column = places[rng.integers(len(places))]
        shape = (wide, long) if _open(free, row, column, 0, 3 * long) else (long, wide)
        area = (slice(row, row + shape[0]), slice(column, column + shape[1]))
        if free[area].shape != shape or not free[area].all():
            continue
        height[area] = height[area].max() + SIZE_M[2]
        paint = PAINTS[rng.integers(len(PAINTS))] * rng.uniform(0.9, 1.1)
        albedo[area] = wall[area] = paint
        slope_x[area] = slope_y[area] = 0.0
        windows[area] = 0
        free[area] = False
        parked += 1
    with_them = replace(
        world, height=height, albedo=albedo, wall_albedo=wall, slope_x=slope_x, slope_y=slope_y, windows=windows
    )
    return with_them, parked


def _open(free: np.ndarray, row: int, column: int, axis: int, length: int) -> bool:
    """Whether the street goes on across columns (axis 0) for `length` cells."""
    part = free[row, column : column + length] if axis == 0 else free[row : row + length, column]
    return part.size == length and bool(part.all())


__all__ = ["with_cars"]

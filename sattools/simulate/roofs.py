"""Roofs that are neither flat nor plain: parapets, clutter, barrel vaults, domes, round towers."""

from __future__ import annotations

import numpy as np

from sattools.simulate.canvas import Canvas
from sattools.simulate.materials import code
from sattools.simulate.world import BUILDING

PARAPET_M, PARAPET_WIDE_M = 1.0, 0.5
PLANT = ("metal", "concrete", "white", "tar", "glazed")
Area = tuple[slice, slice]


def parapet(canvas: Canvas, area: Area, top: float) -> None:
    """A rim around a flat roof.

    Args:
        canvas: gets it.
        area: of the roof.
        top: height of the roof [m].
    """
    wide = max(1, round(PARAPET_WIDE_M / canvas.cell))
    height = canvas.height[area]
    rim = np.ones(height.shape, bool)
    rim[wide:-wide, wide:-wide] = False
    rim &= height == height.dtype.type(top)
    height[rim] = top + PARAPET_M
    canvas.material[area][rim] = code("concrete")


def clutter(canvas: Canvas, area: Area, top: float, rng: np.random.Generator) -> None:
    """Plant rooms, air conditioners, tanks, ducts and a mast, one on each 40 square metres of a flat roof.

    Args:
        canvas: gets it.
        area: of the roof.
        top: height of the roof [m].
        rng: random numbers.
    """
    rows, columns = canvas.height[area].shape
    extent = rows * canvas.cell, columns * canvas.cell
    if min(extent) < 5:
        return
    upper, left = area[0].start * canvas.cell, area[1].start * canvas.cell
    for _ in range(max(2, round(extent[0] * extent[1] / 40))):
        kind = rng.random()
        deep, wide, high = rng.uniform(0.8, 3.0), rng.uniform(0.8, 4.0), rng.uniform(0.6, 2.5)
        if kind < 0.12:
            deep, wide, high = rng.uniform(3, 5), rng.uniform(3, 6), rng.uniform(2.5, 4.0)
        elif kind < 0.25:
            deep, wide, high = 0.5, rng.uniform(4, 9), 0.6
        elif kind < 0.3:
            deep, wide, high = 0.25, 0.25, rng.uniform(4, 9)
        y = upper + 1 + rng.uniform(0, max(extent[0] - deep - 2, 0.1))
        x = left + 1 + rng.uniform(0, max(extent[1] - wide - 2, 0.1))
        part = canvas.box(x, y, min(x + wide, left + extent[1] - 1), min(y + deep, upper + extent[0] - 1))
        if not canvas.height[part].size:
            continue
        canvas.height[part] = top + high
        canvas.wall[part] = rng.uniform(0.1, 0.6)
        canvas.windows[part] = 0
        canvas.paint(part, str(rng.choice(PLANT)), float(rng.uniform(0.7, 1.3)))


def barrel(canvas: Canvas, area: Area, eaves: float, rise: float, roof: str, wall: np.ndarray) -> None:
    """A vault that rises from the eaves over an area, its axis along the longer side.

    Args:
        canvas: gets it.
        area: of the roof.
        eaves: height of its lower edge [m].
        rise: of its middle above it [m].
        roof: material.
        wall: reflectance of the walls.
    """
    canvas.flat(area, eaves, roof, wall)
    rows, columns = canvas.height[area].shape
    along_x = columns >= rows
    count = rows if along_x else columns
    u = (np.arange(count) + 0.5) / count * 2 - 1
    climb = rise * np.sqrt(np.clip(1 - u**2, 0, 1))
    slope = np.gradient(climb, canvas.cell) if count > 1 else np.zeros(count)
    if along_x:
        canvas.height[area] += climb[:, None]
        canvas.slope_y[area] = slope[:, None]
    else:
        canvas.height[area] += climb[None]
        canvas.slope_x[area] = slope[None]


def dome(canvas: Canvas, area: Area, top: float, roof: str) -> None:
    """Half a sphere on a drum in the middle of a flat roof.

    Args:
        canvas: gets it.
        area: of the roof.
        top: height of the roof [m].
        roof: material.
    """
    rows, columns = canvas.height[area].shape
    radius = 0.38 * min(rows, columns) * canvas.cell
    distance = _from_middle(rows, columns) * canvas.cell / max(radius, 1e-6)
    inside = distance < 1
    ball = top + 2.0 + radius * np.sqrt(np.clip(1 - distance**2, 0, 1))
    canvas.height[area][inside] = ball[inside]
    for slopes, axis in ((canvas.slope_y, 0), (canvas.slope_x, 1)):
        slopes[area][inside] = np.clip(np.gradient(ball, canvas.cell, axis=axis), -3, 3)[inside]
    canvas.material[area][inside] = code(roof)


def cylinder(canvas: Canvas, area: Area, top: float, roof: str, wall: np.ndarray, number: int) -> None:
    """A round tower that fills an area, with a rim around its roof.

    Args:
        canvas: gets it (a `Town`).
        area: of the tower.
        top: height of the roof [m].
        roof: material.
        wall: reflectance of the walls.
        number: of the building.
    """
    rows, columns = canvas.height[area].shape
    distance = _from_middle(rows, columns) / (0.5 * min(rows, columns))
    inside = distance < 1
    canvas.height[area][inside] = np.where(distance > 0.95, top + PARAPET_M, top)[inside]
    canvas.slope_x[area][inside] = canvas.slope_y[area][inside] = 0.0
    canvas.classes[area][inside], canvas.material[area][inside] = BUILDING, code(roof)
    canvas.wall[area][inside], canvas.windows[area][inside] = wall, 2 + number % 3
    building = getattr(canvas, "building", None)
    if building is not None:
        building[area][inside] = number


def _from_middle(rows: int, columns: int) -> np.ndarray:
    """Distance of every cell ``[H, W]`` from the middle [cells]."""
    y, x = np.indices((rows, columns))
    return np.hypot(y + 0.5 - rows / 2, x + 0.5 - columns / 2)


__all__ = ["barrel", "clutter", "cylinder", "dome", "parapet"]

"""A small city: blocks of houses, slabs, courtyards, a park and a tower between streets."""

from __future__ import annotations

import math

import numpy as np

from sattools.simulate.canvas import Canvas, cells_across, ground
from sattools.simulate.materials import albedo_map, code
from sattools.simulate.world import GROUND, WATER, World

STREET_M = 13.0
BLOCK_M = 45.0
TOWER_M = 35.0
NEIGHBOURS = ("park", "houses", "houses", "houses", "courtyard", "courtyard", "slabs", "slabs")


def build_city(
    centre: tuple[float, float],
    size_m: float,
    cell_size: float,
    base_m: float,
    rng: np.random.Generator,
    *,
    rotation_deg: float = 11.0,
    margin_m: float = 45.0,
    trees: bool = True,
) -> World:
    """A city that covers a north-up square of `size_m` metres and `margin_m` around it; the tower stands in its middle.

    `base_m` is the height of the ground. The blocks are turned by `rotation_deg`, so that no wall follows the grid.

    Args:
        centre: (easting, northing) [m].
        size_m: edge of the square [m].
        cell_size: edge of a cell [m].
        base_m: height of the ground [m].
        rng: random numbers.
        rotation_deg: of the streets [degrees].
        margin_m: see above [m].
        trees: plant some.
    """
    angle = math.radians(rotation_deg)
    count = cells_across(size_m, angle, margin_m, cell_size)
    side = count * cell_size
    canvas = Canvas(cell_size, ground(count, cell_size, base_m, rng))
    pitch = BLOCK_M + STREET_M
    middle = math.ceil(side / 2 / pitch)
    starts = side / 2 - BLOCK_M / 2 + pitch * np.arange(-middle, middle + 1)
    near = list(rng.permutation(NEIGHBOURS))  # the eight blocks about the tower show every kind
    for j, y in enumerate(starts):
        for i, x in enumerate(starts):
            ring = max(abs(i - middle), abs(j - middle))
            kind = "tower" if ring == 0 else near.pop() if ring == 1 else str(rng.choice(NEIGHBOURS))
            _block(canvas, kind, float(x), float(y), rng)
    _streets(canvas, starts, side)
    if trees:
        _street_trees(canvas, starts, rng)
    return World(
        centre,
        rotation_deg,
        cell_size,
        canvas.height.astype(np.float32),
        canvas.slope_x.astype(np.float32),
        canvas.slope_y.astype(np.float32),
        canvas.classes,
        albedo_map(canvas.material, canvas.tint, cell_size, rng),
        canvas.wall,
        canvas.windows,
        np.isin(canvas.material, (code("asphalt"), code("marking"))) & (canvas.classes == GROUND),
        canvas.bare(),
    )


def _wall(rng: np.random.Generator) -> np.ndarray:
    tones = np.array([[0.42, 0.38, 0.32], [0.33, 0.24, 0.19], [0.5, 0.49, 0.46], [0.3, 0.31, 0.33]], np.float32)
    return tones[rng.integers(len(tones))] * np.float32(rng.uniform(0.85, 1.15))


def _block(canvas: Canvas, kind: str, x: float, y: float, rng: np.random.Generator) -> None:
    whole = canvas.box(x, y, x + BLOCK_M, y + BLOCK_M)
    canvas.paint(whole, "pavement")
    canvas.paint(canvas.box(x + 2.5, y + 2.5, x + BLOCK_M - 2.5, y + BLOCK_M - 2.5), "grass")
    if kind == "houses":
        _houses(canvas, x, y, rng)
    elif kind == "courtyard":
        _court(canvas, (x + 4, y + 4), BLOCK_M - 8, float(rng.uniform(11, 17)), float(rng.uniform(9, 13)), rng)
    elif kind == "tower":
        _tower(canvas, x, y, rng)
    elif kind == "park":
        _park(canvas, x, y, rng)
    else:
        _slabs(canvas, x, y, rng)


def _houses(canvas: Canvas, x: float, y: float, rng: np.random.Generator) -> None:
    for j in range(2):
        for i in range(3):
            w, d = rng.uniform(8, 10.5), rng.uniform(10, 14)
            left = x + 3 + i * 13.5 + rng.uniform(0, 2)
            top = y + 4 + j * 21 + rng.uniform(0, 4)
            area = canvas.box(left, top, left + w, top + d)
            roof = ("tiles", "slate", "tiles", "metal")[rng.integers(4)]
            eaves = canvas.level(area) + float(rng.uniform(3.2, 6.0))
            canvas.gable(area, eaves, float(rng.uniform(1.8, 3.2)), bool(rng.integers(2)), roof, _wall(rng))


def _slabs(canvas: Canvas, x: float, y: float, rng: np.random.Generator) -> None:
    canvas.paint(canvas.box(x + 2.5, y + 2.5, x + BLOCK_M - 2.5, y + BLOCK_M - 2.5), "asphalt", 1.25)
    lower, upper = float(rng.uniform(5, 8)), float(rng.uniform(13, 20))
    roof = ("gravel", "membrane", "tar")[rng.integers(3)]
    area = canvas.box(x + 5, y + 5, x + 39, y + 22)
    base = canvas.level(area)
    wall = _wall(rng)
    canvas.flat(area, base + lower, roof, wall)
    canvas.flat(canvas.box(x + 5, y + 5, x + 21, y + 40), base + upper, "gravel", wall)
    _roof_units(canvas, (x + 6, y + 6), (14, 32), base + upper, 4, rng)
    _roof_units(canvas, (x + 22, y + 6), (16, 14), base + lower, 2, rng)


def _court(
    canvas: Canvas,
    corner: tuple[float, float],
    side: float,
    height: float,
    courtyard: float,
    rng: np.random.Generator,
) -> None:
    x, y = corner
    area = canvas.box(x, y, x + side, y + side)
    base, wall = canvas.level(area), _wall(rng)
    canvas.flat(area, base + height, "tar", wall, float(rng.uniform(1.0, 1.8)))
    canvas.flat(canvas.box(x, y, x + side, y + side * 0.3), base + height * 0.75, "gravel", wall)
    _roof_units(canvas, (x + 1, y + side * 0.75), (side - 2, side * 0.2), base + height, 3, rng)
    low = (side - courtyard) / 2
    inner = canvas.box(x + low, y + low, x + low + courtyard, y + low + courtyard)
    canvas.height[inner] = canvas.ground[inner]
    canvas.slope_y[inner], canvas.slope_x[inner] = (g[inner] for g in np.gradient(canvas.ground, canvas.cell))
    canvas.classes[inner], canvas.windows[inner] = GROUND, 0
    canvas.paint(inner, "pavement", 0.9)


def _tower(canvas: Canvas, x: float, y: float, rng: np.random.Generator) -> None:
    """A tower and three wings about a courtyard of 8 m."""
    _court(canvas, (x + 4, y + 4), BLOCK_M - 8, 16.0, 8.0, rng)
    area = canvas.box(x + 5, y + 5, x + 18, y + 31)
    top = canvas.level(area) + TOWER_M
    canvas.flat(area, top, "membrane", np.array([0.36, 0.37, 0.4], np.float32), 0.8)
    _roof_units(canvas, (x + 6, y + 6), (11, 24), top, 3, rng)


def _park(canvas: Canvas, x: float, y: float, rng: np.random.Generator) -> None:
    pond = canvas.box(x + 22, y + 24, x + 38, y + 34)
    if canvas.ground[pond].size:
        canvas.height[pond] = canvas.ground[pond].min() - 0.3
        canvas.slope_x[pond] = canvas.slope_y[pond] = 0.0
        canvas.classes[pond] = WATER
    canvas.paint(pond, "water")
    for path in ((x, y + 17, x + BLOCK_M, y + 19.5), (x + 18, y, x + 20, y + BLOCK_M)):
        canvas.paint(canvas.box(*path), "soil")
    for _ in range(9):
        tx, ty = rng.uniform(4, BLOCK_M - 4, 2)
        canvas.tree(x + tx, y + ty, float(rng.uniform(2.2, 4.0)), float(rng.uniform(6, 11)), rng)


def _roof_units(
    canvas: Canvas,
    corner: tuple[float, float],
    size: tuple[float, float],
    top: float,
    count: int,
    rng: np.random.Generator,
) -> None:
    """Plant rooms and air conditioners."""
    (x, y), (w, d) = corner, size
    for _ in range(count):
        uw, ud = rng.uniform(1.5, 3.5, 2)
        ux, uy = x + rng.uniform(0, max(w - uw, 0.1)), y + rng.uniform(0, max(d - ud, 0.1))
        area = canvas.box(ux, uy, ux + uw, uy + ud)
        canvas.flat(area, top + float(rng.uniform(1.0, 2.5)), "metal", np.array([0.4, 0.4, 0.4], np.float32))
        canvas.windows[area] = 0


def _streets(canvas: Canvas, starts: np.ndarray, side: float) -> None:
    """Dashed middle lines and zebra crossings; they only fall on asphalt."""

    def mark(x0: float, y0: float, x1: float, y1: float) -> None:
        area = canvas.box(x0, y0, x1, y1)
        street = canvas.material[area] == code("asphalt")
        street &= canvas.classes[area] == GROUND
        canvas.material[area][street] = code("marking")

    for start in starts:
        line = float(start) + BLOCK_M + STREET_M / 2
        for s in np.arange(0, side, 6.0):
            mark(line - 0.15, s, line + 0.15, s + 3)
            mark(s, line - 0.15, s + 3, line + 0.15)
        for other in starts:
            for k in np.arange(1.0, STREET_M - 1, 1.0):
                edge = float(other) + BLOCK_M
                mark(line - STREET_M / 2 + k, edge - 4, line - STREET_M / 2 + k + 0.5, edge - 1)
                mark(edge - 4, line - STREET_M / 2 + k, edge - 1, line - STREET_M / 2 + k + 0.5)


def _street_trees(canvas: Canvas, starts: np.ndarray, rng: np.random.Generator) -> None:
    for y in starts:
        for x in starts:
            for s in np.arange(6.0, BLOCK_M - 4, 9.0):
                if rng.random() < 0.35:
                    at = float(x + s), float(y + BLOCK_M - 0.2)
                    canvas.tree(*at, float(rng.uniform(1.6, 2.6)), float(rng.uniform(4.5, 8)), rng)

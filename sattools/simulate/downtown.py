"""The middle of a big city: narrow streets, closed rows, halls, towers of 50 to 150 m, trees, a canal."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from sattools.simulate.canvas import Canvas, cells_across, ground
from sattools.simulate.detailed import BALCONIES, LEAFY, NO_CROWN, PLAIN, WINDOWS, DetailedWorld, mirror_of
from sattools.simulate.materials import albedo_map, code
from sattools.simulate.roofs import barrel, clutter, cylinder, dome, parapet
from sattools.simulate.world import BUILDING, GROUND, TREES, WATER

STREETS_M = (6.0, 7.0, 8.0, 9.0, 15.0)
BLOCKS_M = (28.0, 46.0)
CANAL_M, QUAY_M = 15.0, 2.5
TOWERS_M = (50.0, 150.0)
FIRST = ("rows", "park", "tower", "hall", "offices", "court", "rows", "square")  # about the middle: every kind
KINDS = ("rows", "rows", "offices", "offices", "offices", "court", "tower", "hall", "park")
FLAT_ROOFS = ("gravel", "membrane", "tar", "white", "glazed", "metal", "concrete")
SLOPED_ROOFS = ("tiles", "slate", "metal", "copper")


class Town(Canvas):
    """A canvas with crowns over the ground and buildings that have numbers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = self.ground.shape
        self.material[:] = code("asphalt")
        self.crown_top, self.crown_base = (np.full(shape, NO_CROWN, np.float32) for _ in range(2))
        self.leaf_tint = np.ones(shape, np.float32)
        self.evergreen = np.zeros(shape, bool)
        self.building = np.zeros(shape, np.uint16)
        self.buildings = 0

    def stand(self, area: tuple[slice, slice], rng: np.random.Generator) -> tuple[float, np.ndarray]:
        """A new building's number goes to an area; the height of its ground, and the colour of its walls."""
        self.buildings += 1
        self.building[area] = self.buildings
        grey = rng.uniform(0.1, 0.55)
        return self.level(area), (grey * rng.uniform(0.75, 1.25, 3)).astype(np.float32)

    def look(self, area: tuple[slice, slice], rng: np.random.Generator) -> None:
        """A way the walls of an area look."""
        self.windows[area] = rng.integers(WINDOWS, BALCONIES + 1)

    def crown(self, x: float, y: float, radius: float, top: float, rng: np.random.Generator) -> None:
        """A tree of one of four shapes, of some lobes, on what is still ground.

        Args:
            x: middle along columns [m].
            y: middle along rows [m].
            radius: of the crown [m].
            top: height of the tree [m].
            rng: random numbers.
        """
        shape, evergreen = str(rng.choice(("round", "cone", "vase", "lobes"))), rng.random() < 0.35
        tint = float(rng.uniform(0.7, 1.4))
        lobes = [(0.0, 0.0, 1.0)]
        if shape == "lobes":
            lobes = [
                (float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-0.5, 0.5)), float(rng.uniform(0.45, 0.7)))
                for _ in range(4)
            ]
        for right, down, share in lobes:
            self._lobe(
                (x + right * radius, y + down * radius), share * radius, (1 - 0.2 * (1 - share)) * top, shape, rng
            )
        area = self.box(x - radius, y - radius, x + radius, y + radius)
        new = (self.crown_top[area] > NO_CROWN) & (self.classes[area] != TREES)
        self.classes[area][new] = TREES
        self.leaf_tint[area][new], self.evergreen[area][new] = tint, evergreen

    def _lobe(self, at: tuple[float, float], radius: float, top: float, shape: str, rng: np.random.Generator) -> None:
        area = self.box(at[0] - radius, at[1] - radius, at[0] + radius, at[1] + radius)
        rows = (np.arange(area[0].start, area[0].stop) + 0.5) * self.cell - at[1]
        columns = (np.arange(area[1].start, area[1].stop) + 0.5) * self.cell - at[0]
        distance = np.hypot(rows[:, None], columns[None]) / max(radius, 1e-6)
        if not distance.size:
            return
        ragged = distance + rng.normal(0.0, 0.05, distance.shape)
        arch = np.sqrt(np.clip(1 - ragged**2, 0, 1))
        if shape == "cone":
            high, low = top * (0.25 + 0.75 * (1 - ragged)), np.full_like(arch, 0.12 * top)
        elif shape == "vase":
            high, low = top * (0.75 + 0.25 * arch), top * (0.3 + 0.35 * np.clip(ragged, 0, 1))
        else:
            high, low = top * (0.6 + 0.4 * arch), top * (0.6 - 0.35 * arch)
        ground = self.ground[area]
        inside = (ragged < 1) & np.isin(self.classes[area], (GROUND, TREES)) & (high > low + 0.3)
        inside &= ground + high > self.crown_top[area]
        self.crown_top[area][inside] = (ground + high)[inside]
        self.crown_base[area][inside] = (ground + low)[inside]


def build_downtown(
    centre: tuple[float, float],
    size_m: float,
    cell_size: float,
    base_m: float,
    rng: np.random.Generator,
    *,
    trees: bool = True,
    margin_m: float = 80.0,
) -> DetailedWorld:
    """A town that covers a north-up square of `size_m` metres and `margin_m` around it, turned by an angle of its own.

    Args:
        centre: (easting, northing) [m].
        size_m: edge of the square [m].
        cell_size: edge of a cell [m].
        base_m: height of the ground [m].
        rng: random numbers.
        trees: plant some.
        margin_m: see above [m].
    """
    rotation = float(rng.uniform(5, 40))
    angle = math.radians(rotation)
    count = cells_across(size_m, angle, margin_m, cell_size)
    side = count * cell_size
    town = Town(cell_size, ground(count, cell_size, base_m, rng))
    columns, rows = (_plots(side, rng) for _ in range(2))
    canal = int(rng.choice([k for k, (low, high) in enumerate(columns) if abs((low + high) / 2 - side / 2) > 25][:-1]))
    kinds = list(rng.permutation(FIRST))
    order = sorted(
        ((x, y) for x in columns for y in rows),
        key=lambda plot: max(abs(sum(plot[0]) - side), abs(sum(plot[1]) - side)),
    )
    for (x0, x1), (y0, y1) in order:
        kind = kinds.pop() if kinds else str(rng.choice(KINDS))
        _block(town, kind, (x0, y0, x1, y1), rng, trees)
    _canal(town, columns[canal][1], side)
    if trees:
        _street_trees(town, columns, rows, rng)
    return _world(town, centre, rotation, rng)


def _plots(side: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Blocks between streets along one axis: lowest and highest coordinate of each [m]."""
    plots, at = [], -float(rng.uniform(0, BLOCKS_M[0]))
    while at < side:
        end = at + float(rng.uniform(*BLOCKS_M))
        plots.append((max(at, 0.0), min(end, side)))
        at = end + float(rng.choice(STREETS_M))
    return [(low, high) for low, high in plots if high - low > 12]


def _world(town: Town, centre: tuple[float, float], rotation: float, rng: np.random.Generator) -> DetailedWorld:
    crowns = town.classes == TREES  # what was planted where a house was built later is gone
    town.crown_top[~crowns] = town.crown_base[~crowns] = NO_CROWN
    albedo = albedo_map(town.material, town.tint, town.cell, rng)
    leaves = albedo_map(np.full_like(town.material, code("leaves")), town.leaf_tint, town.cell, rng)
    streets = np.isin(town.material, (code("asphalt"), code("marking"))) & (town.classes == GROUND)
    return DetailedWorld(
        centre=centre,
        rotation_deg=rotation,
        cell_size=town.cell,
        height=town.height.astype(np.float32),
        slope_x=town.slope_x.astype(np.float32),
        slope_y=town.slope_y.astype(np.float32),
        classes=town.classes,
        albedo=np.where(crowns[..., None], leaves, albedo).astype(np.float32),
        wall_albedo=town.wall,
        windows=town.windows,
        streets=streets,
        ground=town.bare(),
        crown_top=town.crown_top,
        crown_base=town.crown_base,
        foliage=np.where(crowns, LEAFY, 0.0).astype(np.float32),
        evergreen=town.evergreen,
        meadow=(town.material == code("grass")) & ~crowns,
        gloss=np.where(np.isin(town.classes, (BUILDING, WATER)), mirror_of(town.material), 0).astype(np.float32),
        building=town.building,
    )


Plot = tuple[float, float, float, float]  # left, upper, right, lower [m]


def _block(town: Town, kind: str, plot: Plot, rng: np.random.Generator, trees: bool) -> None:
    x0, y0, x1, y1 = plot
    town.paint(town.box(*plot), "pavement", float(rng.uniform(0.8, 1.2)))
    inner = (x0 + 1.8, y0 + 1.8, x1 - 1.8, y1 - 1.8)
    draw: dict[str, Callable[[Town, Plot, np.random.Generator], None]] = {
        "rows": _rows, "offices": _offices, "court": _court, "tower": _tower, "hall": _hall,
    }  # fmt: skip
    if kind in draw:
        draw[kind](town, inner, rng)
        return
    town.paint(town.box(*inner), "grass" if kind == "park" else "concrete")
    if kind == "park":
        town.paint(town.box(x0, (y0 + y1) / 2 - 1.2, x1, (y0 + y1) / 2 + 1.2), "soil")
    for _ in range((26 if kind == "park" else 7) if trees else 0):
        radius = float(rng.uniform(1.2, 5.0))
        at = float(rng.uniform(x0 + 3, x1 - 3)), float(rng.uniform(y0 + 3, y1 - 3))
        town.crown(*at, radius, radius * float(rng.uniform(1.8, 3.6)) + 2.0, rng)


def _rows(town: Town, plot: Plot, rng: np.random.Generator) -> None:
    """Two closed rows of gabled houses of different heights, back to back about yards with sheds."""
    x0, y0, x1, y1 = plot
    depth = min(float(rng.uniform(9, 12)), (y1 - y0) / 2 - 2)
    town.paint(town.box(*plot), "soil")
    for top in (y0, y1 - depth):
        x = x0
        while x < x1 - 4:
            end = min(x + float(rng.uniform(5.5, 10)), x1)
            area = town.box(x, top, end, top + depth)
            base, wall = town.stand(area, rng)
            eaves, roof = base + float(rng.uniform(6, 16)), str(rng.choice(SLOPED_ROOFS))
            if rng.random() < 0.25:
                town.flat(area, eaves, str(rng.choice(FLAT_ROOFS)), wall)
                parapet(town, area, eaves)
            else:
                town.gable(area, eaves, float(rng.uniform(2.0, 4.5)), rng.random() < 0.75, roof, wall)
                chimney = town.box(x + 1, top + depth / 2 - 0.5, x + 2, top + depth / 2 + 0.5)
                town.height[chimney] += 1.6
            town.look(area, rng)
            x = end
    for _ in range(3):
        x, y = float(rng.uniform(x0, x1 - 4)), float(rng.uniform(y0 + depth + 1, max(y1 - depth - 3, y0 + depth + 1.5)))
        area = town.box(x, y, x + 3.5, min(y + 2.5, y1 - depth))
        if town.ground[area].size:
            base, wall = town.stand(area, rng)
            town.flat(area, base + 2.6, "tar", wall)
            town.windows[area] = PLAIN


def _offices(town: Town, plot: Plot, rng: np.random.Generator) -> None:
    """Slabs of 15 to 45 m wall to wall, every one with parapet, clutter and perhaps a penthouse set back."""
    x0, y0, x1, y1 = plot
    x = x0
    while x < x1 - 6:
        end = min(x + float(rng.uniform(10, 22)), x1)
        area = town.box(x, y0, end - 0.5, y1)
        base, wall = town.stand(area, rng)
        top = base + float(rng.uniform(15, 45))
        town.flat(area, top, str(rng.choice(FLAT_ROOFS)), wall, float(rng.uniform(0.8, 1.2)))
        town.look(area, rng)
        parapet(town, area, top)
        if rng.random() < 0.5 and end - x > 9 and y1 - y0 > 14:
            area = town.box(x + 3, y0 + 4, end - 3.5, y1 - 4)
            top += 3.5
            town.flat(area, top, str(rng.choice(FLAT_ROOFS)), wall * np.float32(1.2))
        clutter(town, area, top, rng)
        x = end


def _court(town: Town, plot: Plot, rng: np.random.Generator) -> None:
    """A closed block about a narrow courtyard."""
    x0, y0, x1, y1 = plot
    area = town.box(*plot)
    base, wall = town.stand(area, rng)
    top, wing = base + float(rng.uniform(14, 26)), float(rng.uniform(8, 11))
    kept = {name: getattr(town, name)[area].copy() for name in ("slope_x", "slope_y")}
    town.flat(area, top, str(rng.choice(FLAT_ROOFS)), wall)
    town.look(area, rng)
    parapet(town, area, top)
    clutter(town, town.box(x0, y0, x1, y0 + wing), top, rng)
    if x1 - x0 < 2 * wing + 4 or y1 - y0 < 2 * wing + 4:
        return
    inner = town.box(x0 + wing, y0 + wing, x1 - wing, y1 - wing)
    local = tuple(slice(i.start - a.start, i.stop - a.start) for i, a in zip(inner, area, strict=True))
    town.height[inner], town.classes[inner] = town.ground[inner], GROUND
    town.slope_x[inner], town.slope_y[inner] = kept["slope_x"][local], kept["slope_y"][local]
    town.windows[inner], town.building[inner] = PLAIN, 0
    town.paint(inner, "concrete", 0.8)


def _tower(town: Town, plot: Plot, rng: np.random.Generator) -> None:
    """A podium and on it one tower of 50 to 150 m, square, stepped or round."""
    x0, y0, x1, y1 = plot
    area = town.box(*plot)
    base, wall = town.stand(area, rng)
    podium = base + float(rng.uniform(6, 16))
    town.flat(area, podium, str(rng.choice(FLAT_ROOFS)), wall)
    town.look(area, rng)
    parapet(town, area, podium)
    clutter(town, area, podium, rng)
    width, depth = (min(float(rng.uniform(14, 26)), extent - 5) for extent in (x1 - x0, y1 - y0))
    left, upper = float(rng.uniform(x0 + 2, x1 - width - 2)), float(rng.uniform(y0 + 2, y1 - depth - 2))
    area, top = town.box(left, upper, left + width, upper + depth), base + float(rng.uniform(*TOWERS_M))
    _, wall = town.stand(area, rng)
    roof, shape = str(rng.choice(FLAT_ROOFS)), rng.random()
    if shape < 0.25:
        town.building[area] = town.buildings - 1
        cylinder(town, area, top, roof, wall, town.buildings)
        return
    steps = 1 if shape < 0.6 else 3
    for k in range(steps):
        inset = 2.5 * k
        area = town.box(left + inset, upper + inset, left + width - inset, upper + depth - inset)
        level = top - (steps - 1 - k) * (top - podium) * 0.22
        town.flat(area, level, roof, wall)
        town.windows[area] = 0
        parapet(town, area, level)
    whole = town.box(left, upper, left + width, upper + depth)
    town.look(whole, rng)
    clutter(town, area, top, rng)


def _hall(town: Town, plot: Plot, rng: np.random.Generator) -> None:
    """A hall under a barrel vault, or a church-like hall with a dome."""
    x0, y0, x1, y1 = plot
    area = town.box(x0 + 1, y0 + 1, x1 - 1, y1 - 1)
    base, wall = town.stand(area, rng)
    eaves, roof = base + float(rng.uniform(7, 14)), str(rng.choice(("metal", "copper", "glazed", "white")))
    if rng.random() < 0.6:
        barrel(town, area, eaves, float(rng.uniform(3, 7)), roof, wall)
    else:
        town.flat(area, eaves, str(rng.choice(FLAT_ROOFS)), wall)
        parapet(town, area, eaves)
        dome(town, area, eaves, roof)
    town.windows[area] = WINDOWS


def _canal(town: Town, left: float, side: float) -> None:
    """Water between quays along a street and what stood beside it, below the ground."""
    area = town.box(left - 1, 0, left + CANAL_M, side)
    level = float(town.ground[area].min()) - QUAY_M
    town.height[area] = level
    town.slope_x[area] = town.slope_y[area] = 0.0
    town.classes[area], town.windows[area], town.building[area] = WATER, PLAIN, 0
    town.crown_top[area] = town.crown_base[area] = NO_CROWN
    town.paint(area, "water")


def _street_trees(
    town: Town, columns: list[tuple[float, float]], rows: list[tuple[float, float]], rng: np.random.Generator
) -> None:
    """A line of trees along the wider streets."""
    for (_, end), (start, _) in pairwise(rows):
        if start - end < 12:
            continue
        for low, high in columns:
            for x in np.arange(low + 3, high - 2, 8.0):
                if rng.random() < 0.7:
                    radius = float(rng.uniform(1.5, 3.2))
                    town.crown(float(x), end + 3.0, radius, radius * float(rng.uniform(2, 3)) + 2, rng)


__all__ = ["Town", "build_downtown"]

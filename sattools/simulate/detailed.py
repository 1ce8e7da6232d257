"""A world with what friendly ones leave out: porous crowns, mirrors, and a facade of its own for every building."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from sattools.simulate.materials import code
from sattools.simulate.world import BUILDING, GROUND, TREES, WATER, World

LEAFY, BARE_SHARE = (
    0.55,
    0.2,
)  # share of the clumps of a crown that are filled in summer, and what of that is left in winter
NO_CROWN = -1e9
# ways a wall may look; the tracer knows what they are
PLAIN, WINDOWS, RIBBONS, GLASS, BALCONIES = range(5)
BARK = np.array([0.13, 0.11, 0.09], np.float32)  # of crowns without leaves
STRAW = np.array([1.7, 1.15, 1.35], np.float32)  # factor on meadows in winter
MIRROR = {"metal": 0.35, "glazed": 1.2, "copper": 0.5, "membrane": 0.12, "tiles": 0.06, "slate": 0.2, "water": 2.5}
"""Strength of the mirror lobe of glossy materials, relative to a white Lambertian face at its peak."""
LOWEST_CROWN_M = 1.5  # what class 5 has lower is a shrub: a part of the ground
STEP_M = 2.0  # neighbouring roofs that differ by more are two


@dataclass(kw_only=True)
class DetailedWorld(World):
    """A `World` whose trees are clumps of leaves over its surface, and whose faces differ in more than colour.

    `height` is the opaque surface, under the trees the ground; `windows` the look of walls (`PLAIN` ... `BALCONIES`).
    `albedo` is that of leaves where there are any.

    Attributes:
        crown_top, crown_base: ``[H, W]`` heights between which clumps of leaves are [m]; `NO_CROWN` = none.
        foliage: ``[H, W]`` share of the clumps that are filled.
        evergreen: ``[H, W]`` bool, crowns that keep their leaves.
        meadow: ``[H, W]`` bool, what turns to straw in winter.
        gloss: ``[H, W]`` strength of the upper face's mirror lobe.
        building: ``[H, W]`` uint16 number of the building, each with facades of its own.
    """

    crown_top: np.ndarray
    crown_base: np.ndarray
    foliage: np.ndarray
    evergreen: np.ndarray
    meadow: np.ndarray
    gloss: np.ndarray
    building: np.ndarray

    @property
    def top(self) -> np.ndarray:
        """Heights of what is seen from above ``[H, W]`` [m]."""
        return np.maximum(self.height, self.crown_top)

    def surface(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        """Height at ground points [m]: crowns as lidar's first returns have them, without their gaps."""
        column, row = self._index(*self.cells(east, north))
        return np.maximum(super().surface(east, north), self.crown_top[row, column])

    def on_day(self, leaves: float) -> DetailedWorld:
        """The world when a share of the leaves is out: bare crowns are thin and brown, meadows pale.

        Args:
            leaves: 0 (winter) ... 1 (summer).
        """
        out = np.where(self.evergreen, 1.0, leaves).astype(np.float32)
        crowns = self.crown_top > self.crown_base
        albedo = np.where(crowns[..., None], out[..., None] * self.albedo + (1 - out[..., None]) * BARK, self.albedo)
        pale = 1 + (1 - leaves) * (STRAW - 1)
        albedo = np.where(self.meadow[..., None], albedo * pale, albedo).astype(np.float32)
        return replace(self, albedo=albedo, foliage=(self.foliage * (BARE_SHARE + (1 - BARE_SHARE) * out)))


def leaves_on(day: datetime, lat: float) -> float:
    """Share of the leaves that are out: 1 in summer, 0 in winter, of the hemisphere; always 1 within the tropics.

    Args:
        day: date.
        lat: latitude [degrees].
    """
    if abs(lat) < 23.44:
        return 1.0
    turn = 2 * math.pi * (day.timetuple().tm_yday - 202) / 365.25
    return float(np.clip(0.6 + 1.1 * math.cos(turn) * math.copysign(1, lat), 0.0, 1.0))


def mirror_of(codes: np.ndarray) -> np.ndarray:
    """Strength of the mirror lobe ``[H, W]`` of a map of material codes."""
    strength = np.zeros(256, np.float32)
    for name, value in MIRROR.items():
        strength[code(name)] = value
    return strength[codes]


def over_surface_model(world: World, rng: np.random.Generator) -> DetailedWorld:
    """The detailed twin of a world over a given surface model (see `terrain.build_terrain`); heights stay as they are.

    Crowns are what the class map calls trees, over the ground around them; every building gets facades, a part of the
    roofs is glossy or white.

    Args:
        world: with its classes.
        rng: random numbers.
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter, label, maximum_filter, minimum_filter

    height, slope_x, slope_y = world.height.copy(), world.slope_x.copy(), world.slope_y.copy()
    trees = world.classes == TREES
    crown_top, crown_base = (np.full(height.shape, NO_CROWN, np.float32) for _ in range(2))
    ground = world.classes == GROUND
    if trees.any() and ground.any():
        nearest = distance_transform_edt(~ground, return_distances=False, return_indices=True)
        floor = gaussian_filter(height[tuple(nearest)], 2.0 / world.cell_size)
        crowns = trees & (height - floor > LOWEST_CROWN_M)
        crown_top[crowns] = height[crowns]
        crown_base[crowns] = (0.65 * floor + 0.35 * height)[crowns]
        height[crowns], slope_x[crowns], slope_y[crowns] = floor[crowns], 0.0, 0.0
    houses = world.classes == BUILDING
    building, count = label(houses)
    level = houses & (maximum_filter(world.height, 3) - minimum_filter(world.height, 3) < STEP_M)
    roof, roofs = label(level)
    if roofs:
        near = distance_transform_edt(roof == 0, return_distances=False, return_indices=True)
        roof = roof[tuple(near)]
    kind = rng.random(roofs + 1)
    albedo, gloss = world.albedo.copy(), np.zeros(height.shape, np.float32)
    white = houses & (kind[roof] > 0.85)
    albedo[white] = np.clip(albedo[white] * (0.85 / albedo[white].mean()) if white.any() else 0, 0.01, 0.95)
    gloss[houses] = np.where(kind < 0.4, 2.5 * kind, 0.0).astype(np.float32)[roof[houses]]
    gloss[world.classes == WATER] = MIRROR["water"]
    style = rng.integers(PLAIN, BALCONIES + 1, count + 1).astype(np.uint8)
    tone = rng.uniform(0.12, 0.5, (count + 1, 3)) * 0.4 + 0.6 * rng.uniform(0.12, 0.5, (count + 1, 1))
    wall = np.where(houses[..., None], tone[building], world.wall_albedo).astype(np.float32)
    kept = {name: getattr(world, name) for name in ("centre", "rotation_deg", "cell_size", "classes", "streets")}
    return DetailedWorld(
        height=height, slope_x=slope_x, slope_y=slope_y, albedo=albedo, wall_albedo=wall,
        windows=np.where(houses, style[building], PLAIN).astype(np.uint8),
        crown_top=crown_top, crown_base=crown_base,
        foliage=np.where(crown_top > crown_base, LEAFY, 0.0).astype(np.float32),
        evergreen=_blotches(height.shape, world.cell_size, rng),
        meadow=(world.classes == GROUND) & (world.albedo[..., 1] > 1.2 * world.albedo[..., 2]),
        gloss=gloss, building=(building % 65535).astype(np.uint16), **kept,
    )  # fmt: skip


def _blotches(shape: tuple[int, int], cell: float, rng: np.random.Generator) -> np.ndarray:
    """Patches ``[H, W]`` bool of some 8 m that fill four tenths of the area: which trees are evergreen."""
    from scipy.ndimage import gaussian_filter

    field = gaussian_filter(rng.standard_normal(shape, dtype=np.float32), 4.0 / cell, mode="wrap")
    return np.asarray(field > np.quantile(field, 0.6))


__all__ = [
    "BALCONIES",
    "GLASS",
    "LEAFY",
    "NO_CROWN",
    "PLAIN",
    "RIBBONS",
    "WINDOWS",
    "DetailedWorld",
    "leaves_on",
    "mirror_of",
    "over_surface_model",
]

"""Surfaces and class maps of what the built-in terrains are not: suburbs, gardens with trees, woods, halls.

    python benchmarks/suburbs.py KIND SEED FOLDER
    sattools simulate --terrain downtown --dsm FOLDER/KINDSEED_DSM.tif --classes FOLDER/KINDSEED_CLS.tif --seed SEED
        --size 128 --id SKINDSEED
    sattools prep SKINDSEED/images/*.tif --metadata SKINDSEED/metadata --id PKINDSEED --bounds ... --crs ...
    python benchmarks/steps.py PKINDSEED/scene.json=SKINDSEED/truth/SKINDSEED_DSM.tif --detail

KIND is suburb (gable houses and huts, few trees), leafy (the same with 330 trees), forest (1300 trees of 12 to 24 m on
a slope, no houses) or industry (flat halls). Writes 240 m x 240 m of 0.5 m cells, of which `simulate` takes the middle.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from scipy.ndimage import gaussian_filter

GROUND, TREES, BUILDING = 2, 5, 6
CELL_M, CELLS = 0.5, 480
WEST, SOUTH, CRS = 436000.0, 3355000.0, "EPSG:32617"


@dataclass(frozen=True)
class Kind:
    """What a surface of a kind holds: relief [m] and slope of the ground, number of trees and their heights [m]."""

    relief: float
    slope: float
    trees: int
    tops: tuple[float, float] = (5.0, 18.0)


KINDS = {
    "suburb": Kind(1.5, 0.01, 90),
    "leafy": Kind(3.0, 0.03, 330),
    "forest": Kind(8.0, 0.1, 1300, (12.0, 24.0)),
    "industry": Kind(0.5, 0.0, 25),
}


@dataclass
class Surface:
    """Heights ``[H, W]`` [m] above bare ground, and classes."""

    ground: np.ndarray
    height: np.ndarray = field(init=False)
    classes: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.height = self.ground.copy()
        self.classes = np.full(self.ground.shape, GROUND, np.uint8)
        self.y, self.x = np.mgrid[:CELLS, :CELLS] * CELL_M

    def house(self, at: tuple[float, float], size: tuple[float, float], turn: float, eave: float, ridge: float) -> None:
        """A gable roof, or a flat one where its ridge is no higher than its eave; heights above the ground [m]."""
        (u, v), (width, length) = self._along(at, turn), size
        inside = (np.abs(u) < width / 2) & (np.abs(v) < length / 2)
        if inside.any():
            roof = eave + max(ridge - eave, 0.0) * (1 - np.abs(u) / (width / 2))
            self.height[inside] = np.maximum(self.height[inside], self.ground[inside].mean() + roof[inside])
            self.classes[inside] = BUILDING

    def tree(self, at: np.ndarray, radius: float, top: float, rng: np.random.Generator) -> None:
        """A round crown over the ground, rough by 6 % of its height, where there is no house."""
        off = np.hypot(self.x - at[0], self.y - at[1])
        inside = (off < radius) & (self.classes != BUILDING)
        if inside.any():
            crown = top * (0.55 + 0.45 * np.sqrt(np.clip(1 - (off / radius) ** 2, 0, 1)))
            crown = self.ground + crown * (1 + 0.06 * rng.standard_normal(off.shape))
            higher = inside & (crown > self.height)
            self.height[higher] = crown[higher]
            self.classes[inside] = TREES

    def _along(self, at: tuple[float, float], turn: float) -> tuple[np.ndarray, np.ndarray]:
        east, south = self.x - at[0], self.y - at[1]
        c, s = math.cos(turn), math.sin(turn)
        return east * c + south * s, -east * s + south * c


def surface(name: str, seed: int) -> Surface:
    """A surface of one of `KINDS`."""
    kind, rng = KINDS[name], np.random.default_rng(seed)
    bumps = gaussian_filter(rng.standard_normal((CELLS, CELLS)), 60)
    east = np.mgrid[:CELLS, :CELLS][1] * CELL_M
    made = Surface(8 + kind.relief * bumps / np.abs(bumps).max() + kind.slope * (east - 120))
    turn = rng.uniform(0, 0.5)
    if name in ("suburb", "leafy"):
        _gardens(made, turn, rng)
    if name == "industry":
        for x in (40, 110, 180):
            for y in (45, 115, 185):
                at = (x + rng.normal(0, 6), y + rng.normal(0, 6))
                size, eave = (rng.uniform(30, 48), rng.uniform(34, 52)), rng.uniform(6, 13)
                made.house(at, size, turn, eave, 0.0)
    for _ in range(kind.trees):
        at = rng.uniform(0, 240, 2)
        radius = rng.uniform(1.5, 5.5) if rng.random() < 0.7 else rng.uniform(0.8, 2)
        made.tree(at, radius, rng.uniform(*kind.tops), rng)
    return made


def _gardens(made: Surface, turn: float, rng: np.random.Generator) -> None:
    """Houses along streets, every third row of plots a street, half of them with a hut."""
    for x in np.arange(10, 230, 24):
        for y in np.arange(10, 230, 19):
            if int(x / 24) % 3 == 2 or rng.random() < 0.12:
                continue
            at = (x + rng.normal(0, 1.5), y + rng.normal(0, 1.2))
            size = (rng.uniform(8, 11), rng.uniform(11, 15))
            made.house(at, size, turn + rng.choice([0, np.pi / 2]), rng.uniform(2.8, 5.5), rng.uniform(5.5, 8.5))
            if rng.random() < 0.5:
                made.house((x + 9, y + 4), (3.5, 5.5), turn, 2.5, 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=sorted(KINDS))
    parser.add_argument("seed", type=int)
    parser.add_argument("folder", type=Path)
    asked = parser.parse_args()
    made = surface(asked.kind, asked.seed)
    asked.folder.mkdir(parents=True, exist_ok=True)
    transform = Affine(CELL_M, 0, WEST, 0, -CELL_M, SOUTH + CELLS * CELL_M)
    for name, values in (("DSM", made.height.astype(np.float32)), ("CLS", made.classes)):
        path = asked.folder / f"{asked.kind}{asked.seed}_{name}.tif"
        with rasterio.open(
            path, "w", driver="GTiff", width=CELLS, height=CELLS, count=1, dtype=values.dtype, crs=CRS,
            transform=transform,
        ) as file:  # fmt: skip
            file.write(values, 1)
    shares = {int(code): round(float((made.classes == code).mean()), 2) for code in np.unique(made.classes)}
    print(f"{asked.kind}{asked.seed}: shares of the classes {shares}")


if __name__ == "__main__":
    main()

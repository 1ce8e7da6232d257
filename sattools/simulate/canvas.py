"""Rasters that a made-up town is drawn on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sattools.simulate.materials import code
from sattools.simulate.world import BUILDING, GROUND, TREES, WATER


def cells_across(size_m: float, angle: float, margin_m: float, cell_size: float) -> int:
    """Cells along the edge of a turned square that covers a north-up one and a margin around it; an even number.

    Args:
        size_m: edge of the north-up square [m].
        angle: by which the other one is turned [rad].
        margin_m: around it [m].
        cell_size: edge of a cell [m].
    """
    side = size_m * (abs(math.cos(angle)) + abs(math.sin(angle))) + 2 * margin_m
    return 2 * math.ceil(side / cell_size / 2)


@dataclass
class Canvas:
    """Rasters being drawn on; lengths in metres along columns (x) and rows (y) from the upper left corner."""

    cell: float
    ground: np.ndarray
    height: np.ndarray = field(init=False)
    slope_x: np.ndarray = field(init=False)
    slope_y: np.ndarray = field(init=False)
    classes: np.ndarray = field(init=False)
    material: np.ndarray = field(init=False)
    tint: np.ndarray = field(init=False)
    wall: np.ndarray = field(init=False)
    windows: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        shape = self.ground.shape
        self.height = self.ground.copy()
        self.slope_y, self.slope_x = np.gradient(self.ground, self.cell)
        self.classes = np.full(shape, GROUND, np.uint8)
        self.material = np.full(shape, code("asphalt"), np.uint8)
        self.tint = np.ones(shape, np.float32)
        self.wall = np.full((*shape, 3), 0.2, np.float32)
        self.windows = np.zeros(shape, np.uint8)

    def box(self, x0: float, y0: float, x1: float, y1: float) -> tuple[slice, slice]:
        """Cells between two corners."""
        rows, columns = self.ground.shape
        r0, r1 = (min(max(round(y / self.cell), 0), rows) for y in (y0, y1))
        c0, c1 = (min(max(round(x / self.cell), 0), columns) for x in (x0, x1))
        return slice(r0, r1), slice(c0, c1)

    def bare(self) -> np.ndarray:
        """Height of the ground ``[H, W]`` [m], under trees and buildings too; water is its own ground."""
        return np.where(self.classes == WATER, self.height, self.ground).astype(np.float32)

    def paint(self, area: tuple[slice, slice], material: str, tint: float = 1.0) -> None:
        """Give an area another material."""
        self.material[area] = code(material)
        self.tint[area] = tint

    def level(self, area: tuple[slice, slice]) -> float:
        """Height of the ground a building stands on."""
        part = self.ground[area]
        return float(part.max()) if part.size else 0.0

    def flat(self, area: tuple[slice, slice], top: float, roof: str, wall: np.ndarray, tint: float = 1.0) -> None:
        """A flat roof at the absolute height `top`."""
        self.height[area] = top
        self.slope_x[area] = self.slope_y[area] = 0.0
        self.classes[area] = BUILDING
        self.wall[area] = wall
        self.windows[area] = 1
        self.paint(area, roof, tint)

    def gable(
        self, area: tuple[slice, slice], eaves: float, rise: float, along_x: bool, roof: str, wall: np.ndarray
    ) -> None:
        """A roof of two planes that climb `rise` metres from the eaves to a ridge along columns or rows."""
        self.flat(area, eaves, roof, wall)
        rows, columns = self.height[area].shape
        count = rows if along_x else columns
        if count < 2:
            return
        middle = count / 2
        across = np.arange(count) + 0.5
        slope = rise / (middle * self.cell)
        # the ridge of an odd count is one level cell, as high as the edges of its neighbours
        climb = (rise * (1 - np.maximum(np.abs(across - middle), 0.5) / middle)).astype(np.float32)
        side = np.where(across < middle, slope, -slope).astype(np.float32)
        side[across == middle] = 0
        if along_x:
            self.height[area] += climb[:, None]
            self.slope_y[area] = side[:, None]
        else:
            self.height[area] += climb[None]
            self.slope_x[area] = side[None]
        self.windows[area] = 0

    def tree(self, x: float, y: float, radius: float, top: float, rng: np.random.Generator) -> None:
        """An opaque crown: half an ellipsoid with a ragged surface over leaves that reach down to the ground."""
        area = self.box(x - radius, y - radius, x + radius, y + radius)
        rows = (np.arange(area[0].start, area[0].stop) + 0.5) * self.cell - y
        columns = (np.arange(area[1].start, area[1].stop) + 0.5) * self.cell - x
        distance = np.hypot(rows[:, None], columns[None]) / radius
        if not distance.size:
            return
        ragged = rng.normal(0.0, 0.06, distance.shape)
        inside = (distance + ragged < 1) & np.isin(self.classes[area], (GROUND, TREES))
        crown = self.ground[area] + top * (0.45 + 0.55 * np.sqrt(np.clip(1 - distance**2, 0, 1))) * (1 + 0.6 * ragged)
        inside &= crown > self.height[area]
        self.height[area][inside] = crown[inside]
        self.slope_x[area][inside] = self.slope_y[area][inside] = 0.0
        self.classes[area][inside] = TREES
        self.material[area][inside] = code("leaves")
        self.tint[area][inside] = (1 + ragged)[inside]
        self.wall[area][inside] = (0.05, 0.08, 0.035)


def ground(count: int, cell_size: float, base_m: float, rng: np.random.Generator) -> np.ndarray:
    """Ground that falls 1 % and undulates by some decimetres."""
    x = np.arange(count, dtype=np.float32) * cell_size
    waves = sum(
        0.25 * np.sin(2 * np.pi * (x[None] * a + x[:, None] * b) / 90 + phase)
        for a, b, phase in rng.uniform(-1, 1, (3, 3)) * (1, 1, np.pi)
    )
    heights: np.ndarray = base_m + 0.008 * (x[None] - x.mean()) + 0.004 * x[:, None] + waves
    return heights


__all__ = ["Canvas", "cells_across", "ground"]

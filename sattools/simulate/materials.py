"""What surfaces are made of: reflectance and texture by name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Material:
    """Lambertian reflectance of red, green and blue, and the relative strength of its grain."""

    albedo: tuple[float, float, float]
    grain: float


MATERIALS: dict[str, Material] = {
    "asphalt": Material((0.11, 0.11, 0.115), 0.22),
    "pavement": Material((0.27, 0.26, 0.24), 0.15),
    "marking": Material((0.62, 0.62, 0.60), 0.06),
    "grass": Material((0.10, 0.15, 0.065), 0.35),
    "soil": Material((0.24, 0.19, 0.14), 0.30),
    "gravel": Material((0.36, 0.35, 0.33), 0.22),
    "membrane": Material((0.55, 0.55, 0.54), 0.10),
    "tar": Material((0.15, 0.15, 0.16), 0.25),
    "tiles": Material((0.34, 0.19, 0.14), 0.22),
    "slate": Material((0.18, 0.19, 0.21), 0.20),
    "metal": Material((0.48, 0.50, 0.52), 0.10),
    "leaves": Material((0.065, 0.105, 0.045), 0.40),
    "water": Material((0.03, 0.045, 0.05), 0.08),
    "white": Material((0.86, 0.86, 0.85), 0.03),
    "glazed": Material((0.30, 0.33, 0.36), 0.04),
    "copper": Material((0.30, 0.42, 0.36), 0.10),
    "concrete": Material((0.34, 0.33, 0.31), 0.12),
}
"""Broad-band values in the range that urban spectral libraries give (Kotthaus et al. 2014, ISPRS J. 94)."""
NAMES = list(MATERIALS)

GRAIN_SIZES_M = ((0.25, 0.5), (1.0, 0.35), (4.0, 0.35))  # standard deviation of the blur in metres, share


def code(name: str) -> int:
    """Number of a material in a map of codes."""
    return NAMES.index(name)


def grain(shape: tuple[int, int], cell_size: float, rng: np.random.Generator) -> np.ndarray:
    """Multi-scale noise [H, W] of unit variance, so that matching finds texture at every resolution.

    Args:
        shape: (rows, columns) [cells].
        cell_size: edge of a cell [m].
        rng: random numbers.
    """
    from scipy.ndimage import gaussian_filter

    total = np.zeros(shape, np.float32)
    for size, share in GRAIN_SIZES_M:
        layer = gaussian_filter(rng.standard_normal(shape, dtype=np.float32), size / cell_size, mode="wrap")
        total += share * layer / layer.std()
    return np.asarray(total / total.std())


def albedo_map(codes: np.ndarray, tint: np.ndarray, cell_size: float, rng: np.random.Generator) -> np.ndarray:
    """Reflectance [H, W, 3] of a map of material codes [H, W], times `tint` [H, W], with grain; within 0.01 to 0.95.

    Args:
        codes: ``[H, W]`` materials.
        tint: ``[H, W]`` factor.
        cell_size: edge of a cell [m].
        rng: random numbers.
    """
    base = np.array([MATERIALS[name].albedo for name in NAMES], np.float32)[codes]
    strength = np.array([MATERIALS[name].grain for name in NAMES], np.float32)[codes]
    factor = tint * np.exp(strength * grain(codes.shape, cell_size, rng))
    return np.clip(base * factor[..., None], 0.01, 0.95).astype(np.float32)

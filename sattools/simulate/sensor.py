"""From radiance to the numbers a sensor delivers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SUN_COLOUR = np.array([1.0, 0.97, 0.92])
OPTICAL_DEPTH = np.array([0.08, 0.11, 0.17])
SKY_COLOUR = np.array([0.10, 0.125, 0.16])
EXPOSURE = 1.3  # full scale is reached at a radiance of 1 / 1.3


@dataclass(frozen=True)
class Radiometry:
    """What one date does to the picture: radiance at the sensor = gain * radiance + haze, per band."""

    gain: np.ndarray
    haze: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Radiometry:
        """Gains of 0.85 to 1.15 with 2 % between bands, haze of 0.01 to 0.04, more in the blue."""
        gain = rng.uniform(0.85, 1.15) * rng.normal(1.0, 0.02, 3)
        return cls(gain, rng.uniform(0.01, 0.04) * np.array([0.7, 1.0, 1.4]))


def sun_colour(elevation_deg: float) -> np.ndarray:
    """Direct irradiance [3] (red, green, blue) on a surface across the sun: Beer's law, plane atmosphere."""
    return np.asarray(SUN_COLOUR * np.exp(-OPTICAL_DEPTH / np.sin(np.radians(elevation_deg))))


def digital_numbers(
    radiance: np.ndarray, radiometry: Radiometry, noise: float, bits: int, rng: np.random.Generator
) -> np.ndarray:
    """Digital numbers of a radiance [3, H, W]: uint16 of `bits` = 11, or uint8 tone-mapped to the 99.8 % quantile.

    `noise` scales shot noise of variance 0.1 DN and read noise of 2 DN (of 2047).
    """
    full = 2**11 - 1
    at_sensor = radiometry.gain[:, None, None] * radiance + radiometry.haze[:, None, None]
    signal = full * EXPOSURE * at_sensor
    sigma = noise * np.sqrt(4.0 + 0.1 * signal)
    counts = np.clip(np.rint(signal + sigma * rng.standard_normal(signal.shape)), 0, full)
    if bits == 11:
        return np.asarray(counts.astype(np.uint16))
    toned = np.clip(counts / np.quantile(counts, 0.998), 0, 1) ** (1 / 2.2)
    return np.asarray(np.rint(255 * toned).astype(np.uint8))

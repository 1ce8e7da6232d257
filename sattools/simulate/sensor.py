"""From radiance to the numbers a sensor delivers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SUN_COLOUR = np.array([1.0, 0.97, 0.92])
OPTICAL_DEPTH = np.array([0.08, 0.11, 0.17])
SKY_COLOUR = np.array([0.10, 0.125, 0.16])
EXPOSURE = 1.3  # full scale is reached at a radiance of 1 / 1.3


@dataclass(frozen=True)
class Light:
    """What kind of days the images are taken on.

    Attributes:
        sky: diffuse light of the sky relative to the usual one: the less, the deeper the shadows.
        gain, haze: ranges from which a date draws its own.
        exposure: full scale is reached at a radiance of 1 / exposure.
        roofs: factor on the reflectance of roofs brighter than 0.4.
    """

    sky: float = 1.0
    gain: tuple[float, float] = (0.85, 1.15)
    haze: tuple[float, float] = (0.01, 0.04)
    exposure: float = EXPOSURE
    roofs: float = 1.0


USUAL = Light()
# shadows of a twentieth of the sunlit radiance, white roofs, dates that differ by a factor of up to 2.3
HDR = Light(sky=0.35, gain=(0.6, 1.4), haze=(0.005, 0.06), exposure=0.75, roofs=1.6)
# dates from clear to hazy, white roofs beyond full scale
HARD = Light(gain=(0.75, 1.3), haze=(0.01, 0.1), exposure=1.5)


@dataclass(frozen=True)
class Radiometry:
    """What one date does to the picture: radiance at the sensor = gain * radiance + haze, per band."""

    gain: np.ndarray
    haze: np.ndarray

    @classmethod
    def draw(cls, rng: np.random.Generator, light: Light = USUAL) -> Radiometry:
        """A gain with 2 % between bands and a haze that is stronger in the blue."""
        gain = rng.uniform(*light.gain) * rng.normal(1.0, 0.02, 3)
        return cls(gain, rng.uniform(*light.haze) * np.array([0.7, 1.0, 1.4]))


def sun_colour(elevation_deg: float) -> np.ndarray:
    """Direct irradiance [3] (red, green, blue) across the sun, unitless: Beer's law, plane atmosphere."""
    return np.asarray(SUN_COLOUR * np.exp(-OPTICAL_DEPTH / np.sin(np.radians(elevation_deg))))


def digital_numbers(
    radiance: np.ndarray,
    radiometry: Radiometry,
    noise: float,
    bits: int,
    rng: np.random.Generator,
    exposure: float = EXPOSURE,
) -> np.ndarray:
    """Digital numbers of a radiance [3, H, W]: uint16 of `bits` = 11, or uint8 tone-mapped to the 99.8 % quantile.

    `noise` scales shot noise of variance 0.1 DN and read noise of 2 DN (of 2047).

    Args:
        radiance: ``[3, H, W]``.
        radiometry: of the image.
        noise: factor of the sensor's noise.
        bits: 8 or 11.
        rng: random numbers.
        exposure: factor of the radiance.
    """
    full = 2**11 - 1
    at_sensor = radiometry.gain[:, None, None] * radiance + radiometry.haze[:, None, None]
    signal = full * exposure * at_sensor
    sigma = noise * np.sqrt(4.0 + 0.1 * signal)
    counts = np.clip(np.rint(signal + sigma * rng.standard_normal(signal.shape)), 0, full)
    if bits == 11:
        return np.asarray(counts.astype(np.uint16))
    toned = np.clip(counts / np.quantile(counts, 0.998), 0, 1) ** (1 / 2.2)
    return np.asarray(np.rint(255 * toned).astype(np.uint8))

"""Clouds over a simulated town: a layer that hides the ground from the camera and, elsewhere, from the sun."""

from __future__ import annotations

import numpy as np

from sattools.simulate.camera import Pushbroom

CLOUD_BASE_M = 900.0  # of the layer above the ground: fair-weather cumulus
WHITE = 0.75  # reflectance
_LENGTHS_M = (40.0, 400.0)  # shortest and longest waves of the layer's edge
_CELL_M = 8.0
_CELLS = 256  # along the edge of the layer, which repeats itself
_EDGE = 0.5  # standard deviations of the field within which a cloud becomes opaque


class CloudLayer:
    """The opacity of a day's clouds, and what they do to a picture."""

    def __init__(self, share: float, height: float, rng: np.random.Generator) -> None:
        """Draw a layer.

        Args:
            share: of the sky that is covered.
            height: of the layer above the ellipsoid [m].
            rng: random numbers.
        """
        frequency = np.hypot(np.fft.fftfreq(_CELLS, _CELL_M)[:, None], np.fft.rfftfreq(_CELLS, _CELL_M))
        shortest, longest = _LENGTHS_M
        power = (frequency + 1.0 / longest) ** -2.0 * np.exp(-((frequency * shortest) ** 2))
        waves = rng.standard_normal(frequency.shape) + 1j * rng.standard_normal(frequency.shape)
        field = np.fft.irfft2(waves * power, (_CELLS, _CELLS))
        field /= field.std()
        threshold = np.quantile(field, 1.0 - share)
        self.opacity = np.clip((field - threshold) / _EDGE, 0.0, 1.0)
        self.height = height

    def along(self, places: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Opacity ``[...]`` on lines that run from places on the ground upwards.

        Args:
            places: ``[..., 3]`` (easting, northing, height) [m].
            direction: ``[..., 3]`` to the sun or the sensor.
        """
        from scipy.ndimage import map_coordinates

        times = (self.height - places[..., 2]) / direction[..., 2]
        row, col = ((places[..., k] + times * direction[..., k]) / _CELL_M for k in (1, 0))
        return np.asarray(map_coordinates(self.opacity, [row, col], order=1, mode="grid-wrap"))

    def over(
        self, radiance: np.ndarray, height: np.ndarray, camera: Pushbroom, sun: np.ndarray, light: np.ndarray
    ) -> np.ndarray:
        """A picture ``[3, H, W]`` of the ground with these clouds over it.

        Args:
            radiance: ``[3, H, W]`` without clouds.
            height: ``[H, W]`` that every pixel sees [m].
            camera: which takes it.
            sun: ``[3]`` unit vector to the sun.
            light: ``[2, 3]`` irradiance of the sun across its beam and of the sky.
        """
        rows, cols = np.asarray(np.indices(height.shape), np.float64)
        places, lines = camera.seen(cols, rows, height.astype(np.float64))
        of_sun = light[0] * sun[2] / (light[0] * sun[2] + light[1])
        shade = 1.0 - of_sun[:, None, None] * self.along(places, np.broadcast_to(sun, places.shape))
        white = WHITE * (light[0] * sun[2] + light[1])[:, None, None]
        opacity = self.along(places, -lines)
        return np.asarray(radiance * shade * (1.0 - opacity) + white * opacity, radiance.dtype)


__all__ = ["CLOUD_BASE_M", "CloudLayer"]

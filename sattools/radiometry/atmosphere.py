"""Light of the air: what it adds to the darkest ground, and what it lets through, of reflectances.

Above a plane atmosphere rho = rho_path + T(sun) T(view) rho_surface, where light that goes back and forth between both
is left out. The path's reflectance is that of the darkest ground less what such ground has itself (dark-object
subtraction, Chavez 1988; 1 % of reflectance, Chavez 1996). If it is one of molecules, it tells their optical depth by
single scattering, and that the transmittance by a two-stream form (Vermote et al. 1997, 6S). "DOS4" (Moran et al. 1992,
Song et al. 2001) does the same with even scattering and the direct beam alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sattools.camera.ground import direction
from sattools.errors import SceneError
from sattools.radiometry.options import NormaliseOptions
from sattools.scene import Item, Scene
from sattools.scene.jsonio import JsonObject

UP = np.array([0.0, 0.0, 1.0])
DARKEST = 0.1  # [%] of the pixels, which are in deep shade or wet: fewer are noise
ROUNDS = 4  # dark ground is seen through the air as well; each round leaves less than a tenth of the error
ENOUGH = 1000  # pixels of which one is the darkest
BRIGHT = 0.03  # shade and water reach it under air that counts
HAZY = f"the darkest thousandth has a reflectance above {BRIGHT:g}: of the air? (--atmosphere dark-object takes it off)"
MOST = 0.9  # of the reflectance of an endless path of molecules, where an optical depth is no longer told


@dataclass(frozen=True)
class Air:
    """What air does to the reflectances of an image.

    Attributes:
        path: ``[C]`` what it adds, in the image's own quantity.
        transmittance: ``[C]`` of both ways; 1 = nothing is taken away.
    """

    path: np.ndarray
    transmittance: np.ndarray

    def through(self, values: np.ndarray) -> np.ndarray:
        """Reflectances ``[C, ...]`` of the ground, float32, of those above the air."""
        path, transmittance = (part.reshape(-1, *[1] * (values.ndim - 1)) for part in (self.path, self.transmittance))
        return ((values - path) / transmittance).astype(np.float32)

    def to_dict(self) -> JsonObject:
        """JSON form: what is added in the quantity of the image, and what is let through, band by band."""
        return {"path": self.path.round(6).tolist(), "transmittance": self.transmittance.round(6).tolist()}


def hazy(values: np.ndarray) -> bool:
    """Whether a band of reflectances ``[C, N]`` (NaN = unknown) has nothing dark, where they are enough to tell."""
    return bool((np.isfinite(values).sum(axis=1) >= ENOUGH).all() and (darkest(values) > BRIGHT).any())


def check_air(scene: Scene, items: Sequence[Item], quantity: str, options: NormaliseOptions) -> None:
    """Raise SceneError where the air cannot be taken off: values that are no reflectances, suns that are not known.

    Args:
        scene: for its name in messages.
        items: the images.
        quantity: what they become.
        options: of the stage, with an atmosphere.
    """
    if quantity == "relative":
        raise SceneError(
            f"scene {scene.id}: --atmosphere {options.atmosphere}: found relative radiance, expected reflectances "
            "(metadata that give them, or --quantity and --scale)"
        )
    if options.atmosphere == "rayleigh" or quantity == "reflectance_factor":
        dark = next((item.id for item in items if item.sun is None or item.sun[1] <= 0), None)
        if dark is not None:
            raise SceneError(
                f"scene {scene.id}: --atmosphere {options.atmosphere}: of {dark} the sun is unknown or below the "
                "horizon, expected it above"
            )


def air_of(item: Item, values: np.ndarray, quantity: str, options: NormaliseOptions) -> Air | None:
    """The air over an image, None where it has no value.

    Args:
        item: the image; without angles of its view it is seen from above.
        values: ``[C, N]`` some of its reflectances, NaN = unknown.
        quantity: ``toa_reflectance`` or ``reflectance_factor``.
        options: of the stage, with an atmosphere.
    """
    if not np.isfinite(values).any(axis=1).all():
        return None
    sun = direction(*item.sun) if item.sun else UP
    unit = 1.0 if quantity == "toa_reflectance" else float(sun[2])
    dark, own = darkest(values), options.dark_reflectance * unit
    path, through = np.maximum(dark - own, 0.0), np.ones_like(dark)
    if options.atmosphere == "dark-object":
        return Air(path, through)
    azimuth, incidence = (item.properties.get(f"view:{name}") for name in ("azimuth", "incidence_angle"))
    view = UP if azimuth is None or incidence is None else direction(azimuth, 90.0 - incidence)
    for _ in range(ROUNDS):
        through = rayleigh_transmittance(path / unit, sun, view)
        path = np.maximum(dark - through * own, 0.0)
    return Air(path, through)


def darkest(values: np.ndarray) -> np.ndarray:
    """The darkest ``[C]`` that counts of values ``[C, N]`` (NaN = unknown)."""
    return np.asarray(np.nanpercentile(values, DARKEST, axis=1), np.float64)


def rayleigh_transmittance(path: np.ndarray, sun: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Transmittance ``[C]`` of both ways through molecules that give the path its reflectance.

    Single scattering: rho = P (1 - exp(-tau m)) / (4 (mu_s + mu_v)) with m = 1 / mu_s + 1 / mu_v and Rayleigh's phase
    function P = 3/4 (1 + cos^2); T(mu) = ((2/3 + mu) + (2/3 - mu) exp(-tau / mu)) / (4/3 + tau).

    Args:
        path: ``[C]`` pi L / (E cos sun zenith) of the path.
        sun: ``[3]`` unit vector (east, north, up) to the sun, above the horizon.
        view: ``[3]`` the same to the sensor.
    """
    to_sun, to_view = float(sun[2]), float(view[2])
    phase = 0.75 * (1 + float(sun @ view) ** 2)
    share = np.minimum(4 * (to_sun + to_view) * path / phase, MOST)
    depth = -np.log1p(-share) / (1 / to_sun + 1 / to_view)
    through = np.ones_like(depth)
    for mu in (to_sun, to_view):
        through = through * ((2 / 3 + mu) + (2 / 3 - mu) * np.exp(-depth / mu)) / (4 / 3 + depth)
    return np.minimum(through, 1.0)  # rounding


__all__ = ["DARKEST", "HAZY", "Air", "air_of", "check_air", "darkest", "hazy", "rayleigh_transmittance"]

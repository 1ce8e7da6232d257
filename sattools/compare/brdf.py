"""Reflectance of single places in all directions: what a fit says of it beside the truth."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from sattools.errors import InputError
from sattools.scene.jsonio import JsonObject

Model = Literal["lambert", "rpv", "hapke"]
AMPLITUDE: dict[Model, str] = {"hapke": "w", "rpv": "rho0", "lambert": "albedo"}
SHAPE: dict[Model, tuple[str, ...]] = {"hapke": ("b", "c", "theta"), "rpv": ("k", "asymmetry", "rhoc"), "lambert": ()}
PLAIN = "lambert_share"  # map of the ground that a fit by material gives to Lambert's law
LIMIT_DEG = 60.0  # of the view from the vertical: beyond, no satellite looks
STEPS = (7, 37)  # view zenith and azimuth, of a plot and of its error: every 10 degrees
REACH = 0.05  # cosine's width about the images' own directions: some 18 degrees


@dataclass(frozen=True)
class Place:
    """Reflectance parameters of one place in one band.

    Attributes:
        model: of the parameters.
        amplitude: w, rho0 or albedo.
        shape: b, c, theta [degrees], or k, asymmetry, rhoc; none of Lambert's.
    """

    model: Model
    amplitude: float
    shape: tuple[float, ...] = ()

    def brf(self, sun: np.ndarray, views: np.ndarray) -> np.ndarray:
        """BRF ``[...]`` of level ground.

        Args:
            sun: ``[3]`` unit vector (east, north, up) to the sun.
            views: ``[..., 3]`` unit vectors to the sensors.
        """
        import torch

        from sattools.reflectance import hapke, lambert, rpv

        models: dict[str, Callable[..., Any]] = {"hapke": hapke, "rpv": rpv, "lambert": lambert}
        up, towards = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), torch.from_numpy(views)
        values = [towards.new_tensor(v) for v in (self.amplitude, *self.shape)]
        found = models[self.model](up.expand(towards.shape), torch.from_numpy(sun), towards, *values)
        return np.asarray(found.expand(towards.shape[:-1]).numpy())

    def to_json(self) -> JsonObject:
        """As `place_of` reads it."""
        return {**asdict(self), "shape": list(self.shape)}


def place_of(found: Mapping[str, Any], where: str) -> Place:
    """Inverse of `Place.to_json`. Raises InputError for anything else, naming `where`."""
    try:
        place = Place(found["model"], float(found["amplitude"]), tuple(float(v) for v in found["shape"]))
        if len(place.shape) == len(SHAPE[place.model]) and np.isfinite([place.amplitude, *place.shape]).all():
            return place
    except (KeyError, TypeError, ValueError):
        pass
    raise InputError(f"{where}: found {dict(found)!r}, expected model, amplitude and shape of a reflectance")


def place_in(values: Mapping[str, np.ndarray], band: int) -> Place | None:
    """The place whose maps hold these values ``[B]``; None where they make no model or are not known.

    Args:
        values: by name of the map: w, b, c, theta; rho0, k, asymmetry, rhoc; albedo; `PLAIN`.
        band: which one of the amplitude.
    """
    plain = PLAIN in values and float(values[PLAIN][0]) > 0.5
    for model, amplitude in AMPLITUDE.items():
        names = (amplitude, *SHAPE[model])
        if all(name in values for name in names):
            of_band = values[amplitude][min(band, len(values[amplitude]) - 1)]
            if plain:
                share = from_all_sides(model, float(of_band))
                return Place("lambert", share) if math.isfinite(share) else None
            numbers = [float(of_band), *(float(values[name][0]) for name in SHAPE[model])]
            return Place(model, numbers[0], tuple(numbers[1:])) if np.isfinite(numbers).all() else None
    return None


def from_all_sides(model: Model, amplitude: float) -> float:
    """Reflectance for light from all sides: Hapke's diffusive reflectance r0 of w, else the amplitude itself."""
    if model != "hapke":
        return amplitude
    root = math.sqrt(max(1.0 - amplitude, 0.0))
    return (1.0 - root) / (1.0 + root)


def unit_vector(azimuth_deg: float, zenith_deg: float) -> np.ndarray:
    """Unit vector ``[3]`` (east, north, up); angles from north, clockwise, and from the vertical [degrees]."""
    azimuth, zenith = math.radians(azimuth_deg), math.radians(zenith_deg)
    flat = math.sin(zenith)
    return np.array([flat * math.sin(azimuth), flat * math.cos(azimuth), math.cos(zenith)])


def directions() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Zeniths ``[Z]`` and azimuths ``[A]`` in degrees, and the unit vectors ``[Z, A, 3]`` of all their pairs."""
    zenith, azimuth = np.linspace(0.0, LIMIT_DEG, STEPS[0]), np.linspace(0.0, 360.0, STEPS[1])
    return zenith, azimuth, np.array([[unit_vector(a, z) for a in azimuth] for z in zenith])


def errors(place: Place, truth: Place, sun: np.ndarray, views: Sequence[np.ndarray]) -> dict[str, float | None]:
    """NRMSE of a BRF, the RMSE over the truth's mean: over all views up to 60 degrees, and near the images' own.

    Directions count by their solid angle; "near" weighs them by their distance from the nearest image's.

    Args:
        place: what was found.
        truth: what it should be.
        sun: ``[3]`` unit vector to the sun.
        views: ``[3]`` unit vectors to the sensors of the images.
    """
    zenith, _, towards = directions()
    towards = towards[:, :-1]  # the last azimuth is the first again
    solid = np.repeat(np.sin(np.radians(zenith))[:, None], towards.shape[1], axis=1)
    found, true = place.brf(sun, towards), truth.brf(sun, towards)

    def nrmse(weight: np.ndarray) -> float | None:
        mean = float((weight * true).sum() / weight.sum()) if weight.sum() > 0 else 0.0
        return float(np.sqrt((weight * (found - true) ** 2).sum() / weight.sum())) / mean if mean > 0 else None

    near = np.max([towards @ view for view in views], axis=0) if views else None
    return {
        "nrmse": nrmse(solid),
        "nrmse_near_views": None if near is None else nrmse(solid * np.exp((near - 1) / REACH)),
    }


def brdf_figure(
    places: Mapping[str, Place],
    sun: tuple[float, float],
    views: Sequence[tuple[float, float]],
    title: str,
) -> Any:
    """Matplotlib figure: a polar plot of the BRF of every place, one scale for all, and below the principal plane.

    Args:
        places: by the name of the fit; the truth among them.
        sun: (azimuth from north, zenith) [degrees].
        views: the same of the images that were fitted.
        title: of the figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    zenith, azimuth, towards = directions()
    sun_at = unit_vector(*sun)
    shown = {name: place.brf(sun_at, towards) for name, place in places.items()}
    high = max(float(brf.max()) for brf in shown.values())
    figure = Figure(figsize=(max(5.0, 2.3 * len(places)), 5.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, len(places), height_ratios=(1.0, 1.2))
    for k, (name, brf) in enumerate(shown.items()):
        axes: Any = figure.add_subplot(grid[0, k], projection="polar")
        axes.set_theta_zero_location("N")
        axes.set_theta_direction(-1)
        drawn = axes.contourf(np.radians(azimuth), zenith, brf, levels=np.linspace(0.0, max(high, 1e-6), 21))
        axes.plot(*(np.radians(sun[0]), min(sun[1], LIMIT_DEG)), "*", color="tab:orange", markersize=9)
        if views:
            at = np.asarray(views, float)
            axes.plot(np.radians(at[:, 0]), at[:, 1], ".", color="white", markersize=4)
        axes.set_rticks([20, 40, 60])
        axes.tick_params(labelsize=6)
        axes.set_title(name.replace("$", r"\$"), fontsize=9)
    bar: dict[str, Any] = {"label": "BRF, sun (star), images (dots)", "ticks": MaxNLocator(6)}  # not at odd levels
    figure.colorbar(drawn, ax=figure.axes, shrink=0.9, location="right", **bar)
    axes = figure.add_subplot(grid[1, :])
    plane = np.linspace(-LIMIT_DEG, LIMIT_DEG, 61)
    along = np.array([unit_vector(sun[0], z) for z in plane])  # positive: the sensor on the sun's side
    dashes = itertools.cycle(("-", "--", "-.", ":"))  # fits that agree hide each other's lines otherwise
    for name, place in places.items():
        truth = name == "truth"
        style: dict[str, Any] = {"color": "black", "linewidth": 2} if truth else {"linestyle": next(dashes)}
        axes.plot(plane, place.brf(sun_at, along), label=name.replace("$", r"\$"), **style)
    axes.set(xlabel="view from the vertical in the sun's plane, positive on its side [degrees]", ylabel="BRF [1]")
    axes.set_ylim(0, None)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    figure.suptitle(title.replace("$", r"\$"), fontsize=10)
    return figure


__all__ = [
    "AMPLITUDE",
    "PLAIN",
    "SHAPE",
    "Place",
    "brdf_figure",
    "directions",
    "errors",
    "place_in",
    "place_of",
    "unit_vector",
]

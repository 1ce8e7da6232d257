"""Natural ground: fractal or given relief, with geological units of known reflectance parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sattools.camera.ground import from_geographic, utm_crs
from sattools.scene.grid import Grid
from sattools.simulate.brdf import HAPKE, LAMBERT, RPV, level_brf
from sattools.simulate.materials import grain
from sattools.simulate.terrain import read_surface, tell_unknown
from sattools.simulate.world import GROUND, World

MARGIN_M = 60.0  # surroundings that cast shadows into the scene
BASE_M = 300.0
SMOOTHEST_M = 24.0  # relief has no wavelengths below: roughness smaller than the normals can show is theta-bar's
LIMITS_W = (0.01, 0.85)

MODELS = {"lambert": LAMBERT, "rpv": RPV, "hapke": HAPKE}
PARAMETERS = {"lambert": (), "rpv": ("k", "asymmetry", "rhoc"), "hapke": ("b", "c", "theta")}
AMOUNT = {"lambert": "reflectance", "rpv": "rho0", "hapke": "w"}


@dataclass(frozen=True)
class Unit:
    """A geological unit: Hapke's w of red, green, blue; b, c, theta-bar [degrees]; RPV's k, asymmetry, rhoc; grain."""

    w: tuple[float, float, float]
    hapke: tuple[float, float, float]
    rpv: tuple[float, float, float]
    grain: float


UNITS: dict[str, Unit] = {
    "fresh basalt": Unit((0.16, 0.155, 0.15), (0.26, 0.36, 27.0), (0.70, -0.12, 0.55), 0.12),
    "weathered lava": Unit((0.32, 0.25, 0.20), (0.22, 0.50, 22.0), (0.78, -0.18, 0.70), 0.12),
    "alluvium": Unit((0.50, 0.42, 0.33), (0.18, 0.45, 14.0), (0.86, -0.08, 0.85), 0.08),
    "clay": Unit((0.68, 0.62, 0.53), (0.15, 0.40, 8.0), (0.93, -0.04, 0.95), 0.05),
    "scoria": Unit((0.40, 0.22, 0.16), (0.30, 0.42, 33.0), (0.65, -0.16, 0.60), 0.15),
    "salt": Unit((0.80, 0.80, 0.79), (0.32, 0.30, 6.0), (0.95, 0.05, 1.00), 0.03),
}
"""Made up, within the ranges usual for basalts, soils and evaporites: dark and rough to bright and smooth."""


@dataclass(kw_only=True)
class NaturalWorld(World):
    """A `World` whose `albedo` holds the model's amount (w, rho0 or albedo) and that knows the rest of its reflectance.

    Attributes:
        model: `brdf.LAMBERT`, `RPV` or `HAPKE`.
        parameters: ``[H, W, 3]`` b, c, theta-bar [degrees], or k, asymmetry, rhoc; NaN where ground is Lambert's.
        units: ``[H, W]`` uint8 number of the unit.
    """

    model: int
    parameters: np.ndarray
    units: np.ndarray

    @property
    def level_reflectance(self) -> np.ndarray:
        """BRF ``[H, W, 3]`` of level ground seen from above under a sun 15 degrees from the vertical.

        That is what a fitted reflectance model's ``albedo`` and ``reflectance`` show; w and rho0 are none.
        """
        if self.model == LAMBERT:
            return self.albedo
        return level_brf(self.model, self.albedo, self.parameters).astype(self.albedo.dtype)


def build_natural(
    size_m: float,
    gsd: float,
    units: int,
    slope_deg: float,
    *,
    reflectance: Literal["lambert", "rpv", "hapke"],
    plain: int = 0,
    lonlat: tuple[float, float],
    dsm: str | None,
    rng: np.random.Generator,
) -> tuple[Grid, NaturalWorld]:
    """The scene's grid (cells of `gsd` metres) and the ground under it and 60 m around.

    Args:
        size_m: edge of the square scene.
        gsd: pixel [m]; the world's own cells are half as large.
        units: number of geological units.
        slope_deg: mean slope of the fractal relief.
        reflectance: model of the units.
        plain: number of units that reflect as Lambert's law has it, whatever the model.
        lonlat: where the scene lies, for fractal relief.
        dsm: relief to take instead (any projected raster).
        rng: random numbers.
    """
    cell = gsd / 2
    if dsm is None:
        crs = utm_crs(*lonlat)
        x, y = (float(v) for v in from_geographic(crs, *lonlat))
        cells = max(8, round(size_m / gsd))
        half = cells * gsd / 2
        grid = Grid(crs, float(round(x - half)), float(round(y + half)), gsd, cells, cells)
        count = 2 * (cells + 2 * round(MARGIN_M / gsd))
        height = fractal(count, cell, slope_deg, rng) + BASE_M
    else:
        grid, height = _relief_of(dsm, size_m, gsd, cell)
        count = height.shape[0]
    slope_y, slope_x = (np.asarray(g) for g in np.gradient(height, cell))
    codes, amplitude, parameters = paint(count, cell, units, reflectance, rng)
    if plain and reflectance != "lambert":  # all of that is plain, and has no parameters to leave out
        parameters[np.isin(codes, rng.permutation(np.unique(codes))[:plain])] = np.nan
    world = NaturalWorld(
        grid.middle,
        0.0,
        cell,
        height.astype(np.float32),
        slope_x.astype(np.float32),
        slope_y.astype(np.float32),
        np.full(height.shape, GROUND, np.uint8),
        amplitude,
        np.zeros((1, 1, 3), np.float32),
        np.zeros((1, 1), np.uint8),
        model=MODELS[reflectance],
        parameters=parameters,
        units=codes,
    )
    return grid, world


def _relief_of(dsm: str, size_m: float, gsd: float, cell: float) -> tuple[Grid, np.ndarray]:
    """The middle of a DSM on cells of `cell` metres, cubic between its own."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

    surface = read_surface(dsm, size_m, MARGIN_M)
    tell_unknown(dsm, surface)
    own, wide, whole = surface.grid, surface.wide, surface.whole
    part = surface.heights.astype(np.float64)
    if not np.isfinite(part).all():
        nearest = distance_transform_edt(~np.isfinite(part), return_distances=False, return_indices=True)
        part = part[tuple(nearest)]
    # finer relief than a pixel shows is not seen as slopes
    part = gaussian_filter(part, max(gsd / whole.cell_size, 1e-3), mode="nearest")
    cells = int(own.width * own.cell_size / gsd)
    grid = Grid(own.crs, own.left, own.top, gsd, cells, cells)
    count = 2 * (cells + 2 * int(MARGIN_M / gsd))
    edge = (grid.left - wide.left - int(MARGIN_M / gsd) * gsd) / whole.cell_size
    at = (np.arange(count) + 0.5) * cell / whole.cell_size - 0.5 + edge
    height = map_coordinates(part, np.meshgrid(at, at, indexing="ij"), order=3, mode="nearest")
    return grid, np.asarray(height)


def fractal(count: int, cell: float, slope_deg: float, rng: np.random.Generator) -> np.ndarray:
    """Relief ``[count, count]`` in metres about 0: amplitude ~ wavelength^1.9, none below `SMOOTHEST_M`.

    Its mean slope is `slope_deg`.

    Args:
        count: cells along an edge.
        cell: edge of a cell [m].
        slope_deg: mean slope [degrees].
        rng: random numbers.
    """
    fy, fx = np.fft.fftfreq(count, cell)[:, None], np.fft.rfftfreq(count, cell)[None]
    f = np.hypot(fx, fy)
    f[0, 0] = 1.0
    amplitude = np.where(f < 1 / SMOOTHEST_M, np.maximum(f, 1 / 250.0) ** -1.9, 0.0) * np.exp(-((f * SMOOTHEST_M) ** 2))
    amplitude[0, 0] = 0.0
    noise = rng.standard_normal((count, count))
    height = np.fft.irfft2(np.fft.rfft2(noise) * amplitude, (count, count))
    if slope_deg == 0:
        return np.zeros_like(height)
    gy, gx = np.gradient(height, cell)
    steepness = np.hypot(gx, gy)
    scale = np.tan(np.radians(slope_deg)) / steepness.mean()
    for _ in range(8):
        scale *= slope_deg / np.degrees(np.arctan(scale * steepness)).mean()
    return np.asarray(height * scale)


def paint(
    count: int, cell: float, units: int, reflectance: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit codes ``[H, W]``, amount ``[H, W, 3]`` and parameters ``[H, W, 3]`` of patches about 100 m wide.

    Every unit's values are drawn within 12 % of the library's, so that two seeds are two places.

    Args:
        count: cells along an edge.
        cell: edge of a cell [m].
        units: number of geological units.
        reflectance: model of all units.
        rng: random numbers.
    """
    from scipy.ndimage import gaussian_filter

    names = list(UNITS)
    chosen = sorted(rng.permutation(len(names))[: min(units, len(names))])
    fields = np.stack(
        [
            gaussian_filter(rng.standard_normal((count, count), dtype=np.float32), 32.0 / cell, mode="wrap")
            for _ in chosen
        ]
    )
    fields /= fields.std(axis=(1, 2), keepdims=True)
    codes = np.array(chosen, np.uint8)[fields.argmax(axis=0)]
    texture = grain((count, count), cell, rng)
    amplitude = np.zeros((count, count, 3), np.float32)
    parameters = np.zeros((count, count, 3), np.float32)
    for number in chosen:
        unit, here = UNITS[names[number]], codes == number
        w = np.array(unit.w) * rng.uniform(0.88, 1.12) * rng.uniform(0.97, 1.03, 3)
        shape = np.array(unit.rpv if reflectance == "rpv" else unit.hapke) * rng.uniform(0.88, 1.12, 3)
        if reflectance == "rpv":
            shape[2] = min(shape[2], 1.0)
        amplitude[here] = w * np.exp(unit.grain * texture[here])[:, None]
        parameters[here] = shape
    amplitude = np.clip(amplitude, *LIMITS_W)
    if reflectance != "hapke":
        amplitude *= 0.5  # a reflectance, where w is a probability
    return codes, amplitude.astype(np.float32), parameters


__all__ = ["AMOUNT", "MARGIN_M", "MODELS", "PARAMETERS", "UNITS", "NaturalWorld", "build_natural", "fractal", "paint"]

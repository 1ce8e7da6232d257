"""Passes over natural ground: fans of views along the track, each under one sun."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from sattools.camera.ground import grid_direction, middle_lon_lat
from sattools.camera.sun import sun_position
from sattools.errors import InputError
from sattools.progress import Progress
from sattools.scene.document import Item, Scene
from sattools.scene.grid import Grid
from sattools.scene.raster import write_cog
from sattools.simulate.camera import Pushbroom, fit_rpc
from sattools.simulate.files import write_truth
from sattools.simulate.natural import AMOUNT, PARAMETERS, NaturalWorld, build_natural
from sattools.simulate.natural_sky import BANDS, STRIDE, open_sky, sky_directions, sky_light
from sattools.simulate.natural_trace import render_natural
from sattools.simulate.options import SimulateOptions
from sattools.simulate.sensor import Radiometry
from sattools.simulate.views import Rendered, SimulatedView, framed, take_all, write_view

HEADING_DEG = 190.0  # of a descending orbit over the tropics
ROLL_DEG = 2.0  # across the track
START = datetime(2020, 1, 21, 7, 30, tzinfo=UTC)  # where the sun asked for never stands over the place
SECONDS_BETWEEN = 9.0
LOWEST_SUN_DEG = 10.0  # of a pass that takes place
READ_NOISE_DN = 2.0
SHOT_NOISE_DN = 0.02  # variance per digital number: signal to noise about 120 at a reflectance of 0.1
SAMPLES = 4  # rays along each edge of a pixel: ground has texture down to half a pixel, which fewer would alias
# optics and detector spread light beyond the pixel: with the pixel itself a modulation transfer of 0.21 at the Nyquist
# frequency, where a bare pixel has 0.64; so sharp, views of one texture disagree by aliasing alone
SPREAD_PX = 0.6


def simulate_natural(scene: Scene, options: SimulateOptions, progress: Progress) -> Scene:
    """Fill a scene: see `sattools.simulate.simulate`; every item says what its numbers are in `sattools:radiance`.

    Digital number 4095 is a reflectance factor pi L / E of 1, E the sun's irradiance across its beam. The most nadir
    `options.train` views are for training, the others are held out.

    Args:
        scene: without items.
        options: of the simulation.
        progress: told the share done and what is being done.
    """
    seeds = np.random.SeedSequence(options.seed).spawn(3)
    progress(0.0, "building")
    grid, world = build_natural(
        options.size,
        options.gsd,
        options.units,
        options.slope,
        reflectance=options.reflectance,
        plain=options.plain_units,
        lonlat=(options.lon, options.lat),
        dsm=options.dsm,
        rng=np.random.default_rng(seeds[0]),
    )
    low, high = float(world.height.min()), float(world.height.max())
    scene.grid = grid
    scene.height_range_m = (float(np.floor(low - 5)), float(np.ceil(high + 5)))
    write_truth(scene, world, grid)
    _write_parameters(scene, world, grid, options.reflectance)
    progress(0.05, "compiling the ray tracer")
    views = _plan_fan(options, grid, (low, high), np.random.default_rng(seeds[1]))
    sky = Sky.over(world, options.sky) if options.sky else None
    take_all(scene, views, seeds[2], lambda _, view, seed: _take(scene, options, world, sky, view, seed), progress)
    return scene


def _plan_fan(
    options: SimulateOptions, grid: Grid, heights: tuple[float, float], rng: np.random.Generator
) -> list[SimulatedView]:
    """Views from -`off_nadir` to +`off_nadir` degrees along the track, equally spaced; all see the same middle.

    With several passes they take turns: the k-th view is of the pass k modulo their number.

    Args:
        options: of the simulation.
        grid: ground grid.
        heights: lowest and highest height [m].
        rng: random numbers.
    """
    west, south, east, north = grid.bounds
    (x, y), z = grid.middle, (heights[0] + heights[1]) / 2
    lon, lat = middle_lon_lat(grid)
    corners = np.array([(e, n, h) for e in (west, east) for n in (south, north) for h in heights])
    pitches = np.linspace(options.off_nadir, -options.off_nadir, options.views) if options.views > 1 else np.zeros(1)
    heading = np.radians(HEADING_DEG)
    ahead, across = (np.array([f(heading + turn) for f in (np.sin, np.cos)]) for turn in (0.0, np.pi / 2))
    order = np.argsort(np.abs(pitches), kind="stable")
    train = set(order[: options.train].tolist())
    passes = pass_suns(options, lon, lat)
    views = []
    for k, pitch in enumerate(np.radians(pitches)):
        # a sensor that looks ahead stands behind
        flat = -np.tan(pitch) * ahead + np.tan(np.radians(ROLL_DEG)) * across
        sensor = (
            float(np.degrees(np.arctan2(flat[0], flat[1])) % 360),
            float(np.degrees(np.arctan2(1.0, np.hypot(*flat)))),
        )
        view = grid_direction(*sensor, grid.crs, lon, lat)
        yaw = HEADING_DEG - 180.0
        camera = Pushbroom.towards(np.array([x, y, z]), view, options.gsd, (1, 1), yaw)
        camera, shape = framed(camera, corners)
        rpc, error = fit_rpc(camera, grid.crs, (x, y, z))
        angle, radius = rng.uniform(0, 2 * np.pi), options.bias_px * np.sqrt(rng.uniform())
        start, sun = passes[k % len(passes)]
        views.append(
            SimulatedView(
                f"{options.id}_{k + 1:03d}", start + timedelta(seconds=SECONDS_BETWEEN * k),
                sun, sensor, camera, rpc, error, shape,
                Radiometry(np.ones(3), np.zeros(3)),
                (float(radius * np.cos(angle)), float(radius * np.sin(angle))), "train" if k in train else "test", 12,
            )
        )  # fmt: skip
    return views


def pass_suns(options: SimulateOptions, lon: float, lat: float) -> list[tuple[datetime, tuple[float, float]]]:
    """Start and sun (azimuth from north, elevation; degrees) of every pass: one time of day, days spread over a year.

    Args:
        options: of the simulation.
        lon: longitude [degrees].
        lat: latitude [degrees].

    Raises:
        InputError: the sun is down at that time on one of the days.
    """
    first = _moment(lon, lat, options.sun_azimuth, options.sun_elevation)
    found = [(first, (options.sun_azimuth, options.sun_elevation))]
    for k in range(1, options.passes):
        day = first + timedelta(days=round(k * 365.25 / options.passes))
        sun = sun_position(day, lon, lat)
        if sun[1] < LOWEST_SUN_DEG:
            raise InputError(
                f"--passes: found a sun {sun[1]:.1f} degrees high on {day:%Y-%m-%d %H:%M} UTC, expected at least "
                f"{LOWEST_SUN_DEG:g}; give another --sun-azimuth, --sun-elevation or place"
            )
        found.append((day, sun))
    return found


def _moment(lon: float, lat: float, azimuth: float, elevation: float) -> datetime:
    """A time in 2020 when the sun stands there (degrees, azimuth from true north), to a degree; else `START`.

    The sun's declination follows from the triangle of pole, zenith and sun, the day from the declination.

    Args:
        lon: longitude [degrees].
        lat: latitude [degrees].
        azimuth: of the sun [degrees].
        elevation: of the sun [degrees].
    """
    phi, a, e = np.radians([lat, azimuth, elevation])
    declination = np.sin(phi) * np.sin(e) + np.cos(phi) * np.cos(e) * np.cos(a)
    share = -np.degrees(np.arcsin(np.clip(declination, -1, 1))) / 23.44
    if abs(share) > 1:
        return START
    day = np.arccos(share) / (2 * np.pi) * 365.25 - 10  # days since the new year; December's solstice is 10 days before
    hour_angle = np.arctan2(-np.sin(a) * np.cos(e), np.sin(e) * np.cos(phi) - np.cos(e) * np.cos(a) * np.sin(phi))
    b = 2 * np.pi * (day - 81) / 364
    of_time = 9.87 * np.sin(2 * b) - 7.53 * np.cos(b) - 1.5 * np.sin(b)  # minutes by which a sundial is fast
    hours = 12 + np.degrees(hour_angle) / 15 - lon / 15 - of_time / 60
    noon = datetime(2020, 1, 1, tzinfo=UTC) + timedelta(days=int(np.floor(day)))
    return (noon + timedelta(hours=float(hours))).replace(microsecond=0)


@dataclass(frozen=True)
class Sky:
    """An even sky over a world: its share per band, its directions, and which of them the world's places see."""

    share: np.ndarray
    directions: np.ndarray
    seen: np.ndarray

    @classmethod
    def over(cls, world: NaturalWorld, share: float) -> Sky:
        """The sky of a share (green) of the sun's irradiance over a world."""
        directions = sky_directions()
        high = float(world.height.max()) + 2.0
        seen = open_sky(world.height, world.slope_x, world.slope_y, world.cell_size, directions, STRIDE, high)
        return cls(share * np.array(BANDS), directions, seen)

    def light(self, world: NaturalWorld, view: np.ndarray) -> np.ndarray:
        """What every place adds towards ``view`` ``[3]``, over its amplitude: ``[H, W, 3]``."""
        light = sky_light(
            self.seen, world.slope_x, world.slope_y, world.albedo, world.parameters, world.model, self.directions,
            STRIDE, view,
        )  # fmt: skip
        return np.asarray(light * self.share, np.float32)


def _take(
    scene: Scene,
    options: SimulateOptions,
    world: NaturalWorld,
    sky: Sky | None,
    view: SimulatedView,
    seed: np.random.SeedSequence,
) -> Item:
    """Render one view and write its files."""
    assert scene.grid is not None  # set before the views are taken
    sun = grid_direction(*view.sun, scene.grid.crs, view.rpc.lon_offset, view.rpc.lat_offset)
    low, high = float(world.height.min()) - 2.0, float(world.height.max()) + 2.0
    camera = view.camera
    towards = -camera.look / np.linalg.norm(camera.look)
    added = np.zeros((0, 0, 3), np.float32) if sky is None else sky.light(world, towards)
    factor, lit, height = render_natural(
        world.height, world.slope_x, world.slope_y, world.albedo, world.parameters, world.model, world.cell_size,
        np.array(world.centre), camera.origin, camera.velocity, camera.look, camera.across, camera.focal, camera.col0,
        camera.row0, view.shape, SAMPLES, sun, low, high, added, STRIDE,
    )  # fmt: skip
    full = 2**12 - 1
    signal = full * spread(factor)
    sigma = options.noise * np.sqrt(READ_NOISE_DN**2 + SHOT_NOISE_DN * signal)
    noisy = signal + sigma * np.random.default_rng(seed).standard_normal(signal.shape)
    image = np.clip(np.rint(noisy), 0, full).astype(np.uint16)
    item = write_view(scene, view, Rendered(image, lit, height), sun, options.gsd)
    item.properties["sattools:radiance"] = "reflectance_factor"
    item.properties["sattools:simulated"]["quantity"] = "reflectance_factor"  # of the numbers, for `normalise`
    return item


def spread(image: np.ndarray) -> np.ndarray:
    """The image ``[B, H, W]`` (radiance) through the optics: a Gaussian of `SPREAD_PX`; the edge goes on outside."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(image, (0, SPREAD_PX, SPREAD_PX), mode="nearest"))


def _write_parameters(scene: Scene, world: NaturalWorld, grid: Grid, reflectance: str) -> None:
    """Truth of the reflectance parameters, units and normals on the scene's grid, as products ``truth_<name>``.

    Args:
        scene: gets the products.
        world: what is seen.
        grid: ground grid.
        reflectance: model of all units.
    """
    maps: dict[str, np.ndarray] = {AMOUNT[reflectance]: _pooled(world, world.albedo, grid).transpose(2, 0, 1)}
    shape = world.on_grid(world.parameters, grid)
    maps |= {name: shape[..., k] for k, name in enumerate(PARAMETERS[reflectance])}
    if np.isnan(shape).any():
        maps["lambert_share"] = np.isnan(shape[..., 0])
    slope = np.stack([-world.slope_x, world.slope_y, np.ones_like(world.slope_x)])
    normal = slope / np.linalg.norm(slope, axis=0)
    mean = _pooled(world, normal.transpose(1, 2, 0), grid).transpose(2, 0, 1)
    maps["normal"] = mean / np.linalg.norm(mean, axis=0)
    for name, array in maps.items():
        href = f"truth/{scene.id}_{name.upper()}.tif"
        write_cog(scene.output(href), array.astype(np.float32), grid, units="degrees" if name == "theta" else "1")
        scene.products[f"truth_{name}"] = href
    href = f"truth/{scene.id}_UNITS.tif"
    write_cog(scene.output(href), world.on_grid(world.units, grid), grid, nodata=None)
    scene.products["truth_units"] = href


def _pooled(world: NaturalWorld, raster: np.ndarray, grid: Grid) -> np.ndarray:
    """Mean over the four cells of a world ``[H, W, C]`` that fill a cell of the grid."""
    quarter = grid.cell_size / 4
    corners = [grid.moved(east, north) for east in (-quarter, quarter) for north in (-quarter, quarter)]
    return np.asarray(np.mean([world.on_grid(raster, moved) for moved in corners], axis=0))


__all__ = ["pass_suns", "simulate_natural"]

"""The simulate stage: a ray-traced scene with known truth."""

from __future__ import annotations

import logging
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sattools.camera.ground import from_geographic, grid_direction, middle_lon_lat, utm_crs
from sattools.camera.sun import sun_position
from sattools.errors import InputError
from sattools.progress import Progress, silent
from sattools.scene.document import Item, Scene
from sattools.scene.files import check_outputs
from sattools.scene.grid import Grid
from sattools.simulate.camera import Pushbroom, fit_rpc
from sattools.simulate.cars import with_cars
from sattools.simulate.clouds import CLOUD_BASE_M, CloudLayer
from sattools.simulate.detailed import DetailedWorld, leaves_on
from sattools.simulate.earlier import remove_earlier
from sattools.simulate.fan import pass_suns, simulate_natural
from sattools.simulate.files import write_truth
from sattools.simulate.multispectral import write_colours
from sattools.simulate.options import SimulateOptions
from sattools.simulate.sensor import HARD, HDR, SKY_COLOUR, USUAL, Light, Radiometry, digital_numbers, sun_colour
from sattools.simulate.views import Rendered, SimulatedView, framed, take_all, write_view
from sattools.simulate.world import World

if TYPE_CHECKING:
    from sattools.simulate.terrain import GivenSurface

log = logging.getLogger(__name__)
SKY_STRIDE = 8
LOWEST_SUN_DEG = 2.0  # a lower one, or none, leaves towns in shade
DSM_MARGIN_M = 60.0  # surroundings of the scene that cast shadows into it
BRIGHT_ROOF = 0.4  # reflectance from which a building's top (class 6) counts as bright
CAR_KEY, OUTLIER_KEY, CLOUD_KEY = 1000, 1001, 1002
OUTLIER = (5.0, 12.0)  # one camera of a downtown is off by so many times as much as the others may be
BASE_M = -22.0  # ellipsoidal height of the ground, as at Jacksonville


def simulate(options: SimulateOptions, root: Path, progress: Progress = silent, overwrite: bool = False) -> Scene:
    """Make a scene below `root`; the same options give the same files.

    Writes `images/` (digital numbers, RPC tags with the bias asked for), `metadata/` (Sat-NeRF JSON with the same
    RPCs), `rpc/` (the true RPCs, which the scene's items use), `truth/` (DSM, classes, albedo on the scene's grid;
    per view the share of sunlit ground and the height seen). What an earlier simulation in that folder has written and
    this one does not goes. Raises OutputExistsError where a scene is there already, InputError
    for a DSM that is none or a town without sun.

    Args:
        options: of the simulation.
        root: folder in which the scene's own is made.
        progress: told the share done and what is being done.
        overwrite: replace outputs that are there.
    """
    scene = check_start(options, root, overwrite)
    scene.output("scene.json")
    make = simulate_natural if options.terrain == "natural" else _simulate_town
    make(scene, options, progress)
    remove_earlier(scene, bool(options.pan))
    return scene


def _simulate_town(scene: Scene, options: SimulateOptions, progress: Progress) -> Scene:
    """Fill a scene with buildings on flat ground, or with the ground of `options.dsm`."""
    seeds = np.random.SeedSequence(options.seed).spawn(3)
    progress(0.0, "building")
    grid, world = world_of(options)
    bright = (world.classes == 6)[..., None] & (world.albedo > BRIGHT_ROOF).any(-1, keepdims=True)
    world.albedo = np.where(bright, np.minimum(world.albedo * _light(options).roofs, 0.95), world.albedo)
    low, high = float(world.height.min()), float(world.top.max())
    views = plan_views(options, grid, (low, high), np.random.default_rng(seeds[1]))
    scene.grid = grid
    scene.height_range_m = (float(np.floor(low - 5)), float(np.ceil(high + 5)))
    write_truth(scene, world, grid)
    progress(0.05, "compiling the ray tracer")
    from sattools.simulate.trace import sky_share

    sky = sky_share(world, SKY_STRIDE)

    parked: list[int] = []

    def take(number: int, view: SimulatedView, seed: np.random.SeedSequence) -> Item:
        today, cars = _on_the_day(options, world, number, view)
        parked.append(cars)
        return _take(scene, options, today, sky, view, seed)

    take_all(scene, views, seeds[2], take, progress)
    if min(parked) < options.cars:
        room = " to ".join(map(str, sorted({min(parked), max(parked)})))
        log.warning("--cars: found room for %s of %d in each image, which show no more", room, options.cars)
    return scene


def check_start(options: SimulateOptions, root: Path, overwrite: bool = False) -> Scene:
    """The scene that `simulate` will fill, without anything yet but a given surface's grid; see `simulate`."""
    scene = Scene(options.id, Path(root))
    check_outputs([scene.path("scene.json")], [Path(p) for p in (options.dsm, options.classes) if p], overwrite)
    place = options.lon, options.lat
    if options.dsm is not None:
        scene.grid = _given(options)[0].grid
        place = middle_lon_lat(scene.grid)
    if options.terrain == "natural":
        pass_suns(options, *place)
    elif options.test_views >= options.views:
        log.warning(
            "--test-views: found %d of %d views, one of which is for training", options.test_views, options.views
        )
    return scene


def plan_views(
    options: SimulateOptions, grid: Grid, heights: tuple[float, float], rng: np.random.Generator
) -> list[SimulatedView]:
    """Cameras, dates and suns: directions spread by the golden angle, mornings some 60 days apart.

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
    tilts = np.linspace(min(5.0, options.off_nadir), options.off_nadir, options.views)[rng.permutation(options.views)]
    turn = rng.uniform(0, 360)
    dates = [Radiometry.draw(rng, _light(options)) for _ in range(options.dates)]
    days = [
        datetime(2014, 10, 5, tzinfo=UTC) + timedelta(days=62 * k + int(rng.integers(20))) for k in range(options.dates)
    ]
    held = min(options.test_views, options.views - 1)  # one is for training
    test = {1 + k * options.views // held for k in range(held)}
    views = []
    for k in range(options.views):
        date = k % options.dates
        # half past ten in the morning by the sun, give or take
        minutes = 60 * (10.5 - lon / 15) + rng.uniform(-25, 25)
        time = (days[date] + timedelta(minutes=minutes)).replace(microsecond=0)
        sun = sun_position(time, lon, lat)
        if sun[1] < LOWEST_SUN_DEG:
            raise InputError(
                f"{options.dsm or '--lat'}: found a sun {sun[1]:.1f} degrees high at {lat:.1f} N on {time:%Y-%m-%d}, "
                f"expected at least {LOWEST_SUN_DEG:g}: a place nearer to the equator"
            )
        azimuth = float((turn + 137.508 * k) % 360)
        sensor = (azimuth, 90.0 - float(tilts[k]))
        view = grid_direction(*sensor, grid.crs, lon, lat)
        camera = Pushbroom.towards(np.array([x, y, z]), view, options.gsd, (1, 1), float(rng.uniform(-8, 8)))
        camera, shape = framed(camera, corners)
        rpc, error = fit_rpc(camera, grid.crs, (x, y, z))
        angle = rng.uniform(0, 2 * np.pi)
        bias = options.bias_px * np.sqrt(rng.uniform()) * np.array([np.cos(angle), np.sin(angle)])
        views.append(
            SimulatedView(
                f"{options.id}_{k + 1:03d}", time, sun, sensor, camera, rpc,
                error, shape, dates[date], (float(bias[0]), float(bias[1])),
                "test" if k in test else "train",
            )
        )  # fmt: skip
    return _with_outlier(options, views)


def _with_outlier(options: SimulateOptions, views: list[SimulatedView]) -> list[SimulatedView]:
    """The views, one training camera of a downtown far off, as one of many delivered ones is."""
    if options.terrain != "downtown" or not options.bias_px or len(views) < 3:
        return views
    # a seed of its own, as for the cars
    rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(OUTLIER_KEY,)))
    chosen = int(rng.choice([k for k, view in enumerate(views) if view.role == "train"]))
    angle, radius = rng.uniform(0, 2 * np.pi), options.bias_px * rng.uniform(*OUTLIER)
    bias = float(radius * np.cos(angle)), float(radius * np.sin(angle))
    return [replace(view, bias=bias) if k == chosen else view for k, view in enumerate(views)]


def _light(options: SimulateOptions) -> Light:
    if options.hdr:
        return HDR
    return HARD if options.terrain == "downtown" else USUAL


def world_of(options: SimulateOptions) -> tuple[Grid, World]:
    """The scene's grid and the ground under it and around it."""
    rng = np.random.default_rng(np.random.SeedSequence(options.seed).spawn(1)[0])
    if options.dsm is not None:
        return _world_of_dsm(options, rng)
    from sattools.simulate.city import build_city

    crs = utm_crs(options.lon, options.lat)
    x, y = (float(v) for v in from_geographic(crs, options.lon, options.lat))
    cells = max(1, round(options.size / options.gsd))
    half = cells * options.gsd / 2
    grid = Grid(crs, float(round(x - half)), float(round(y + half)), options.gsd, cells, cells)
    west, _, east, _ = grid.bounds
    centre, size, cell = grid.middle, east - west, options.gsd / 2
    if options.terrain == "downtown":
        from sattools.simulate.downtown import build_downtown

        return grid, build_downtown(centre, size, cell, BASE_M, rng, trees=options.trees)
    return grid, build_city(centre, size, cell, BASE_M, rng, trees=options.trees)


def _world_of_dsm(options: SimulateOptions, rng: np.random.Generator) -> tuple[Grid, World]:
    from sattools.simulate.detailed import over_surface_model
    from sattools.simulate.terrain import build_terrain, tell_unknown

    assert options.dsm is not None  # the caller has looked
    surface, classes = _given(options)
    tell_unknown(options.dsm, surface)
    world = build_terrain(surface.heights, surface.wide, classes, options.gsd / 2, rng)
    return surface.grid, over_surface_model(world, rng) if options.terrain == "downtown" else world


def _given(options: SimulateOptions) -> tuple[GivenSurface, np.ndarray | None]:
    """The surface of `options.dsm`, and its classes ``[H, W]`` or None."""
    from sattools.simulate.natural import MARGIN_M
    from sattools.simulate.terrain import read_classes, read_surface

    assert options.dsm is not None  # the caller has looked
    natural = options.terrain == "natural"
    surface = read_surface(options.dsm, options.size, MARGIN_M if natural else DSM_MARGIN_M)
    if natural or options.classes is None:
        return surface, None
    return surface, read_classes(options.classes, options.dsm, surface)


def _on_the_day(options: SimulateOptions, world: World, number: int, view: SimulatedView) -> tuple[World, int]:
    """The world with the cars and the season of one image, and how many cars these are."""
    if isinstance(world, DetailedWorld):
        world = world.on_day(leaves_on(view.time, view.rpc.lat_offset))
    if not options.cars:
        return world, 0
    # a seed of their own: neither cameras nor noise change when cars do
    rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(CAR_KEY, number)))
    return with_cars(world, options.cars, options.size / 2, rng)


def _clouds(options: SimulateOptions, view: SimulatedView, ground: float) -> CloudLayer | None:
    """The clouds of one image above the ground's height [m], if there are some that day."""
    number = int(view.id.rsplit("_", 1)[-1])
    if not options.clouds or (number - 1) % options.dates % 2 == 0:
        return None
    # a seed of their own: nothing else changes when clouds do
    rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(CLOUD_KEY, number)))
    return CloudLayer(options.clouds, ground + CLOUD_BASE_M, rng)


def _take(
    scene: Scene,
    options: SimulateOptions,
    world: World,
    sky: np.ndarray,
    view: SimulatedView,
    seed: np.random.SeedSequence,
) -> Item:
    """Render one view and write its files."""
    assert scene.grid is not None  # set before the views are taken
    light = _light(options)
    sun = grid_direction(*view.sun, scene.grid.crs, view.rpc.lon_offset, view.rpc.lat_offset)
    radiance, lit, height = _traced(world, view, sky, sun, light.sky * SKY_COLOUR)
    if (clouds := _clouds(options, view, scene.require_height_range()[0])) is not None:
        both = np.stack([sun_colour(view.sun[1]), light.sky * SKY_COLOUR])
        radiance = clouds.over(radiance, height, view.camera, sun, both)
    rng = np.random.default_rng(seed)
    bits = 8 if options.bits == 8 else 11
    image = digital_numbers(radiance, view.radiometry, options.noise, bits, rng, light.exposure)
    if options.pan:
        image = write_colours(scene, view, image, options.pan, rng)
    return write_view(scene, view, Rendered(image, lit, height), sun, options.gsd)


def _traced(
    world: World, view: SimulatedView, sky: np.ndarray, sun: np.ndarray, sky_colour: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radiance, share of sunlit ground and height of a view; see `trace.render`."""
    from sattools.simulate import detailed_trace, trace

    camera = view.camera
    low, high = float(world.height.min()) - 2.0, float(world.top.max()) + 2.0
    surface = world.height, world.slope_x, world.slope_y, world.albedo, world.wall_albedo, world.windows
    seen = (
        sky, SKY_STRIDE, world.cell_size, world.turn, np.array(world.centre), camera.origin, camera.velocity,
        camera.look, camera.across, camera.focal, camera.col0, camera.row0, view.shape, 2, sun, sun_colour(view.sun[1]),
        sky_colour, low, high,
    )  # fmt: skip
    if not isinstance(world, DetailedWorld):
        return trace.render(*surface, *seen)
    crowns = world.crown_base, world.crown_top, world.foliage
    number = int(view.id.rsplit("_", 1)[-1])
    return detailed_trace.render(*surface, world.building, world.gloss, *crowns, *seen, number)


__all__ = ["SimulateOptions", "SimulatedView", "check_start", "plan_views", "simulate", "world_of"]

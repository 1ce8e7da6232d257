"""Natural scenes: an independent reflectance in the tracer, and what the scene says of itself."""

import shutil
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from scipy.ndimage import map_coordinates

from sattools.camera import RPC
from sattools.camera.ground import project
from sattools.camera.sun import sun_position
from sattools.cli import main
from sattools.errors import InputError
from sattools.radiometry.kind import image_scales
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.reflectance import hapke, rpv
from sattools.scene import Scene
from sattools.scene.raster import read_image, read_raster
from sattools.simulate import SimulateOptions, simulate
from sattools.simulate.brdf import HAPKE, LAMBERT, RPV, radiance_factor
from sattools.simulate.fan import pass_suns, spread
from sattools.simulate.options import without_effect

SMALL = {"terrain": "natural", "size": 64.0, "views": 5, "train": 3, "units": 3, "seed": 1}
PAIR = {**SMALL, "size": 32.0, "views": 2, "train": 2}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return simulate(SimulateOptions(**SMALL), tmp_path_factory.mktemp("natural"))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Two views of half as wide a ground."""
    return simulate(SimulateOptions(**PAIR), tmp_path_factory.mktemp("pair"))


def directions(count: int, rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=(count, 3)) * 0.7 + (0, 0, 1)
    v[:, 2] = np.abs(v[:, 2])
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.mark.parametrize("model", [HAPKE, RPV])
def test_the_tracers_reflectance_and_the_fits_agree_though_they_share_nothing(model: Any) -> None:
    rng = np.random.default_rng(0)
    n, s, v = (directions(2000, rng) for _ in range(3))
    if model == HAPKE:
        low, high, function = (0, 0, 0, 1), (0.9, 0.9, 1, 50), hapke
    else:
        low, high, function = (0, 0.4, -0.6, 0), (1, 1.6, 0.6, 1), rpv
    p = rng.uniform(low, high, (2000, 4))
    traced = np.array([radiance_factor(model, *n[k], *s[k], *v[k], *p[k]) for k in range(2000)])
    cos_i = (n * s).sum(-1)
    fitted = function(*(torch.from_numpy(a) for a in (n, s, v)), *(torch.from_numpy(a) for a in p.T)).numpy() * cos_i
    usual = (cos_i > 0.02) & ((n * v).sum(-1) > 0.02)  # arc cosines lose digits near the horizon
    assert usual.sum() > 1000
    np.testing.assert_allclose(traced[usual], fitted[usual], rtol=2e-6, atol=1e-9)
    assert (traced[cos_i < 0] == 0).all()


@pytest.mark.parametrize("options", [{}, {"quantity": "relative"}, {"match": True}])
def test_natural_ground_stays_a_reflectance_factor_unless_something_else_is_asked_for(
    pair: Scene, tmp_path: Path, options: Any
) -> None:
    made = Scene.from_json(pair.to_json())
    made.root = tmp_path / "PAIR"
    shutil.copytree(pair.root, made.root)
    for _ in range(2):  # what `normalise` has said does not count as what the images say
        about = normalise(made, NormaliseOptions(**options))
        kind = "relative" if options else "reflectance_factor"
        assert (about["quantity"], made.items[0].properties["sattools:radiance"]) == (kind, kind)
    numbers = read_image(made.path(made.items[0].assets["image"].href))
    radiance = read_image(made.path(made.items[0].assets["radiance"].href))
    np.testing.assert_allclose(radiance, numbers / 4095, rtol=1e-6)


def test_saturated_pixels_of_natural_ground_are_masked(scene: Any) -> None:
    (scale,) = image_scales(scene, scene.items[:1], NormaliseOptions()).values()
    assert scale.saturation(12) == 4095


def test_hapkes_golden_value() -> None:
    # i = 45, e = 10, psi = 0, theta = 15 degrees: BRF 0.154039
    i, e = np.radians([45, 10])
    got = radiance_factor(
        HAPKE, 0.0, 0.0, 1.0, np.sin(i), 0.0, np.cos(i), np.sin(e), 0.0, np.cos(e), 0.6, 0.3, 0.4, 15.0
    )
    assert got / np.cos(i) == pytest.approx(0.154039, abs=1e-6)
    lambert = radiance_factor(LAMBERT, 0.0, 0.0, 1.0, 0.6, 0.0, 0.8, 0.0, 0.0, 1.0, 0.5, 0.0, 0.0, 0.0)
    assert lambert == pytest.approx(0.4)


def test_a_scene_says_what_its_radiance_is_and_which_views_are_for_training(scene: Any) -> None:
    assert {item.properties["sattools:radiance"] for item in scene.items} == {"reflectance_factor"}
    assert [item.role for item in scene.items] == ["test", "train", "train", "train", "test"]
    tilts = [item.properties["view:off_nadir"] for item in scene.items]
    assert tilts == pytest.approx([45, 22.6, 2, 22.6, 45], abs=0.1)
    assert len({item.sun for item in scene.items}) == 1
    assert all(item.properties["sattools:bits"] == 12 for item in scene.items)


def test_images_show_the_truth(scene: Any) -> None:
    """Nadir view over the truth maps: reflectance by the fit's own function of the true normals."""
    nadir = scene.items[2]
    image = read_image(scene.path(nadir.assets["image"].href)) / 4095
    truth = {k: read_raster(scene.path(scene.products[f"truth_{k}"]))[0] for k in ("w", "b", "c", "theta", "normal")}
    normal = torch.from_numpy(truth["normal"].transpose(1, 2, 0)).double()
    sun, view = (torch.tensor(nadir.properties[f"sattools:{k}_direction"]).double() for k in ("sun", "view"))
    w = torch.from_numpy(truth["w"].transpose(1, 2, 0)).double()
    shape = [torch.from_numpy(truth[k])[0][..., None].double() for k in ("b", "c", "theta")]
    factor = hapke(normal[..., None, :], sun, view, w, *shape) * (normal @ sun).clamp_min(0)[..., None]
    heights, grid = read_raster(scene.path(scene.products["truth_dsm"]))
    east, north = np.meshgrid(grid.x(), grid.y())
    rpc = RPC.from_file(scene.path(nadir.assets["rpc"].href))
    at = project(rpc, grid.crs, east.ravel(), north.ravel(), heights[0].ravel())
    shown = np.stack([map_coordinates(band, at[::-1], order=1).reshape(grid.shape) for band in image], axis=-1)
    # 1024 cells of 10 % texture on another lattice than the pixels
    assert shown.mean() == pytest.approx(float(factor.mean()), rel=0.02)
    assert np.corrcoef(shown.ravel(), factor.numpy().ravel())[0, 1] > 0.98


def test_the_sensor_spreads_light_but_keeps_it() -> None:
    """A point keeps its energy; stripes one pixel wide keep a third of their contrast, 0.64 of it after the pixel."""
    point = np.zeros((1, 15, 15), np.float32)
    point[0, 7, 7] = 1.0
    shown = spread(point)
    assert shown.sum() == pytest.approx(1.0, abs=1e-5)
    assert shown[0, 7, 7] == pytest.approx(0.44, abs=0.01)
    stripes = np.tile([1.0, -1.0], (1, 16, 8)).astype(np.float32)
    assert np.abs(spread(stripes)[0, 8, 4:-4]).mean() == pytest.approx(0.34, abs=0.01)


def test_the_models_differ_and_the_same_seed_gives_the_same_scene(pair: Scene, tmp_path: Path) -> None:
    again = simulate(SimulateOptions(**PAIR), tmp_path / "again")
    plain = simulate(SimulateOptions(**PAIR, reflectance="lambert"), tmp_path / "plain")
    name = pair.items[0].assets["image"].href
    assert np.array_equal(read_image(again.path(name)), read_image(pair.path(name)))
    assert not np.array_equal(read_image(plain.path(name)), read_image(pair.path(name)))
    assert {"truth_reflectance", "truth_normal"} <= plain.products.keys()
    assert "truth_theta" not in plain.products


def test_given_relief_is_taken(data_dir: Any, tmp_path: Path) -> None:
    options = SimulateOptions(**{**SMALL, "views": 2}, dsm=str(data_dir / "terrain/TM1_564_146.tif"))
    scene = simulate(options, tmp_path)
    truth, grid = read_raster(scene.path(scene.products["truth_dsm"]))
    given, whole = read_raster(data_dir / "terrain/TM1_564_146.tif")
    row, col = int((whole.top - grid.top) / whole.cell_size), int((grid.left - whole.left) / whole.cell_size)
    # smoothed to what a pixel can show
    assert truth[0] == pytest.approx(given[0, row : row + 64 : 2, col : col + 64 : 2], abs=1.5)


def test_terrains_have_their_own_defaults_and_limits() -> None:
    assert SimulateOptions().gsd == 0.5
    assert SimulateOptions(terrain="natural").gsd == 2.0
    with pytest.raises(InputError, match="12"):
        SimulateOptions(bits=12)
    shown = CliRunner().invoke(main, ["simulate", "--terrain", "natural", "--print-config"])
    assert "views = 21" in shown.output


def test_an_even_sky_adds_its_share_to_level_white_ground(tmp_path: Path) -> None:
    """Lambertian ground shows albedo (sin(sun elevation) + sky); shade aside, the sun's part does not change."""
    level = {**PAIR, "slope": 0.0, "reflectance": "lambert", "noise": 0.0, "units": 1}
    dark, light = (
        simulate(SimulateOptions(**level, sky=sky), tmp_path / name) for name, sky in (("dark", 0.0), ("light", 0.1))
    )
    for one, other in zip(dark.items, light.items, strict=True):
        before, after = (
            read_image(s.path(i.assets["image"].href)).astype(float) for s, i in ((dark, one), (light, other))
        )
        expected = 1 + 0.1 * np.array([0.75, 1.0, 1.3]) / np.sin(np.radians(48.0))
        assert (after.mean((1, 2)) / before.mean((1, 2))).tolist() == pytest.approx(expected.tolist(), rel=2e-3)


def test_passes_are_dates_of_one_hour_with_the_suns_of_their_days(tmp_path: Path) -> None:
    options = SimulateOptions(**{**PAIR, "views": 6, "passes": 3, "sun_azimuth": 135.0, "sun_elevation": 48.0})
    items = simulate(options, tmp_path).items
    suns = [(item.properties["view:sun_azimuth"], item.properties["view:sun_elevation"]) for item in items]
    assert suns[0] == (135.0, 48.0)
    assert suns[:3] == suns[3:]
    assert len(set(suns)) == 3
    times = [datetime.fromisoformat(str(item.properties["datetime"])) for item in items]
    assert len({time.date() for time in times}) == 3
    for (azimuth, elevation), item, time in zip(suns, items, times, strict=True):
        there = sun_position(time, -81.66, 30.35)
        assert there == pytest.approx((azimuth, elevation), abs=1.0), item.id


def test_passes_need_natural_ground_and_a_sun_above_the_horizon() -> None:
    with pytest.raises(InputError, match="--passes: found --terrain city"):
        SimulateOptions(passes=2)
    low = SimulateOptions(**{**SMALL, "passes": 2, "sun_azimuth": 180.0, "sun_elevation": 55.0})
    with pytest.raises(InputError, match="--passes: found a sun"):
        pass_suns(low, 10.0, 58.0)


def test_plain_units_are_some_of_ground_that_has_a_model(tmp_path: Path) -> None:
    """All of Lambertian ground is plain: a map that gave a part of it to Lambert's law would be wrong elsewhere."""
    lambert = SimulateOptions(**{**PAIR, "reflectance": "lambert", "plain_units": 2})
    assert "truth_lambert_share" not in simulate(lambert, tmp_path).products
    assert without_effect(lambert, ["plain_units"]) == {
        "plain_units": "found --reflectance lambert, expected rpv or hapke"
    }
    assert without_effect(SimulateOptions(**{**PAIR, "plain_units": 3}), ["plain_units"]) == {}
    with pytest.raises(InputError, match="--plain-units: found 4, expected at most --units, 3"):
        SimulateOptions(**{**PAIR, "plain_units": 4})


@pytest.mark.parametrize("model", ["hapke", "rpv"])
def test_the_true_albedo_is_a_reflectance_whatever_the_model(model: Any, tmp_path: Path) -> None:
    """That of level ground under a sun 15 degrees from the vertical, as `export` has it; it was w or rho0."""
    made = simulate(SimulateOptions(**PAIR, reflectance=model), tmp_path)
    names = {"hapke": ("w", "b", "c", "theta"), "rpv": ("rho0", "k", "asymmetry", "rhoc")}[model]
    truth = [read_raster(made.path(made.products[f"truth_{name}"]))[0].transpose(1, 2, 0) for name in names]
    function = {"hapke": hapke, "rpv": rpv}[model]
    up, sun = torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor([0.2588190, 0.0, 0.9659258]).double()
    level = function(up, sun, up, *(torch.from_numpy(a).double() for a in truth)).numpy().transpose(2, 0, 1)
    albedo, _ = read_raster(made.path(made.products["truth_albedo"]))
    # one of the four cells of which w and rho0 are the means
    assert np.median(albedo / level) == pytest.approx(1, abs=0.02)

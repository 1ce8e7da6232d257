"""Simulated clouds: on every other date, others in every image, with their shadows, and not in the truth."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sattools.cli import main
from sattools.scene.raster import read_image, read_raster
from sattools.simulate import SimulateOptions, simulate
from sattools.simulate.camera import Pushbroom
from sattools.simulate.clouds import WHITE, CloudLayer

OPTIONS = SimulateOptions(size=32.0, views=4, dates=2, seed=5)
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("clouds")
    return simulate(OPTIONS, folder / "clear"), simulate(replace(OPTIONS, clouds=0.6), folder / "cloudy")


def images(scene: Any) -> Any:
    return [read_image(scene.path(item.assets["image"].href)) for item in scene.items]


def test_every_other_date_has_clouds_and_nothing_else_changes(scenes: Any) -> None:
    clear, cloudy = scenes
    same = [np.array_equal(a, b) for a, b in zip(images(clear), images(cloudy), strict=True)]
    assert same == [True, False, True, False]
    for name in ("truth_dsm", "truth_classes", "truth_albedo"):
        assert np.array_equal(*(read_raster(s.path(s.products[name]))[0] for s in scenes), equal_nan=True), name
    assert [i.properties["datetime"] for i in clear.items] == [i.properties["datetime"] for i in cloudy.items]


def test_images_of_one_date_have_clouds_of_their_own(scenes: Any) -> None:
    ratios = [b.mean() / a.mean() for a, b in zip(*map(images, scenes), strict=True)]
    assert abs(ratios[1] - ratios[3]) > 0.05


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_so_much_of_the_sky_is_covered(share: float) -> None:
    layer = CloudLayer(share, 900.0, np.random.default_rng(0))
    assert (layer.opacity > 0).mean() == pytest.approx(share, abs=1e-3)
    assert layer.opacity.max() == 1.0


def test_a_line_meets_the_layer_beside_the_place_it_starts_from() -> None:
    layer = CloudLayer(0.5, 900.0, np.random.default_rng(0))
    places = np.array([[80.0, 160.0, 0.0], [80.0, 160.0, 100.0]])
    slanting = np.array([0.08, -0.16, 1.0])  # 72 m east and 144 m south over 900 m: 9 and 18 cells
    assert layer.along(places[:1], UP)[0] == layer.opacity[20, 10]
    assert layer.along(places[:1], np.broadcast_to(slanting, (1, 3)))[0] == pytest.approx(layer.opacity[2, 19])
    assert layer.along(places[1:], np.broadcast_to(UP, (1, 3)))[0] == layer.opacity[20, 10]


def test_clouds_are_white_and_their_shadow_leaves_the_light_of_the_sky() -> None:
    layer = CloudLayer(0.5, 900.0, np.random.default_rng(0))
    light = np.array([[1.0, 1.0, 1.0], [0.1, 0.2, 0.3]])
    camera = Pushbroom.towards(np.zeros(3), UP, 8.0, (40, 40))
    sun = np.array([0.6, 0.0, 0.8])
    ground = np.full((3, 40, 40), 0.2, np.float32)
    picture = layer.over(ground, np.zeros((40, 40)), camera, sun, light)
    np.testing.assert_allclose(picture.max(axis=(1, 2)), WHITE * (0.8 + light[1]), rtol=1e-6)
    np.testing.assert_allclose(picture.min(axis=(1, 2)), 0.2 * light[1] / (0.8 + light[1]), rtol=1e-3)


def test_a_camera_sees_what_it_projects() -> None:
    slanting = np.array([0.48, -0.36, 0.8])
    camera = Pushbroom.towards(np.array([10.0, 20.0, 5.0]), slanting, 0.5, (100, 120), 7.0)
    col, row = np.array([0.0, 50.5, 119.0]), np.array([99.0, 3.25, 0.0])
    height = np.array([-10.0, 0.0, 150.0])
    points, lines = camera.seen(col, row, height)
    np.testing.assert_array_equal(points[:, 2], height)
    np.testing.assert_allclose(camera.project(points), (col, row), atol=1e-6)
    np.testing.assert_allclose(camera.project(points + 300.0 * lines), (col, row), atol=1e-6)


def test_natural_ground_has_no_clouds_and_says_so() -> None:
    result = CliRunner().invoke(main, ["simulate", "--terrain", "natural", "--clouds", "0.3", "--dry-run"])
    assert "--clouds" in result.stderr
    assert "expected city or downtown" in result.stderr

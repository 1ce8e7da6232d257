"""Simulated extremes of light, and cars that are elsewhere in every image."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sattools.cli import main
from sattools.errors import InputError
from sattools.scene.raster import read_image, read_raster
from sattools.simulate import SimulateOptions, simulate
from sattools.simulate.cars import with_cars
from sattools.simulate.city import build_city

OPTIONS = SimulateOptions(size=48.0, views=2, dates=2, hdr=True, seed=5)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The same scene with 11 bits, with 8 bits, and with 20 cars."""
    folder = tmp_path_factory.mktemp("hdr")
    return {
        "linear": simulate(OPTIONS, folder / "linear"),
        "toned": simulate(replace(OPTIONS, bits=8), folder / "toned"),
        "cars": simulate(replace(OPTIONS, cars=20), folder / "cars"),
        "usual": simulate(replace(OPTIONS, hdr=False), folder / "usual"),
    }


def images(scene: Any) -> Any:
    return [read_image(scene.path(item.assets["image"].href)) for item in scene.items]


def test_eight_bits_show_the_same_scene_through_a_tone_curve(scenes: Any) -> None:
    for linear, toned in zip(images(scenes["linear"]), images(scenes["toned"]), strict=True):
        order = np.argsort(linear.ravel())
        assert (np.diff(toned.ravel()[order]) >= 0).all()
        assert toned.max() == 255


def test_hdr_shadows_are_deeper_and_dates_differ_more(scenes: Any) -> None:
    def contrast(name: Any) -> Any:
        low, high = np.percentile(images(scenes[name])[0], [2, 98])
        return high / low

    def gains(name: Any) -> Any:
        found = [item.properties["sattools:simulated"]["gain"][1] for item in scenes[name].items]
        return max(found) / min(found)

    assert contrast("linear") > 1.3 * contrast("usual")
    assert gains("linear") > gains("usual")


def test_cars_are_in_the_images_but_not_in_the_truth(scenes: Any) -> None:
    plain, cars = scenes["linear"], scenes["cars"]
    for name in ("truth_dsm", "truth_classes", "truth_albedo"):
        assert np.array_equal(*(read_raster(s.path(s.products[name]))[0] for s in (plain, cars)), equal_nan=True), name
    changed = [np.abs(a - b).max(axis=0) > 40 for a, b in zip(images(plain), images(cars), strict=True)]
    for mask in changed:
        assert 0.002 < mask.mean() < 0.2
    # cameras and noise are the same: most pixels are identical
    for a, b in zip(images(plain), images(cars), strict=True):
        assert (a == b).mean() > 0.7


def test_every_image_has_its_cars_elsewhere_on_the_streets() -> None:
    world = build_city((0.0, 0.0), 60.0, 0.25, 0.0, np.random.default_rng(0))
    first, second = (with_cars(world, 15, 30.0, np.random.default_rng(k))[0] for k in range(2))
    places = [np.abs(w.height - world.height) > 1.0 for w in (first, second)]
    for place in places:
        area = place.sum() * 0.25**2
        assert area == pytest.approx(15 * 4.4 * 1.8, rel=0.1)
        assert world.streets[place].all()
    assert (places[0] & places[1]).sum() < 0.5 * places[0].sum()
    assert np.array_equal(first.classes, world.classes)


@pytest.mark.parametrize(("cars", "told"), [("3", False), ("500", True)])
def test_cars_that_found_no_room_are_told(tmp_path: Path, cars: str, told: bool) -> None:
    given = ["--id", "C", "--size", "48", "--views", "2", "--dates", "1", "--test-views", "0", "--seed", "5"]
    result = CliRunner().invoke(main, ["simulate", "--cars", cars, *given, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.stderr
    words = r"--cars: found room for (\d+)(?: to (\d+))? of 500 in each image, which show no more\n"
    found = re.search(words, result.stderr)
    assert (found is not None) == told
    if found:
        low, high = int(found[1]), int(found[2] or found[1])
        assert 10 < low <= high < 290  # on 48 x 48 m, of which a car takes 8 m2


def test_terrain_without_streets_has_no_cars() -> None:
    world = build_city((0.0, 0.0), 40.0, 0.5, 0.0, np.random.default_rng(0))
    with pytest.raises(InputError, match="--cars: found no streets"):
        with_cars(replace(world, streets=None), 3, 20.0, np.random.default_rng(0))


def test_a_window_beside_the_streets_has_no_cars() -> None:
    world = build_city((0.0, 0.0), 40.0, 0.5, 0.0, np.random.default_rng(0))
    streets = np.zeros_like(world.streets)
    streets[0, 0] = True
    same, parked = with_cars(replace(world, streets=streets), 3, 10.0, np.random.default_rng(0))
    assert parked == 0
    np.testing.assert_array_equal(same.height, world.height)


def test_cars_smaller_than_a_cell_take_one() -> None:
    world = build_city((0.0, 0.0), 60.0, 4.0, 0.0, np.random.default_rng(0))
    same, parked = with_cars(world, 3, 30.0, np.random.default_rng(0))
    assert parked == 3
    assert 1 <= (same.height != world.height).sum() <= 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sun-elevation", "20", "--slope", "5"], ["--sun-elevation does", "--slope does", "expected natural"]),
        (
            ["--terrain", "natural", "--hdr", "--bits", "8"],
            ["--hdr does nothing here", "--bits does", "city or downtown"],
        ),
        (["--classes", "c.tif"], ["--classes does nothing here: found no --dsm, expected one with it"]),
        (["--terrain", "natural", "--slope", "5"], []),
        (["--hdr", "--bits", "8", "--cars", "3"], []),
    ],
)
def test_options_that_do_nothing_beside_the_others_are_told(arguments: list[str], words: list[str]) -> None:
    done = CliRunner().invoke(main, ["simulate", "--dry-run", *arguments])
    assert all(word in done.stderr for word in words)
    assert bool(words) == ("does nothing here" in done.stderr)


@pytest.mark.parametrize("bits", [9, 10, 12])
def test_towns_of_other_bits_than_8_and_11_are_wrong_usage(bits: int) -> None:
    done = CliRunner().invoke(main, ["simulate", "--dry-run", "--bits", str(bits)])
    assert done.exit_code == 2
    assert f"--bits: found {bits}, expected 8 or 11 for a city" in done.stderr

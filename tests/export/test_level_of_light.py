"""Reflectance factors of Lambertian ground: its albedo does not depend on the sun, its pictures do."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.described import Description
from sattools.fit.illumination import level_towards, levels
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_image, read_on, read_raster
from sattools.simulate import SimulateOptions, simulate

LOW, HIGH = (135.0, 25.0), (150.0, 60.0)  # azimuth, elevation [degrees]


def ground(folder: Path, sun: tuple[float, float]) -> Scene:
    """Gentle Lambertian ground under a sun; always the same ground."""
    options = SimulateOptions(
        terrain="natural", id="HILL", size=128.0, views=4, train=4, units=2, seed=5, off_nadir=20.0, slope=3.0,
        reflectance="lambert", sun_azimuth=sun[0], sun_elevation=sun[1],
    )  # fmt: skip
    return simulate(options, folder / "HILL")


@pytest.fixture(scope="module")
def low(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    scene = ground(tmp_path_factory.mktemp("low"), LOW)
    fit(scene, FitOptions(resolution=2.0, epochs=[4]))
    export(scene, ExportOptions(view=["HILL_002"], sun=HIGH))
    return scene


def picture(scene: Scene, name: str) -> Any:
    item = next(item for item in scene.items if item.id == "HILL_002")
    return read_image(scene.path(item.assets[name].href))


def test_the_albedo_is_that_of_the_ground_under_a_low_sun(low: Scene) -> None:
    albedo, grid = read_raster(low.path(low.products["albedo"]))
    truth = read_on(low.path(low.products["truth_albedo"]), grid)
    # without the level of the light it is sin(25 degrees) = 0.42 of it; slopes of 3 degrees are +-11 %
    assert np.nanmedian(albedo / truth) == pytest.approx(1, abs=0.06)


def test_a_picture_of_its_own_sun_is_as_bright_as_the_image(low: Scene) -> None:
    rendered, image = picture(low, "rendered"), picture(low, "image") / 4095
    known = np.isfinite(rendered)
    assert rendered[known].mean() / image[known].mean() == pytest.approx(1, abs=0.03)


def test_a_picture_under_a_higher_sun_is_as_bright_as_an_image_taken_then(low: Scene, tmp_path: Path) -> None:
    relit, image = picture(low, "relit"), picture(ground(tmp_path, HIGH), "image") / 4095
    known = np.isfinite(relit)
    assert relit[known].mean() / image[known].mean() == pytest.approx(1, abs=0.06)  # it was 0.49
    above, _ = read_raster(low.path(low.products["relit"]))
    albedo, _ = read_raster(low.path(low.products["albedo"]))
    assert np.nanmedian(above / albedo) == pytest.approx(np.sin(np.radians(60)), abs=0.01)


def test_levels_are_those_of_reflectance_factors_alone() -> None:
    suns = [(0.0, 0.6, 0.8), None, (0.0, 1.0, 0.001)]
    np.testing.assert_allclose(levels("reflectance_factor", suns, 2), [[0.8, 0.8], [0.425, 0.425], [0.05, 0.05]])
    assert (levels("reflectance_factor", [None], 1) == 1).all()
    assert (levels("toa_reflectance", suns, 1) == 1).all()
    assert (levels("relative", suns, 1) == 1).all()


def test_models_without_levels_have_none_under_another_sun() -> None:
    import torch

    grid = Grid("EPSG:32617", 436000, 3357000, 1.0, 4, 4)
    one: Any = {"grid": grid, "items": ["a"], "suns": [None]}
    factor = Description(**one, radiance="reflectance_factor")
    hapke = Description(**one, radiance="reflectance_factor", brdf="hapke")
    sun = (0.0, 0.6, 0.8)
    assert level_towards(factor, torch.full((1, 3), 0.5), sun) == pytest.approx(0.8)
    assert level_towards(factor, torch.ones(1, 3), sun) == 1  # of a fit of before
    assert level_towards(hapke, torch.full((1, 3), 0.5), sun) == 1
    assert level_towards(Description(**one), torch.full((1, 3), 0.5), sun) == 1

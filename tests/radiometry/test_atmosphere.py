"""Light of the air that `normalise` takes off reflectances."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sattools.camera.ground import direction
from sattools.errors import SceneError
from sattools.radiometry import blocks
from sattools.radiometry.atmosphere import HAZY, darkest, rayleigh_transmittance
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import check_start, normalise
from sattools.scene import Scene
from sattools.scene.raster import read_image

UP = np.array([0.0, 0.0, 1.0])
DECLARED = NormaliseOptions(quantity="toa_reflectance", scale="1/10000")


def ground(rng: np.random.Generator) -> np.ndarray:
    """Reflectances ``[3, 60, 80]`` of which one in fifty is shade that sends up 1 %."""
    reflectance = rng.uniform(0.05, 0.5, (3, 60, 80))
    reflectance[:, rng.random((60, 80)) < 0.02] = 0.01
    return reflectance


def as_numbers(reflectance: np.ndarray) -> np.ndarray:
    return np.round(reflectance * 10000).astype(np.uint16)


def test_the_darkest_ground_tells_what_the_air_adds(make_scene: Any) -> None:
    true = ground(np.random.default_rng(0))
    path = np.array([0.02, 0.05, 0.09])
    hazy = as_numbers(true + path[:, None, None])
    scene = make_scene(hazy, as_numbers(true))
    found = normalise(scene, NormaliseOptions(**vars(DECLARED) | {"atmosphere": "dark-object"}))
    assert found["atmosphere"]["i0"] == {"path": pytest.approx(path.tolist(), abs=1e-4), "transmittance": [1.0] * 3}
    assert found["atmosphere"]["i1"]["path"] == [0.0] * 3  # clear air, though the shade is not black
    for name in ("i0", "i1"):  # 2e-4: numbers are whole ten thousandths
        assert np.abs(read_image(scene.path(f"radiance/{name}.tif")) - true).max() < 2e-4
    item = Scene.from_json(scene.to_json()).items[0]
    assert item.properties["sattools:atmosphere"] == found["atmosphere"]["i0"]
    assert item.properties["sattools:radiance"] == "toa_reflectance"
    normalise(scene, DECLARED)
    assert "sattools:atmosphere" not in scene.items[0].properties
    assert np.abs(read_image(scene.path("radiance/i0.tif")) - hazy / 10000).max() < 1e-6


def test_images_without_anything_dark_are_told_of_in_one_line(make_scene: Any) -> None:
    true = ground(np.random.default_rng(4))
    hazy = as_numbers(true + np.array([0.0, 0.01, 0.05])[:, None, None])
    scene = make_scene(hazy, as_numbers(true), hazy)
    assert normalise(scene, DECLARED)["notes"] == [f"i0, i2: {HAZY}"]
    assert HAZY.startswith("the darkest thousandth has a reflectance above 0.03")
    assert normalise(scene, NormaliseOptions(**vars(DECLARED) | {"atmosphere": "dark-object"}))["notes"] == []


def test_a_band_without_data_is_told(make_scene: Any, caplog: pytest.LogCaptureFixture) -> None:
    """Nothing can be taken off it, and black ground in one colour is nobody's."""
    whole = as_numbers(ground(np.random.default_rng(0)) + 0.05)
    broken = whole.copy()
    broken[1] = 0
    broken[:, :5] = 0  # a frame, of which all images may have one
    scene = make_scene(broken, whole)
    found = normalise(scene, NormaliseOptions(**vars(DECLARED) | {"atmosphere": "dark-object"}))
    assert found["atmosphere"]["i0"]["path"] == pytest.approx([0.05, 0.0, 0.05], abs=1e-4)
    told = "i0: band 2 is 0 throughout: without data? (--bands takes others; --atmosphere has nothing to go by there)"
    assert [text for text in found["notes"] if "is 0 throughout" in text] == [told]
    assert told in caplog.messages


def test_an_image_that_keeps_its_air_as_nothing_tells_it_is_told(
    make_scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of large images pixels at even distances tell it, here two of the first row, which has no data."""
    monkeypatch.setattr(blocks, "TOLD", 1)
    whole = as_numbers(ground(np.random.default_rng(0)))
    framed = whole.copy()
    framed[:, 0] = 0
    found = normalise(make_scene(framed, whole), NormaliseOptions(**vars(DECLARED) | {"atmosphere": "dark-object"}))
    assert list(found["atmosphere"]) == ["i1"]
    expected = "found no value in pixels at even distances, expected some that tell the air"
    assert f"i0: --atmosphere takes nothing off: {expected}" in found["notes"]


def test_the_share_of_dark_ground_is_in_the_unit_of_the_images(make_scene: Any) -> None:
    """The sun stands 30 degrees high: a reflectance factor pi L / E is half of pi L / (E cos sun zenith)."""
    scene = make_scene(as_numbers(0.5 * (ground(np.random.default_rng(1)) + 0.04)))
    options = NormaliseOptions(quantity="reflectance_factor", scale="1/10000", atmosphere="dark-object")
    assert normalise(scene, options)["atmosphere"]["i0"]["path"] == pytest.approx([0.02] * 3, abs=1e-4)
    kept = NormaliseOptions(**vars(options) | {"dark_reflectance": 0.05})
    assert normalise(scene, kept)["atmosphere"]["i0"]["path"] == pytest.approx([0.0] * 3, abs=1e-4)


def test_air_of_molecules_lets_less_through_the_more_it_adds(make_scene: Any) -> None:
    sun = direction(110.0, 30.0)
    depth = np.array([0.03, 0.09, 0.2])
    path = 0.75 * (1 + sun[2] ** 2) * (1 - np.exp(-depth * (1 / sun[2] + 1))) / (4 * (sun[2] + 1))
    through = rayleigh_transmittance(path, sun, UP)
    true = ground(np.random.default_rng(2))
    above = path[:, None, None] + through[:, None, None] * true
    scene = make_scene(as_numbers(above))
    found = normalise(scene, NormaliseOptions(**vars(DECLARED) | {"atmosphere": "rayleigh"}))["atmosphere"]["i0"]
    assert found["path"] == pytest.approx(path.tolist(), abs=1e-4)
    assert found["transmittance"] == pytest.approx(through.tolist(), abs=5e-4)
    assert np.abs(read_image(scene.path("radiance/i0.tif")) - true).max() < 5e-4  # whole ten thousandths, divided


def test_the_transmittance_is_that_of_a_molecular_atmosphere() -> None:
    """Bodhaine et al. (1999): 0.0965 is the optical depth of clean air at 0.55 um, sea level.

    The fluxes that leave it downwards, two-stream, are 1 - tau / 2 mu to first order: 0.953 straight down.
    """
    sun = direction(0.0, 45.0)
    path = np.array([0.75 * (1 + sun[2] ** 2) * (1 - np.exp(-0.0965 * (1 / sun[2] + 1))) / (4 * (sun[2] + 1))])
    straight = (5 / 3 - np.exp(-0.0965) / 3) / (4 / 3 + 0.0965)
    slanted = ((2 / 3 + sun[2]) + (2 / 3 - sun[2]) * np.exp(-0.0965 / sun[2])) / (4 / 3 + 0.0965)
    assert straight == pytest.approx(0.953, abs=0.003)
    assert rayleigh_transmittance(path, sun, UP)[0] == pytest.approx(straight * slanted, rel=1e-9)
    assert rayleigh_transmittance(np.zeros(1), sun, UP)[0] == pytest.approx(1.0, abs=1e-12)


@given(
    path=st.floats(0, 10), elevation=st.floats(0.01, 90), azimuth=st.floats(0, 360), tilt=st.floats(0.01, 90),
)  # fmt: skip
def test_what_comes_through_is_a_share_for_any_path_sun_and_view(
    path: float, elevation: float, azimuth: float, tilt: float
) -> None:
    sun, view = direction(0.0, elevation), direction(azimuth, tilt)
    less, more = (rayleigh_transmittance(np.array([p]), sun, view)[0] for p in (path, path + 0.01))
    assert 0 < more <= less <= 1


def test_a_few_broken_pixels_do_not_tell_the_air() -> None:
    values = np.full((1, 100_000), 0.2)
    values[0, :50] = -1.0
    values[0, 50:300] = 0.06
    values[0, 300:400] = np.nan
    assert darkest(values)[0] == pytest.approx(0.06)


def test_radiance_of_no_scale_and_suns_that_nobody_knows_are_refused(make_scene: Any, tmp_path: Path) -> None:
    scene = make_scene(as_numbers(ground(np.random.default_rng(3))))
    with pytest.raises(SceneError, match="--atmosphere dark-object: found relative radiance, expected reflectances"):
        check_start(scene, NormaliseOptions(atmosphere="dark-object"))
    del scene.items[0].properties["view:sun_azimuth"]
    with pytest.raises(SceneError, match="of i0 the sun is unknown or below the horizon"):
        normalise(scene, NormaliseOptions(**vars(DECLARED) | {"atmosphere": "rayleigh"}))
    assert not (tmp_path / "N/radiance").exists()
    normalise(scene, NormaliseOptions(**vars(DECLARED) | {"atmosphere": "dark-object"}))  # needs no sun

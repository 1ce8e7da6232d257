"""What a network says of its reflectance model's parameters: no more than the surface fit that it starts from."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import rasterio

from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.presets import resolve
from sattools.fit.stage import fit
from sattools.scene import Scene

TINY = {"width": 16, "rays": 64, "steps": 4, "resolution": 2.0}


def read(scene: Scene, name: str) -> tuple[np.ndarray, dict[str, str]]:
    with rasterio.open(scene.path(scene.products[name])) as data:
        return data.read(), data.tags()


@pytest.mark.parametrize(
    ("preset", "amplitude", "shapes"),
    [("hapke-nerf", "w", ["b", "c", "theta"]), ("rpv-nerf", "rho0", ["k", "asymmetry", "rhoc"])],
)
def test_what_the_images_did_not_determine_is_no_data_of_a_network_too(
    make_matched_hamlet: Callable[..., Scene], preset: str, amplitude: str, shapes: list[str]
) -> None:
    scene = make_matched_hamlet()
    history = fit(scene, resolve(preset, TINY))
    assert any("the surface fit that the network started from" in note for note in history["notes"])
    export(scene, ExportOptions())
    known, about = read(scene, "identifiable")
    assert "of the surface fit that the network started from" in about["CONTENT"]
    for band, name in zip(known, shapes, strict=True):
        values, tags = read(scene, name)
        shown = np.isfinite(band)
        assert (np.isfinite(values[0])[shown] == (band >= 0.5)[shown]).all(), name
        assert "no data elsewhere" in tags["DETERMINED"]
        std, tags = read(scene, f"{name}_std")
        assert (std[0][shown] > 0).all()
        assert "of the surface fit that the network started from" in tags["METHOD"]
    assert np.isfinite(read(scene, amplitude)[0][:, np.isfinite(known[0])]).all()
    export(scene, ExportOptions(undetermined="prior"))
    assert all(np.isfinite(read(scene, name)[0][0][np.isfinite(known[0])]).all() for name in shapes)


def test_the_albedo_of_a_network_is_its_reflectance_of_level_ground(make_matched_hamlet: Callable[..., Scene]) -> None:
    scene = make_matched_hamlet()
    fit(scene, resolve("rpv-nerf", TINY))
    export(scene, ExportOptions())
    albedo, reflectance, rho0 = (read(scene, name)[0] for name in ("albedo", "reflectance", "rho0"))
    np.testing.assert_array_equal(albedo, reflectance)
    assert np.nanmax(abs(albedo - rho0)) > 0.005


def test_a_network_from_noise_says_that_nothing_is_known_of_its_parameters(
    make_matched_hamlet: Callable[..., Scene],
) -> None:
    scene = make_matched_hamlet()
    given: dict[str, Any] = {**TINY, "start": "prior"}
    history = fit(scene, resolve("hapke-nerf", given))
    words = "no uncertainty of the reflectance's parameters is known: the network started from no surface fit"
    assert words in history["notes"]
    export(scene, ExportOptions())
    assert "identifiable" not in scene.products
    assert read(scene, "theta")[1]["DETERMINED"].startswith("unknown: the model holds nothing of a surface fit")
